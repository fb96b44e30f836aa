"""What a stage is, and how its two sides are timed against each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Protocol

import numpy as np

from engram_lab.bench.data import BenchData
from engram_lab.bench.plain import PlainPipeline
from engram_lab.bench.report import Side, StageResult

# One timed run: does the work on the i-th input and says what it worked on.
Run = Callable[[int], dict[str, int]]

_WARM_UP_RUNS = 8


@dataclass(frozen=True, slots=True)
class Prepared:
    """A stage with its inputs in memory, ready to be timed.

    Attributes:
        ours: one run of Engram's side.
        reference: the same work by the plain pipeline; None where there is none.
        best_of: how often each input is run; the best time of each counts.
    """

    ours: Run
    reference: Run | None = None
    best_of: int = 1


class Stage(Protocol):
    """Prepares one stage; gets the plain pipeline where it is at hand."""

    def __call__(self, data: BenchData, plain: PlainPipeline | None) -> Prepared:
        """Loads, extracts and builds whatever the timed runs need."""
        ...


def time_stage(name: str, prepared: Prepared, runs: int, note: str) -> StageResult:
    """Time both sides in turn, so that whatever else the machine does falls on both alike."""
    sides = [prepared.ours] + ([prepared.reference] if prepared.reference else [])
    times_ns = np.empty((len(sides), runs))
    counts: list[list[dict[str, int]]] = [[] for _ in sides]
    for i in range(-_WARM_UP_RUNS, runs):
        for side, run in enumerate(sides):
            took, count = _time(run, i + _WARM_UP_RUNS, prepared.best_of)
            if i >= 0:
                times_ns[side, i] = took
                counts[side].append(count)
    results = [
        _summarise(times, side_counts) for times, side_counts in zip(times_ns, counts, strict=True)
    ]
    reference = results[1] if prepared.reference else None
    return StageResult(name, runs, results[0], reference, "" if reference else note)


def _time(run: Run, i: int, best_of: int) -> tuple[int, dict[str, int]]:
    """The best time in ns, and what the run says."""
    best, count = -1, {}
    for _ in range(best_of):
        started = perf_counter_ns()
        count = run(i)
        took = perf_counter_ns() - started
        best = took if best < 0 else min(best, took)
    return best, count


def _summarise(times_ns: np.ndarray, counts: list[dict[str, int]]) -> Side:
    names = {name for count in counts for name in count}
    medians = {
        name: float(np.median([count[name] for count in counts if name in count]))
        for name in sorted(names)
    }
    times_ms = times_ns / 1e6
    return Side(float(np.median(times_ms)), float(np.percentile(times_ms, 99)), medians)
