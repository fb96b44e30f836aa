"""How a bag was read, and the exit status if parts of it were lost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from engram.cli.endings import ExitStatus, VerbInterruptedError
from engram.errors import EngramError

if TYPE_CHECKING:
    from engram.sequences import Drive


@contextmanager
def losses_told(sequence: Drive) -> Iterator[None]:
    """Around what a verb does with a drive: says on stderr what of it could not be used.

    A verb that fails keeps its exit status: a loss may be the reason.

    Raises:
        Exit: parts of a bag were lost, or more frames than the doctor allows were left out for a
            wrong stamp; what could be read was used.
    """
    _noted(sequence)
    try:
        yield
    except (EngramError, VerbInterruptedError, typer.Exit):
        _told(sequence, "parts of the bag could not be read:")
        raise
    if _told(sequence, "parts of the bag could not be read; the rest was used:"):
        raise typer.Exit(ExitStatus.LOST_PARTS)


def _noted(sequence: Drive) -> None:
    """Says what of a drive's calibration was read otherwise than it is written."""
    from engram.sequences import BagSequence, ImageSequence

    notes: Sequence[str] = ()
    if isinstance(sequence, BagSequence):
        notes = sequence.notes
    elif isinstance(sequence, ImageSequence):
        notes = sequence.cameras.notes
    for note in notes:
        typer.echo(f"note: {note}", err=True)


def _told(sequence: Drive, heading: str) -> bool:
    """Says how images were paired, what was lost and left out; whether it was too much."""
    from engram.doctor import DoctorConfig
    from engram.sequences import BagSequence, FrameLog, stamps_of

    if isinstance(sequence, BagSequence) and sequence.pairing.left:
        typer.echo(sequence.pairing.text(), err=True)
    lost = sequence.lost if isinstance(sequence, BagSequence) else []
    for line in [heading, *(f"  {loss}" for loss in lost)] if lost else []:
        typer.echo(line, err=True)
    if isinstance(sequence, FrameLog):
        return False
    for fact in sequence.stamp_facts:
        typer.echo(f"warning: {fact}", err=True)
    return bool(lost) or stamps_of(sequence).faulty_share > DoctorConfig().faulty_share
