"""A transport to a caller in the same process: what a live process asks of any of them."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from threading import Condition
from typing import Any

from engram.live.driving import Outside
from engram.live.served import Command, FrameEvent, Message
from engram.robot.front import Arrived


class InProcess:
    """A transport to callers in the same process; frames that nobody fetched give way to newer.

    Args:
        hear: called with each message.
    """

    def __init__(self, hear: Callable[[Message], None]) -> None:
        self._hear = hear
        self._changed = Condition()
        self._commands: deque[Command] = deque()
        self._frame: FrameEvent | None = None
        self._closed = False

    def give(self, arrived: Arrived, outside: Outside | None = None) -> None:
        """Hands over a frame; replaces one that still waits. See `FrameEvent`."""
        with self._changed:
            dropped = 0 if self._frame is None else self._frame.dropped + 1
            self._frame = FrameEvent(arrived, time.perf_counter(), dropped, outside)
            self._changed.notify()

    def ask(self, do: str, **given: Any) -> None:
        """Hands over a command; the message with `is` = `reply` answers it."""
        with self._changed:
            self._commands.append(Command(do, given))
            self._changed.notify()

    def close(self) -> None:
        """No more frames or commands will come; those that wait are still taken."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def events(self) -> Iterator[FrameEvent | Command | None]:
        """See `Transport`."""
        while True:
            with self._changed:
                if not (self._commands or self._frame or self._closed):
                    self._changed.wait(0.1)
                event: FrameEvent | Command | None
                if self._commands:
                    event = self._commands.popleft()
                else:
                    event, self._frame = self._frame, None
                    if event is None and self._closed:
                        return
            yield event

    def tell(self, message: Message) -> None:
        """See `Transport`."""
        self._hear(message)
