"""How a verb may end without the result that was asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from engram.errors import EngramError

# A drive has a fatal fault.
EXIT_UNFIT_DRIVE = 4


class VerbInterruptedError(Exception):
    """A verb was stopped by Ctrl-C before it had a result."""


class PartlyDoneError(Exception):
    """A verb failed, or was stopped, when a part of what was asked had been done for good.

    Attributes:
        error: what ended it.
        done: what ``--json`` prints of the part that was done, beside the error.
    """

    def __init__(self, error: EngramError | VerbInterruptedError, done: Mapping[str, Any]) -> None:
        super().__init__(str(error))
        self.error = error
        self.done = done
