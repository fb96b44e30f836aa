"""Stages of a day, reported while they run, and timed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from engram.monitor import Monitor, Relay


class Stages(Relay):
    """Reports each stage as it begins, and how long it took when it ends.

    Args:
        inner: hears of every item.
        tell: takes a line.

    Attributes:
        took: stage → seconds, in their order.
    """

    def __init__(self, inner: Monitor, tell: Callable[[str], object]) -> None:
        super().__init__(inner)
        self._tell = tell
        self.took: dict[str, float] = {}

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        """See `Monitor`."""
        self._tell(f"{what} …")
        begun_s = time.monotonic()
        with super().stage(what, total) as part:
            yield part
        self.took[what] = time.monotonic() - begun_s
        self._tell(f"{what}: {self.took[what]:.1f} s")
