"""The papers' experiments: cross-validation, sweeps, figures and tables (SPEC §8)."""

from engram.evaluation.configurations import DEFAULT_LANES, UNLIMITED, Configuration
from engram.evaluation.drives import DriveSet, EvaluatedDrive, drives_of, open_campaign
from engram.evaluation.folds import Fold, split
from engram.evaluation.report import write_report
from engram.evaluation.running import Plan, RankingOptions, forget, make_plan, run, task_count

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
    "task_count",
    "write_report",
]
