"""The stages of `engram lab bench`, each timed against the plain pipeline in the same run."""

from engram_lab.bench.report import BenchReport, Machine, Side, StageResult
from engram_lab.bench.runner import run_bench
from engram_lab.bench.stages import STAGES

__all__ = ["STAGES", "BenchReport", "Machine", "Side", "StageResult", "run_bench"]
