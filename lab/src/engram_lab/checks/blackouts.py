"""How soon a robot is found again after its cameras were black for 50 m: five seconds at 10 m/s.

A drive of a town is mapped, others are localised in it, each many times, with a blackout at another
place. Wheels measure 2 % too much and scatter by 1 %; the gyroscope has a bias of 0.01 rad/s, noise
of 0.002 rad/s, and two seconds of rest at the start. Each is compared with visual odometry alone.
Nothing looks for a lost robot: what is found is found by dead reckoning.

python -m engram_lab.checks.blackouts MAPPED LIVE …     # frame logs with their truth
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import FrameStatus
from engram.geometry.se3 import SE3
from engram.graph.model import Node
from engram.localiser.localisation import Localisation, LocalisationStatus, Position
from engram.maps.map import open_map
from engram.odometry.outside import OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.motion import Trajectory
from engram.sequences.opening import open_drive
from engram.sequences.sequence import LoggedFrame
from engram_lab.truth import read_truth
from engram_lab.wheels import BIAS_RAD_S, measured

BLACK_M = 50.0
_REST = 20
_SETTLED_M, _APART_M = 20.0, 15.0
# A pose this far from the truth is wrong, m.
_WRONG_M = 1.0


@dataclass(frozen=True, slots=True)
class Found:
    """Result of one blackout.

    Attributes:
        way_m: driven in the dark.
        frames: from the first bright one until the first match; None if none came.
        off_m: of that match's pose from the truth.
    """

    way_m: float
    frames: int | None
    off_m: float


def blackout(frames: list[LoggedFrame], first: int, last: int) -> Iterator[LoggedFrame]:
    """The frames with those from `first` to `last` black; odometry does not bridge the gap."""
    for number, one in enumerate(frames):
        if first <= number <= last:
            step = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
            yield LoggedFrame(replace(one.frame, status=FrameStatus.DARK), step)
        elif number == last + 1:
            yield LoggedFrame(one.frame, OdometryStep(OdometryStatus.NO_CONSENSUS))
        else:
            yield one


def at_rest(first: LoggedFrame) -> Iterator[tuple[LoggedFrame, OutsideMotion | None]]:
    """The first frame again and again, from before the start."""
    still = OdometryStep(OdometryStatus.OK, SE3.identity(), 1e-6 * np.eye(6), 200)
    for number in range(_REST, 0, -1):
        frame = replace(first.frame, stamp_ns=first.frame.stamp_ns - number * 10**8)
        step = first.odometry if number == _REST else still
        motion = OutsideMotion(SE3.identity(), 0.1, True, BIAS_RAD_S)
        yield LoggedFrame(frame, step), None if number == _REST else motion


def trial(
    map_path: Path, log: FrameLog, truths: dict[str, Trajectory], first_m: float, aided: bool
) -> Found:
    """One blackout."""
    frames = list(log)
    stamps_ns = [one.frame.stamp_ns for one in frames]
    truth = [truths["live"].world_from_cam[k] for k in range(len(frames))]
    driven_m = _driven_m(truth)
    first = int(np.searchsorted(driven_m, first_m))
    last = int(np.searchsorted(driven_m, driven_m[first] + BLACK_M)) - 1
    outside = measured(truth, stamps_ns, seed=first)
    way_m = float(driven_m[last + 1] - driven_m[first - 1])
    with (
        open_map(map_path) as opened,
        robot_on(opened, log, Settings(), RobotOptions(relocaliser=None)) as robot,
    ):
        robot.place_at(_start(truths["mapped"], truth[0], opened.graph.nodes))
        for arrived, motion in at_rest(frames[0]):
            robot.step(arrived, motion=motion if aided else None)
        bridged = OutsideMotion(SE3.identity(), 0.1, True, BIAS_RAD_S)
        for number, one in enumerate(blackout(frames, first, last)):
            if number == 0:
                still = OdometryStep(OdometryStatus.OK, SE3.identity(), 1e-6 * np.eye(6), 200)
                one = LoggedFrame(one.frame, still)  # noqa: PLW2901
            motion = (outside[number] or bridged) if aided else None
            found = robot.step(one, motion=motion)
            if number > last and found.status is LocalisationStatus.LOCALISED:
                off_m = _off_m(found, truths["mapped"], truth[number], opened.graph.nodes)
                return Found(way_m, number - last - 1, off_m)
            if number > last + 60:
                break
    return Found(way_m, None, np.nan)


def _driven_m(truth: Sequence[SE3]) -> NDArray[np.float64]:
    """(F,) distance from the start to each frame, metres."""
    steps = [(truth[k - 1].inverse() @ truth[k]).distance_m for k in range(1, len(truth))]
    return np.concatenate([[0.0], np.cumsum(steps)])


def _start(mapped: Trajectory, live: SE3, nodes: Sequence[Node]) -> Position:
    """The robot's place at the start, by the truth."""
    there = [
        (node.id, world_from_node)
        for node in nodes
        if (world_from_node := mapped.at(node.stamp_ns)) is not None
    ]
    node, world_from_node = min(there, key=lambda one: (one[1].inverse() @ live).distance_m)
    node_from_live = world_from_node.inverse() @ live
    return Position(node, node_from_live, np.diag([0.3**2] * 3 + [0.05**2] * 3))


def _off_m(found: Localisation, mapped: Trajectory, live: SE3, nodes: object) -> float:
    """Distance of a pose from the truth, metres."""
    stamps = {one.id: one.stamp_ns for one in nodes}  # type: ignore[attr-defined]
    assert found.node is not None
    assert found.node_from_live is not None
    world_from_node = mapped.at(stamps[found.node])
    assert world_from_node is not None
    return ((world_from_node @ found.node_from_live).inverse() @ live).distance_m


def main() -> None:
    """Prints one line for each drive, aided and not."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mapped", type=Path)
    parser.add_argument("live", type=Path, nargs="+")
    parser.add_argument("--most", type=int, default=20, help="blackouts of a drive")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        map_path = Path(folder) / "town.engram"
        mapped = open_drive(asked.mapped)
        map_drive(map_path, mapped)
        for path in asked.live:
            log = open_drive(path)
            assert isinstance(log, FrameLog)
            truths = {"mapped": read_truth(asked.mapped), "live": read_truth(path)}
            assert truths["live"] is not None
            length_m = _driven_m(truths["live"].world_from_cam)[-1]
            starts = np.arange(_SETTLED_M, length_m - BLACK_M - 10, _APART_M)[: asked.most]
            for aided in (True, False):
                kept: list[Found] = [
                    trial(map_path, log, truths, float(at), aided)  # type: ignore[arg-type]
                    for at in starts
                ]
                print(
                    f"{path.stem}, {'wheels and gyro' if aided else 'cameras alone'}: "
                    + summary(kept),
                    flush=True,
                )


def summary(kept: list[Found]) -> str:
    """One line for people."""
    frames = [one.frames for one in kept if one.frames is not None]
    wrong = sum(one.off_m > _WRONG_M for one in kept if one.frames is not None)
    soon = sum(one <= 2 for one in frames)
    return (
        f"{len(kept)} blackouts of {np.median([one.way_m for one in kept]):.0f} m (median): found "
        f"again {len(frames)}, within 3 frames {soon}, largest {max(frames, default=-1) + 1} "
        f"frames, wrong {wrong}"
    )


if __name__ == "__main__":
    main()
