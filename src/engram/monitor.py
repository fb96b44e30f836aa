"""Progress and cancelling of long work: Ctrl-C is asked about where nothing is half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


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


def ignore(word: str) -> None:
    """The progress of a caller that shows none."""
    del word
