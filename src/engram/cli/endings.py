"""How a verb may end without the requested result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import typer

from engram.errors import EngramError

if TYPE_CHECKING:
    from engram.doctor.findings import Finding


class ExitStatus(IntEnum):
    """How a verb ended, for scripts. `docs/commands.md` has the same table."""

    meaning: str

    def __new__(cls, value: int, meaning: str) -> ExitStatus:
        """A status with what it means."""
        one = int.__new__(cls, value)
        one._value_ = value
        one.meaning = meaning
        return one

    DONE = 0, "done"
    DAMAGED_MAP = 1, "`check` found damage, or wrong edges"
    BAD_INPUT = 2, "the input cannot be used; one line says why and what to do"
    LOST_PARTS = 3, "parts of a drive were lost, by damage or wrong stamps; the rest was used"
    UNFIT_DRIVE = 4, "the drive has a fatal fault: `doctor` found it, or `map` refused it"
    NOT_TO_BE_TRUSTED = (
        5,
        "`localise`, `live`, `record` and `view` did it, but the drive has a fatal fault: do not "
        "trust the result",
    )
    INTERRUPTED = 130, "interrupted"
    READER_LEFT = 141, "the reader closed the output"  # as of a program that SIGPIPE ends


def untrusted_if(fatal: Sequence[Finding]) -> None:
    """Ends a verb that finished its work on an unfit drive.

    Raises:
        Exit: the doctor found something fatal; stderr says what.
    """
    if not fatal:
        return
    for one in fatal:
        typer.echo(f"not to be trusted: {one.text()}", err=True)
    raise typer.Exit(ExitStatus.NOT_TO_BE_TRUSTED)


class VerbInterruptedError(Exception):
    """A verb was stopped by Ctrl-C before it had a result."""


class PartlyDoneError(Exception):
    """A verb failed or was stopped after part of its work was committed.

    Attributes:
        error: what ended it.
        done: what ``--json`` prints of the committed part, in addition to the error.
    """

    def __init__(self, error: EngramError | VerbInterruptedError, done: Mapping[str, Any]) -> None:
        super().__init__(str(error))
        self.error = error
        self.done = done
