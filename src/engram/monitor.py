"""Progress and cancellation of long work, and atomic writing of files."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import Any


class Monitor:
    """Monitors long work and may stop it. This base class is silent and never stops it.

    The work calls `stage` for each of its parts, `advance` once per item of the part, and `check`
    wherever it can stop in a consistent state.
    """

    def stage(self, what: str, total: int) -> AbstractContextManager[Monitor]:
        """A part of the work with its name and number of items; yields the monitor of the part."""
        del what, total
        return nullcontext(self)

    def advance(self, word: str = "") -> None:
        """Reports one finished item; `word` is its status."""

    def hear(self, report: Any) -> None:
        """Reports a part of the result that is final, even if the rest fails."""

    def check(self) -> None:
        """Raises KeyboardInterrupt if the work should stop."""


QUIET = Monitor()


class Relay(Monitor):
    """Another monitor, which receives every report; the work may be stopped here, too.

    Whatever wraps a monitor is one of these, or derives from it: a wrapper that passes reports on
    by hand drops, without a word, those that it does not list.

    Args:
        inner: receives every report, those of stages too.
        also: called by `check` after that of `inner`; raises KeyboardInterrupt to stop the work.
    """

    def __init__(self, inner: Monitor, also: Callable[[], None] = lambda: None) -> None:
        self._inner = inner
        self._also = also

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        """See `Monitor`."""
        with self._inner.stage(what, total) as part:
            yield Relay(part, self._also)

    def advance(self, word: str = "") -> None:
        """See `Monitor`."""
        self._inner.advance(word)

    def hear(self, report: Any) -> None:
        """See `Monitor`."""
        self._inner.hear(report)

    def check(self) -> None:
        """See `Monitor`."""
        self._inner.check()
        self._also()


class Advancing(Monitor):
    """Calls a function with the status of each finished item."""

    def __init__(self, advance: Callable[[str], None]) -> None:
        self._advance = advance

    def advance(self, word: str = "") -> None:
        """See `Monitor`."""
        self._advance(word)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], None]]:
    """Defers a first Ctrl-C until a call of the yielded function, which raises it.

    Python raises KeyboardInterrupt between any two instructions of the main thread, even while it
    holds the lock of a queue: the thread at the queue's other end then waits for ever. A second
    Ctrl-C raises at once, in case the work hangs.

    Has an effect only on the main thread of a program without its own handler of Ctrl-C.
    """
    asked = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            signal.default_int_handler(number, frame)
        asked = True

    def raise_if_asked() -> None:
        if asked:
            raise KeyboardInterrupt

    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    ):
        yield raise_if_asked
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield raise_if_asked
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def interruptible(monitor: Monitor) -> Iterator[Monitor]:
    """The same monitor, whose `check` also raises after Ctrl-C; see `deferred_interrupt`."""
    with deferred_interrupt() as raise_if_asked:
        yield Relay(monitor, raise_if_asked)


@contextmanager
def write_whole(path: Path) -> Iterator[Path]:
    """Yields a temporary path; at the end of the block it is synced and renamed to `path`.

    After an error or a kill the previous file stays unchanged. The folder must exist.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield draft
        with draft.open("rb") as written:
            os.fsync(written.fileno())
        draft.replace(path)
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
