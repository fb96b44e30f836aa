"""Progress and cancelling of long work, and files that are written whole or not at all."""

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
    """Watches long work and may stop it. This one is silent and never stops anything.

    Work calls `stage` for each of its parts, `advance` once per item of the part, and `check`
    wherever it can stop with nothing half done.
    """

    def stage(self, what: str, total: int) -> AbstractContextManager[Monitor]:
        """A part of the work: its name and how many items it has; yields who hears of them."""
        del what, total
        return nullcontext(self)

    def advance(self, word: str = "") -> None:
        """One item is done; `word` says what became of it."""

    def hear(self, report: Any) -> None:
        """A part of the result that is there for good, whatever becomes of the rest."""

    def check(self) -> None:
        """Raises KeyboardInterrupt where the work is to stop."""


QUIET = Monitor()


class Advancing(Monitor):
    """Calls a function for each item of the work, with the word on what became of it."""

    def __init__(self, advance: Callable[[str], None]) -> None:
        self._advance = advance

    def advance(self, word: str = "") -> None:
        """See `Monitor`."""
        self._advance(word)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], None]]:
    """Holds a first Ctrl-C back until the function that this yields is called, which raises it.

    Python raises KeyboardInterrupt between any two instructions of the main thread, also between
    taking the lock of a queue and being able to give it back: the thread at the queue's other end
    then waits for ever. A second Ctrl-C is raised at once, for what does not come back by itself.

    Only where Ctrl-C would raise KeyboardInterrupt: on the main thread of a program that has no
    handler of its own. Elsewhere nothing changes.
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
    """The same monitor, whose `check` also raises where Ctrl-C was pressed; see above."""
    with deferred_interrupt() as raise_if_asked:
        yield _Interruptible(monitor, raise_if_asked)


class _Interruptible(Monitor):
    def __init__(self, monitor: Monitor, raise_if_asked: Callable[[], None]) -> None:
        self._monitor = monitor
        self._raise_if_asked = raise_if_asked

    def advance(self, word: str = "") -> None:
        self._monitor.advance(word)

    def hear(self, report: Any) -> None:
        self._monitor.hear(report)

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        with self._monitor.stage(what, total) as part:
            yield _Interruptible(part, self._raise_if_asked)

    def check(self) -> None:
        self._raise_if_asked()
        self._monitor.check()


@contextmanager
def write_whole(path: Path) -> Iterator[Path]:
    """Yields where to write; the file gets its name when the block ends, whole and on the disk.

    An error, or a killed process, leaves what was under the name before. The folder must be there.
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


def ignore(word: str) -> None:
    """The progress of a caller that shows none."""
    del word
