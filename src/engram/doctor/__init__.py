"""Frames of a drive → what is wrong with it, before anything is mapped."""

from engram.doctor.examination import Evidence, Examination, Facts
from engram.doctor.findings import Diagnosis, Finding, Severity, measure_text
from engram.doctor.settings import DoctorConfig
from engram.doctor.table import CHECKS, Check, diagnose

__all__ = [
    "CHECKS",
    "Check",
    "Diagnosis",
    "DoctorConfig",
    "Evidence",
    "Examination",
    "Facts",
    "Finding",
    "Severity",
    "diagnose",
    "measure_text",
]
