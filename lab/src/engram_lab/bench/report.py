"""What `engram lab bench` measured."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the figures come from.

    Attributes:
        processor: name of the processor.
        isa: instruction set in use by the core: generic, v3 or v4.
        cores_used: cores that the measurement ran on.
        python, numpy, opencv: versions.
        poselib: version, None where it is not installed.
        data: what the frames are.
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
        ms: median of its runs, milliseconds.
        p99_ms: their 99th percentile.
        counts: medians of what was worked on, such as features and inliers.
    """

    ms: float
    p99_ms: float
    counts: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StageResult:
    """One stage against its reference.

    Attributes:
        name: key in `STAGES`.
        runs: timed runs of each side, interleaved.
        ours: Engram's side.
        reference: the plain pipeline's side; None where there is none.
        note: why there is no reference, or "".
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
