"""The papers' experiments: cross-validation, sweeps, figures and tables (method §8)."""

from engram_lab.studies.configurations import DEFAULT_LANES, UNLIMITED, Configuration
from engram_lab.studies.drives import DriveSet, EvaluatedDrive, drives_of, open_campaign
from engram_lab.studies.folds import Fold, split
from engram_lab.studies.ranking_report import write_report
from engram_lab.studies.running import Plan, RankingOptions, forget, make_plan, run

__all__ = [
    "DEFAULT_LANES",
    "UNLIMITED",
    "Configuration",
    "DriveSet",
    "EvaluatedDrive",
    "Fold",
    "Plan",
    "RankingOptions",
    "drives_of",
    "forget",
    "make_plan",
    "open_campaign",
    "run",
    "split",
    "write_report",
]
