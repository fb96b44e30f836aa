"""Outcome of saving a live drive."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from engram.graph.model import SessionId


class SavingState(StrEnum):
    """State of the saving of a live drive."""

    OFF = "off"
    ON = "on"
    FAILED = "failed"
    SPOOLED = "spooled"
    COMMITTED = "committed"
    UNCOMMITTED = "uncommitted"


@dataclass(slots=True)
class Saving:
    """Whether and where a live drive is saved.

    Attributes:
        state: `FAILED` after a write error: the robot continues to localise, and what it had saved
            is kept; `SPOOLED` if another process writes to the map, so that the drive's memory
            waits in a file next to it; `UNCOMMITTED` if the doctor found something fatal: a mapped
            session then waits for ``engram check --seal``.
        reason: why saving failed or was not committed, or where the memory waits.
        session: the drive.
        revision: number of the revision that holds the drive.
        nodes: number of saved nodes.
        recovered: revisions that hold what earlier drives of the robot had saved when their process
            was killed.
    """

    state: SavingState = SavingState.OFF
    reason: str = ""
    session: SessionId | None = None
    revision: int | None = None
    nodes: int = 0
    recovered: tuple[int, ...] = ()

    def text(self) -> str:
        """For people."""
        earlier = ", ".join(map(str, self.recovered))
        said = f"; what was saved before an interruption: revision {earlier}" if earlier else ""
        return self._state_text() + said

    def _state_text(self) -> str:
        match self.state:
            case SavingState.COMMITTED if self.revision is None:
                return "the map already remembers this drive, or there was nothing to remember"
            case SavingState.COMMITTED:
                return f"kept as revision {self.revision}"
            case SavingState.SPOOLED:
                return (
                    f"another process writes to the map: the drive waits in {self.reason}; the "
                    "next run that maps or remembers commits it"
                )
            case SavingState.FAILED:
                return f"saving failed: {self.reason}"
            case SavingState.UNCOMMITTED:
                kept = "; engram check --seal commits what was mapped anyway" if self.nodes else ""
                return f"not committed, because the drive is unfit: {self.reason}{kept}"
        return f"saving is {self.state}"
