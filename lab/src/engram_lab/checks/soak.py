"""Whether a step costs the same after hours of driving, and in a large map.

    python -m engram_lab.checks.soak localising --frames 7000     # 3 minutes
    python -m engram_lab.checks.soak mapping --nodes 20000        # 5 minutes
    python -m engram_lab.checks.soak logged --frames 1000000 --nodes 4000 --logs HOME OTHER…

Localising: the bench's clip is driven there and back, image by image, in a map of itself. Then a
fresh robot takes the same frames, in blocks that alternate with those of the old one.

Mapping: a road of five lanes, 3 m apart and tied to each other, is a map of so many nodes. A robot
maps another lane, of frames that match none of theirs: every frame has the lanes beside it as
candidates. A second one does the same on a short road, in blocks that alternate. Place recognition
is off unless --relocaliser names one: it looks every node up among all places.

Logged: the first eight frame logs of folder HOME, drives of one town, become a map as usual. All
others are added by robots that cannot relocalise, which save all they see, until the map has so
many nodes; then it is not changed any more. The third log of HOME is driven there and back, at two
attempts a frame, and its old robot is compared with a fresh one as above.

Ratios are of processor time, all threads of the process: medians over blocks, with quartiles.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from engram.frontend.blobs import quantised_landmarks
from engram.frontend.frame import Frame, FrameStatus, StereoPair
from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, Node, NodeId
from engram.localiser.localisation import Position
from engram.maps.map import Map, open_map
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.mapping import map_drive
from engram.robot.robot import Robot
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram.sequences.sequence import LoggedFrame
from engram_lab.bench.data import load_bench_data
from engram_lab.programs import Figure, command_line, report
from engram_lab.synthetic_places import (
    CAMERA,
    DESCRIPTOR,
    FRONTEND,
    drive_of,
    landmark_bytes,
    node_of,
    stored,
)

_PERIOD_NS = 100_000_000
_BLOCK = 50  # frames
_BLOCKS = 16  # of each robot
_WARM = 100  # frames of a fresh robot before it is timed
_AT_HOME = 8  # logs of the town whose map is used
_REPORTED = 50_000  # frames between two reports of memory

_LANES, _APART_M, _TIED_EVERY = 5, 3.0, 4
_LANDMARKS = 200
_STEP_M = 0.2  # 2 m/s at 10 Hz: every fifth frame is saved
_SHARP = np.diag([0.01**2] * 3 + [0.0005**2] * 3)
_STEP_COVARIANCE = np.diag([0.002**2] * 3 + [2e-5**2] * 3)


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
    robot: Callable[[], Robot], frame_at: Callable[[int], StereoPair | LoggedFrame], frames: int
) -> Iterator[Figure]:
    """What a robot's memory grew by in so many frames, and its blocks against a fresh one's."""
    settled = min(1000, frames)
    with robot() as old:
        drive(old, frame_at, range(settled))
        before_mb = resident_mb()
        for first in range(settled, frames, _REPORTED):
            until = min(first + _REPORTED, frames)
            drive(old, frame_at, range(first, until))
            yield Figure(f"memory, frames 1,000 to {until:,}", resident_mb() - before_mb, "MB")
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


def logged(frames: int, nodes: int, home: Path, others: Sequence[Path]) -> Iterator[Figure]:
    """The same from frame logs, in a map of so many nodes."""
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
        entries = [one for one in open_drive(logs[2]) if isinstance(one, LoggedFrame)]
        with Map.open(path) as opened:
            yield Figure("nodes of the map", len(opened.graph))
            camera = entries[0].frame.camera
            robot = partial(opened.robot, camera, lanes=1, rounds=2)
            yield from aged(robot, there_and_back(entries), frames)
            with robot() as judge:
                lap = map(judge.step, map(there_and_back(entries), range(2 * len(entries) - 2)))
                share = statistics.mean(one.localised for one in lap)
            yield Figure("share of a lap's frames localised", share)


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


def mapping(nodes: int, few: int, relocaliser: str | None) -> Iterator[Figure]:
    """A mapped frame in a map of so many nodes ÷ one in a map of few."""
    with tempfile.TemporaryDirectory(prefix="engram-soak-") as folder:
        robots = []
        for count in (nodes, few):
            path = Path(folder) / f"{count}.engram"
            beside = write_road(path, count)
            with Map.open(path) as opened:
                robot = opened.robot(CAMERA, name="soak", maps=True, relocaliser=relocaliser)
            robot.place_at(Position(beside, SE3(np.eye(3), np.array([1.5, 0, 0])), _SHARP))
            robots.append(robot)
            drive(robot, lane_frame, range(_WARM))
        large, small = robots
        yield Figure("candidates of the last frame", large.step(lane_frame(_WARM)).candidates)
        small.step(lane_frame(_WARM))
        yield from compared(
            lambda first: drive(large, lane_frame, range(first, first + _BLOCK)),
            lambda first: drive(small, lane_frame, range(first, first + _BLOCK)),
            _WARM + 1,
            f"at {nodes:,} nodes",
            f"at {few:,}",
        )
        yield Figure("nodes saved", large.saving.nodes)
        for robot in robots:
            robot.close()


def write_road(path: Path, nodes: int) -> NodeId:
    """A map of five lanes; returns the node of the middle one where the robot begins."""
    length = nodes // _LANES
    blob = landmark_bytes(np.random.default_rng(0), None, _LANDMARKS)
    ahead = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    aside = SE3(np.eye(3), np.array([_APART_M, 0.0, 0.0]))
    lanes: list[list[Node]] = []
    with (
        Map.create(path) as store,
        store.begin_revision(author="soak", message="a road", configuration={}) as writer,
    ):
        for lane in range(_LANES):
            start_ns = 10**12 * (lane + 1)
            session = drive_of("soak", start_ns)
            writer.add_session(session, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND)
            saved = [node_of(session, start_ns + at * _PERIOD_NS, at) for at in range(length)]
            for at, node in enumerate(saved):
                writer.copy_node(stored(node, blob))
                if at:
                    kind = EdgeKind.ODOMETRY
                    writer.add_edge(Edge(saved[at - 1].id, node.id, kind, ahead, _SHARP))
                if lanes and at % _TIED_EVERY == 0:
                    kind = EdgeKind.PROXIMITY
                    writer.add_edge(Edge(lanes[-1][at].id, node.id, kind, aside, _SHARP))
            lanes.append(saved)
        writer.commit()
    # In the middle of a long road; a short one is just long enough.
    return lanes[_LANES // 2][max(2, length // 2 - 100)].id


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


def lane_frame(number: int) -> LoggedFrame:
    """A frame like no other, a step farther along the lane."""
    draws = np.random.default_rng(number)
    camera = CAMERA
    pixels = draws.uniform([20, 20], [620, 460], (_LANDMARKS, 2)).astype(np.float32)
    disparity_px = draws.uniform(4, 40, _LANDMARKS).astype(np.float32)
    landmarks = quantised_landmarks(
        pixels,
        disparity_px,
        np.full(_LANDMARKS, 0.1, np.float32),
        draws.integers(0, 256, (_LANDMARKS, 32), np.uint8),
        np.zeros(_LANDMARKS, np.uint8),
        camera,
    )
    stamp_ns = (number + 1) * _PERIOD_NS
    frame = Frame(stamp_ns, camera, landmarks, DESCRIPTOR, FRONTEND, FrameStatus.OK)
    if number == 0:
        return LoggedFrame(frame, OdometryStep(OdometryStatus.FIRST))
    motion = SE3(np.eye(3), np.array([0.0, 0.0, _STEP_M]))
    return LoggedFrame(frame, OdometryStep(OdometryStatus.OK, motion, _STEP_COVARIANCE, _LANDMARKS))


def resident_mb() -> float:
    """Memory of the process, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("localising", "mapping", "logged"))
    parser.add_argument("--logs", nargs="+", type=Path, help="folders of frame logs, HOME first")
    parser.add_argument("--frames", type=int, default=7000)
    parser.add_argument("--nodes", type=int, default=20_000)
    parser.add_argument("--few", type=int, default=1_000)
    parser.add_argument("--relocaliser", help="of the mapping robots; none if left out")
    given = parser.parse_args()
    if given.what == "localising":
        figures = localising(given.frames)
    elif given.what == "mapping":
        figures = mapping(given.nodes, given.few, given.relocaliser)
    elif given.logs:
        figures = logged(given.frames, given.nodes, given.logs[0], given.logs[1:])
    else:
        parser.error("logged: name folders by --logs")
    report(figures, given.json, given.what)


if __name__ == "__main__":
    main()
