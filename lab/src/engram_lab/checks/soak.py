"""Whether a step costs the same after hours of driving.

    python -m engram_lab.checks.soak localising --frames 7000     # 3 minutes
    python -m engram_lab.checks.soak logged --frames 1000000 --nodes 4000 --logs HOME OTHER…

Localising: the bench's clip is driven there and back, image by image, in a map of itself. Then a
fresh robot takes the same frames, in blocks that alternate with those of the old one.

Logged: the first eight frame logs of folder HOME, drives of one town, become a map as usual. All
others are added by robots that cannot relocalise, which save all they see, until the map has so
many nodes; then it is not changed any more. A log of HOME, the third unless `--drive` names another
one, is driven there and back, at two attempts a frame, and its old robot is compared with a fresh
one as above. With `--maps` both map, each in a copy of that map.

Ratios are of processor time, all threads of the process: medians over blocks, with quartiles.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.maps.map import Map, open_map
from engram.maps.map_files import copy_map
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.mapping import map_drive
from engram.robot.robot import Robot
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram.sequences.sequence import LoggedFrame
from engram_lab.bench.data import load_bench_data
from engram_lab.programs import Figure, command_line, report

_PERIOD_NS = 100_000_000
_BLOCK = 50  # frames
_BLOCKS = 16  # of each robot
_WARM = 100  # frames of a fresh robot before it is timed
_SETTLED = 5_000  # frames of the old one before its memory counts: it has read all of its lap
_AT_HOME = 8  # logs of the town whose map is used
_LAP = 2  # of these, that which is driven
_REPORTS = 20  # of memory, at most, each after at least so many frames as settle it


def localising(frames: int) -> Iterator[Figure]:
    """A step of a robot that has driven so far ÷ that of a fresh one."""
    pairs = load_bench_data().small

    def pair_at(number: int) -> StereoPair:
        at = number % (2 * len(pairs) - 2)
        pair = pairs[min(at, 2 * len(pairs) - 2 - at)]
        return dataclasses.replace(pair, stamp_ns=(number + 1) * _PERIOD_NS)

    with tempfile.TemporaryDirectory(prefix="engram-soak-") as folder:
        path = Path(folder) / "clip.engram"
        with open_map(path, create=True) as opened:
            robot = opened.robot(pairs[0].camera, name="mapper", maps=True)
            with robot:
                for number in range(len(pairs)):
                    robot.step(pair_at(number))
        with Map.open(path) as opened:
            yield from aged(lambda: opened.robot(pairs[0].camera), pair_at, frames)


def aged(
    robot: Callable[[], AbstractContextManager[Robot]],
    frame_at: Callable[[int], StereoPair | LoggedFrame],
    frames: int,
) -> Iterator[Figure]:
    """What a robot's memory grew by in so many frames, and its blocks against a fresh one's."""
    settled = min(_SETTLED, frames)
    with robot() as old:
        drive(old, frame_at, range(settled))
        before_mb = resident_mb()
        apart = max(_SETTLED, frames // _REPORTS)
        for first in range(settled, frames, apart):
            until = min(first + apart, frames)
            drive(old, frame_at, range(first, until))
            grown_mb = resident_mb() - before_mb
            yield Figure(f"memory, frames {settled:,} to {until:,}", grown_mb, "MB")
        with robot() as fresh:
            drive(fresh, frame_at, range(frames, frames + _WARM))
            drive(old, frame_at, range(frames, frames + _WARM))
            yield from compared(
                lambda first: drive(old, frame_at, range(first, first + _BLOCK)),
                lambda first: drive(fresh, frame_at, range(first, first + _BLOCK)),
                frames + _WARM,
                f"after {frames:,} frames",
                "fresh",
            )


def logged(
    frames: int,
    nodes: int,
    home: Path,
    others: Sequence[Path],
    *,
    lap: int = _LAP,
    maps: bool = False,
    memory_bytes: int | None = None,
) -> Iterator[Figure]:
    """The same from frame logs, in a map of so many nodes.

    Args:
        lap: number of the log that is driven.
        maps: whether robots map, too.
        memory_bytes: their limit.
    """
    logs = sorted(home.glob("*.framelog"))
    with tempfile.TemporaryDirectory(prefix="engram-soak-") as folder:
        path = Path(folder) / "fixed.engram"
        for log in logs[:_AT_HOME]:
            map_drive(path, open_drive(log), Settings(), RobotOptions())
        alone = (log for other in others for log in sorted(other.glob("*.framelog")))
        for log in (*logs[_AT_HOME:], *alone):
            with Map.open(path) as opened:
                if len(opened.graph) >= nodes:
                    break
            map_drive(path, open_drive(log), Settings(), RobotOptions(relocaliser=None))
        entries = [one for one in open_drive(logs[lap]) if isinstance(one, LoggedFrame)]
        with Map.open(path) as opened:
            yield Figure("nodes of the map", len(opened.graph))
            camera = entries[0].frame.camera
            robot = partial(opened.robot, camera, lanes=1, rounds=2, memory_bytes=memory_bytes)
            mapper = partial(_mapper, path, camera, memory_bytes)
            yield from aged(mapper if maps else robot, there_and_back(entries), frames)
            with robot() as judge:
                seen = map(judge.step, map(there_and_back(entries), range(2 * len(entries) - 2)))
                share = statistics.mean(one.localised for one in seen)
            yield Figure("share of a lap's frames localised", share)


def _copied(path: Path, folder: Path) -> Path:
    copy_map(path, folder / path.name)
    return folder / path.name


@contextmanager
def _mapper(path: Path, camera: StereoCamera, memory_bytes: int | None) -> Iterator[Robot]:
    """A robot that maps in a copy of a map."""
    with (
        tempfile.TemporaryDirectory(dir=path.parent) as folder,
        open_map(_copied(path, Path(folder))) as opened,
        opened.robot(
            camera, lanes=1, rounds=2, name="mapper", maps=True, memory_bytes=memory_bytes
        ) as robot,
    ):
        yield robot


def there_and_back(entries: Sequence[LoggedFrame]) -> Callable[[int], LoggedFrame]:
    """Frame by its number of a drive along the log and back in reverse, for ever."""
    last = len(entries) - 1

    def frame_at(number: int) -> LoggedFrame:
        phase = number % (2 * last)
        at = min(phase, 2 * last - phase)
        frame = dataclasses.replace(entries[at].frame, stamp_ns=(number + 1) * _PERIOD_NS)
        if number == 0:
            return LoggedFrame(frame, OdometryStep(OdometryStatus.FIRST))
        if 0 < phase <= last:
            return LoggedFrame(frame, entries[at].odometry)
        step = entries[at + 1].odometry
        if step.prev_from_curr is None:
            return LoggedFrame(frame, step)
        back = dataclasses.replace(step, prev_from_curr=step.prev_from_curr.inverse())
        return LoggedFrame(frame, back)

    return frame_at


def drive(
    robot: Robot, frame_at: Callable[[int], StereoPair | LoggedFrame], numbers: range
) -> float:
    """Seconds of processor time that the robot's steps take."""
    arrived = [frame_at(number) for number in numbers] if len(numbers) <= _WARM else None
    started = time.process_time()
    for place, number in enumerate(numbers):
        robot.step(frame_at(number) if arrived is None else arrived[place])
    return time.process_time() - started


