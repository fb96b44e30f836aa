"""How far a job is, for its row."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from engram.monitor import Monitor

_TELL_S = 1.0


class Watching(Monitor):
    """Reports the progress of a job, and stops it if it is cancelled.

    Args:
        tell: notes the progress; returns whether the job is to be cancelled.
    """

    def __init__(self, tell: Callable[[str], bool]) -> None:
        self._tell = tell
        self._told_s = 0.0
        self._what, self._total, self._done = "", 0, 0

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        """See `Monitor`."""
        self._what, self._total, self._done = what.split(" /", 1)[0], total, 0
        yield self

    def advance(self, word: str = "") -> None:
        """See `Monitor`."""
        del word
        self._done += 1

    def check(self) -> None:
        """See `Monitor`."""
        now = time.monotonic()
        if now - self._told_s < _TELL_S:
            return
        self._told_s = now
        if self._tell(f"{self._what}: {self._done} of {self._total}"):
            raise KeyboardInterrupt
