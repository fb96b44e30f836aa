"""What a stage is, how its two sides are timed against each other, and what is reported."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from time import perf_counter_ns
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np

from engram.errors import MissingExtraError
from engram_lab.bench.data import BenchData
from engram_lab.opencv_contrib import xfeatures2d

PlainPipeline: TypeAlias = ModuleType


def load_plain_pipeline() -> tuple[PlainPipeline | None, str]:
    """The module and "", or None and the reason why there is no reference."""
    if importlib.util.find_spec("poselib") is None:
        return None, "no reference: PoseLib is not installed (pip install poselib)"
    try:
        xfeatures2d("the plain pipeline")
    except MissingExtraError as error:
        return None, f"no reference: {error}"
    from engram_lab.bench import reference

    return reference, ""


if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the figures come from.

    Attributes:
        poselib: version, None where it is not installed.
    """

    processor: str
    isa: str
    cores_used: int
    python: str
    numpy: str
    opencv: str
    poselib: str | None
    data: str


@dataclass(frozen=True, slots=True)
class Side:
    """One side of a stage: ours, or the reference.

    Attributes:
        p99_ms: their 99th percentile.
    """

    ms: float
    p99_ms: float
    counts: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StageResult:
    """One stage against its reference.

    Attributes:
        reference: the plain pipeline's side; None where there is none.
    """

    name: str
    runs: int
    ours: Side
    reference: Side | None
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """How many times faster ours is: reference ÷ ours; None without a reference."""
        return None if self.reference is None else self.reference.ms / self.ours.ms


@dataclass(frozen=True, slots=True)
class BenchReport:
    """All stages that were run, in the order of `STAGES`."""

    machine: Machine
    stages: tuple[StageResult, ...]

    def in_attempts(self, stage: StageResult) -> float | None:
        """How many localisation attempts of this run a stage takes as long as; None without one."""
        attempts = [other.ours.ms for other in self.stages if other.name == "attempt_512"]
        return stage.ours.ms / attempts[0] if attempts else None

    def to_dict(self) -> dict[str, Any]:
        """Plain values.

        ``{"machine": {…}, "stages": {NAME: {"ms", "p99_ms", "reference_ms", "ratio",
        "in_attempts", …}}}``: the last is the time in units of stage ``attempt_512``.
        """
        stages: dict[str, Any] = {}
        for stage in self.stages:
            reference = stage.reference
            stages[stage.name] = {
                "ms": stage.ours.ms,
                "p99_ms": stage.ours.p99_ms,
                "reference_ms": reference.ms if reference else None,
                "ratio": stage.ratio,
                "in_attempts": self.in_attempts(stage),
                "reference_p99_ms": reference.p99_ms if reference else None,
                "counts": stage.ours.counts,
                "reference_counts": reference.counts if reference else None,
                "runs": stage.runs,
                "note": stage.note,
            }
        return {"machine": asdict(self.machine), "stages": stages}

    def table(self) -> Table:
        """A table for people."""
        from rich.table import Table

        columns = ("stage", "ms", "p99", "reference ms", "ratio", "ours", "reference")
        notes = dict.fromkeys(stage.note for stage in self.stages if stage.note)
        table = Table(
            title=f"{self.machine.processor}, {self.machine.isa}: {self.machine.data}",
            caption="\n".join(notes),
        )
        for column in columns:
            table.add_column(column, justify="left" if column == "stage" else "right")
        for stage in self.stages:
            reference = stage.reference
            table.add_row(
                stage.name,
                f"{stage.ours.ms:.3f}",
                f"{stage.ours.p99_ms:.3f}",
                f"{reference.ms:.3f}" if reference else "–",
                f"{stage.ratio:.1f}×" if stage.ratio else "–",
                _in_words(stage.ours.counts),
                _in_words(reference.counts) if reference else "–",
            )
        return table


def _in_words(counts: dict[str, float]) -> str:
    return ", ".join(f"{value:g} {name}" for name, value in counts.items())


# One timed run: does the work on the i-th input and says what it worked on.
Run = Callable[[int], dict[str, int]]

_WARM_UP_RUNS = 8


@dataclass(frozen=True, slots=True)
class Prepared:
    """A stage with its inputs in memory, ready to be timed.

    Attributes:
        reference: the same work by the plain pipeline; None where there is none.
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