def compared(
    old: Callable[[int], float], fresh: Callable[[int], float], first: int, *names: str
) -> Iterator[Figure]:
    """The ratio of two robots' blocks, each pair of blocks of the same frames."""
    pairs: list[tuple[float, float]] = []
    for block in range(_BLOCKS):
        start = first + block * _BLOCK
        if block % 2:
            of_old, of_fresh = old(start), fresh(start)
        else:
            of_fresh, of_old = fresh(start), old(start)
        pairs.append((of_old, of_fresh))
    low, ratio, high = statistics.quantiles([a / b for a, b in pairs], n=4)
    for name, times in zip(names, zip(*pairs, strict=True), strict=True):
        yield Figure(f"a frame {name}", 1e3 * statistics.median(times) / _BLOCK, "ms")
    for name, value in (("median", ratio), ("lower quartile", low), ("upper quartile", high)):
        yield Figure(f"ratio, {name}", value)


def resident_mb() -> float:
    """Memory of the process, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("localising", "logged"))
    parser.add_argument("--logs", nargs="+", type=Path, help="folders of frame logs, HOME first")
    parser.add_argument("--frames", type=int, default=7000)
    parser.add_argument("--nodes", type=int, default=4_000)
    parser.add_argument("--maps", action="store_true", help="logged: the robots map, too")
    parser.add_argument("--drive", type=int, default=_LAP, help="logged: which log of HOME, from 0")
    parser.add_argument("--memory", type=int, help="logged: the robots' limit, MB")
    given = parser.parse_args()
    if given.what == "localising":
        figures = localising(given.frames)
    elif given.logs:
        home, *others = given.logs
        figures = logged(
            given.frames,
            given.nodes,
            home,
            others,
            lap=given.drive,
            maps=given.maps,
            memory_bytes=given.memory and given.memory * 10**6,
        )
    else:
        parser.error("logged: name folders by --logs")
    report(figures, given.json, given.what)


if __name__ == "__main__":
    main()
