"""Where a live process gets frames and commands from, and where its messages go."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Protocol, TypeAlias

from engram.live.outside import Outside
from engram.robot.front import Arrived, arriving, paced
from engram.robot.session import DriveSequence

Message: TypeAlias = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class FrameEvent:
    """A frame that arrived.

    Attributes:
        arrived: a pair of rectified images, or a frame of a log.
        arrived_s: `time.perf_counter` when it did.
        dropped: frames that were dropped for this one since the last.
        outside: what wheels and gyroscope say at its time; None without them.
    """

    arrived: Arrived
    arrived_s: float
    dropped: int = 0
    outside: Outside | None = None


@dataclass(frozen=True, slots=True)
class Command:
    """A request to the process.

    Attributes:
        do: such as `map` or `stop`; see `engram.live.link`.
        given: its arguments.
        id: repeated in the answer.
    """

    do: str
    given: Message = field(default_factory=dict)
    id: Any = None


class Transport(Protocol):
    """Brings frames and commands to a live process, and takes its messages away."""

    def events(self) -> Iterator[FrameEvent | Command | None]:
        """Arrivals in order, of frames the newest only; None whenever nothing came for a while.

        Ends when nothing more can come.
        """
        ...

    def tell(self, message: Message) -> None:
        """Sends a message, or drops it if no client is connected; any thread may call it."""
        ...


class Played:
    """A transport that plays a recorded drive, in real time or as fast as the robot goes.

    Args:
        sequence: the drive.
        hear: called with each message.
        rate_hz: frames a second, of which late ones are dropped; None plays every frame at once.
            The first one waits for the robot, which opens its map with it.
    """

    def __init__(
        self,
        sequence: DriveSequence,
        hear: Callable[[Message], None],
        rate_hz: float | None = None,
    ) -> None:
        self._sequence = sequence
        self._hear = hear
        self._rate_hz = rate_hz

    def events(self) -> Iterator[FrameEvent | Command | None]:
        """See `Transport`."""
        dropped = 0
        with closing(arriving(self._sequence)) as entries:
            for first in islice(entries, 1):  # opens the map: time runs once the robot is ready
                yield FrameEvent(first, time.perf_counter())
            for due, arrived in paced(entries, self._rate_hz):
                if self._rate_hz is not None and time.perf_counter() > due + 1 / self._rate_hz:
                    dropped += 1
                    continue
                yield FrameEvent(arrived, due, dropped)
                dropped = 0

    def tell(self, message: Message) -> None:
        """See `Transport`."""
        self._hear(message)
