"""From a drive to live frames: decoding ahead, pacing in real time, front-end and odometry."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from queue import Queue
from threading import Event, Thread
from typing import TypeVar

from engram.frontend import Frame, Frontend, StereoPair
from engram.monitor import deferred_interrupt
from engram.odometry import GapFiller, Motion, Odometry
from engram.robot.settings import Settings
from engram.sequences import FrameSequence, LoggedFrame, StereoSequence

T = TypeVar("T")

# Decoded pairs that wait ahead of the front-end: about 8 MB at KITTI's size.
_READ_AHEAD = 8


@dataclass(frozen=True, slots=True, eq=False)
class LiveFrame:
    """One frame as it reaches the localiser.

    Attributes:
        frame: the frame.
        motion: how the camera moved since the usable frame before.
        arrived: `time.perf_counter` when its images arrived.
        pair: its images; None when read from a frame log.
        stage_ms: time of each stage so far.
    """

    frame: Frame
    motion: Motion
    arrived: float
    pair: StereoPair | None
    stage_ms: dict[str, float]


def live_frames(
    sequence: StereoSequence | FrameSequence,
    settings: Settings,
    rate_hz: float | None = None,
    preload: bool = False,
) -> Generator[LiveFrame]:
    """Runs a drive's images through front-end and odometry; a frame log brings both along.

    Args:
        sequence: the drive.
        settings: of front-end and odometry.
        rate_hz: replay in real time at this rate; None for as fast as it goes.
        preload: decode everything before the first frame.

    Close the generator where it is left early: that ends the thread that reads ahead. While it is
    open, Ctrl-C waits for the end of the frame (`deferred_interrupt`).

    Raises:
        KeyboardInterrupt: between two frames.
    """
    frontend, odometry = Frontend(settings.frontend), Odometry(settings.odometry)
    gaps = GapFiller()
    # Closed by hand: after an error its traceback would keep the reading thread alive to the end
    # of the process, and a thread that is in the midst of C++ then takes the process down with it.
    with closing(_entries(sequence, preload)) as entries, deferred_interrupt() as raise_if_asked:
        for arrived, entry in paced(entries, rate_hz):
            raise_if_asked()
            if isinstance(entry, LoggedFrame):
                motion = gaps.motion(entry.odometry, entry.frame.stamp_ns)
                yield LiveFrame(entry.frame, motion, arrived, None, {})
            else:
                yield _run(frontend, odometry, gaps, entry, arrived)
            raise_if_asked()


def _entries(
    sequence: StereoSequence | FrameSequence, preload: bool
) -> Generator[StereoPair | LoggedFrame]:
    entries: Iterable[StereoPair | LoggedFrame] = sequence
    yield from list(entries) if preload else read_ahead(entries, _READ_AHEAD)


def _run(
    frontend: Frontend, odometry: Odometry, gaps: GapFiller, pair: StereoPair, arrived: float
) -> LiveFrame:
    started = time.perf_counter()
    frame = frontend.extract(pair)
    extracted = time.perf_counter()
    motion = gaps.motion(odometry.step(frame), frame.stamp_ns)
    finished = time.perf_counter()
    stage_ms = {
        "frontend": (extracted - started) * 1e3,
        "odometry": (finished - extracted) * 1e3,
    }
    return LiveFrame(frame, motion, arrived, pair, stage_ms)


def paced(items: Iterable[T], rate_hz: float | None) -> Iterator[tuple[float, T]]:
    """Each item with the time at which it arrives: at once, or at the given rate.

    At a rate, items arrive on schedule whether or not the consumer is ready, as on a robot: one
    that comes back late finds the next item already waiting.
    """
    first: float | None = None
    for count, item in enumerate(items):
        now = time.perf_counter()
        if rate_hz is None:
            yield now, item
            continue
        first = now if first is None else first
        due = first + count / rate_hz
        if due > now:
            time.sleep(due - now)
        yield due, item


def read_ahead(items: Iterable[T], depth: int) -> Generator[T]:
    """Iterates on a thread of its own, up to `depth` items ahead of the consumer.

    An error of the iteration is raised where the item would have come.
    """
    queue: Queue[tuple[T | None, BaseException | None, bool]] = Queue(depth)
    stopped = Event()

    def produce() -> None:
        try:
            for item in items:
                queue.put((item, None, False))
                if stopped.is_set():
                    return
        except BaseException as error:  # raised again in the consumer's thread
            queue.put((None, error, True))
            return
        queue.put((None, None, True))

    producer = Thread(target=produce, name="engram-reader", daemon=True)
    producer.start()
    try:
        while True:
            item, error, last = queue.get()
            if error is not None:
                raise error
            if last:
                return
            yield item  # type: ignore[misc]  # an item comes with neither error nor end
    finally:
        stopped.set()
        while producer.is_alive():
            while not queue.empty():
                queue.get_nowait()
            producer.join(timeout=0.05)
