"""What a program gives wrongly ends in an error that says so, and leaves the robot as it was."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from tests.builders import TOWN, TOWN_ROAD, drive

from engram.errors import ConfigError, IncompatibleError, InputError, SequenceError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.localiser.localisation import Position
from engram.maps.map import Map, open_map
from engram.odometry.motion import GapFiller, Motion
from engram.odometry.outside import OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.mapping import map_drive
from engram.robot.robot import Robot

LIVE = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)
CAMERA = LIVE[0].frame.camera
GREY = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
LATER_NS = 10**18


@pytest.fixture(scope="module")
def opened(town: Path) -> Iterator[Map]:
    with open_map(town) as opened:
        yield opened


@pytest.fixture
def robot(opened: Map) -> Iterator[Robot]:
    with opened.robot(CAMERA, relocaliser=None) as made:
        made.place_at(Position.at(opened.graph.node(0).id))
        assert made.step(LIVE[0].logged).localised
        yield made


@pytest.mark.parametrize(
    ("pair", "kind", "words"),
    [
        (None, InputError, "takes an engram.StereoPair"),
        (StereoPair(LATER_NS + 0.5, GREY, GREY, CAMERA), SequenceError, "stamp_ns is"),
        (StereoPair(2**64, GREY, GREY, CAMERA), SequenceError, "within 64 bits"),
        (StereoPair(LATER_NS, None, GREY, CAMERA), SequenceError, "left image is of NoneType"),
        (StereoPair(LATER_NS, GREY, GREY[1:], CAMERA), SequenceError, "right image .* must be"),
        (StereoPair(LATER_NS, GREY / 255, GREY, CAMERA), SequenceError, "left image .* float64"),
        (StereoPair(LATER_NS, GREY, GREY, None), SequenceError, "camera is None"),
        (
            StereoPair(LATER_NS, GREY, GREY, replace(CAMERA, fx=CAMERA.fx + 1)),
            IncompatibleError,
            "use a separate robot for each camera",
        ),
    ],
)
def test_a_pair_that_cannot_be_used_changes_nothing(robot: Robot, pair, kind, words: str) -> None:
    with pytest.raises(kind, match=words):
        robot.step(pair)
    assert robot.step(LIVE[1].logged).localised


@pytest.mark.parametrize(
    "given", [{"motion": np.eye(4)}, {"deadline_ms": float("nan")}, {"deadline_ms": "40"}]
)
def test_a_motion_or_deadline_of_the_wrong_kind_changes_nothing(robot: Robot, given) -> None:
    with pytest.raises(InputError, match=next(iter(given))):
        robot.step(LIVE[1].logged, **given)
    assert robot.step(LIVE[1].logged).localised


@pytest.mark.parametrize("later_ns", [0, LATER_NS])
def test_results_of_numpys_stamps_are_json(robot: Robot, later_ns: int) -> None:
    found = robot.step(StereoPair(np.int64(later_ns), GREY, GREY, CAMERA))
    assert json.loads(json.dumps(found.to_dict()))["stamp_ns"] == later_ns


MOVED = SE3(np.eye(3), np.array([0.0, 0.0, 0.7]))


@pytest.mark.parametrize(
    "motion",
    [
        OutsideMotion(SE3(np.eye(3), np.array([0.0, np.nan, 0.7])), 0.1),
        OutsideMotion(SE3(2 * np.eye(3), np.zeros(3)), 0.1),
        OutsideMotion(SE3(np.eye(3), np.array([0.0, 0.0, 1e300])), 0.1),
        OutsideMotion(np.eye(4), 0.1),
        OutsideMotion(MOVED, np.nan),
        OutsideMotion(MOVED, 0.1, True, np.zeros(4)),
        OutsideMotion(MOVED, 0.1, False, np.full(3, np.inf)),
        Motion(LIVE[1].odometry, MOVED, np.eye(3)),
    ],
)
def test_a_motion_that_no_robot_makes_changes_nothing(robot: Robot, motion) -> None:
    with pytest.raises(InputError):
        robot.step(LIVE[1].logged, motion=motion)
    assert robot.step(LIVE[1].logged).localised


def test_a_motion_that_nothing_tells_is_taken(robot: Robot) -> None:
    """As `GapFiller` has it where a drive begins with frames without odometry."""
    failed = OdometryStep(OdometryStatus.NO_CONSENSUS)
    gaps = GapFiller()
    gaps.motion(OdometryStep(OdometryStatus.FIRST), LIVE[0].frame.stamp_ns)
    unknown = gaps.motion(failed, LIVE[1].frame.stamp_ns)
    assert unknown.guessed_m == np.inf
    assert robot.step(LIVE[1].logged, motion=unknown).motion is unknown


def test_a_robot_is_placed_only_where_the_map_has_a_node(robot: Robot, opened: Map) -> None:
    node = opened.graph.node(0).id
    for wrong in (
        None,
        np.eye(4),
        Position.at(uuid4()),
        Position(node, SE3(np.eye(3), np.full(3, np.nan)), np.eye(6)),
        Position(node, SE3.identity(), np.eye(3)),
    ):
        with pytest.raises(InputError):
            robot.place_at(wrong)
    assert robot.step(LIVE[1].logged).localised


def test_a_closed_robot_says_so(opened: Map) -> None:
    with opened.robot(CAMERA) as robot:
        robot.step(LIVE[0].logged)
    with pytest.raises(InputError, match=r"closed; make another one with Map\.robot"):
        robot.step(LIVE[1].logged)


@pytest.mark.parametrize(
    ("camera", "options", "kind"),
    [
        (None, {}, InputError),
        (CAMERA, {"name": ""}, InputError),
        (CAMERA, {"name": 3}, InputError),
        (CAMERA, {"name": "caf\udce9"}, InputError),
        (CAMERA, {"lanes": 1.5}, ConfigError),
        (CAMERA, {"threads": 5.5}, ConfigError),
    ],
)
def test_what_makes_no_robot_is_named(opened: Map, camera, options, kind) -> None:
    with pytest.raises(kind, match=next(iter(options), "camera")):
        opened.robot(camera, **options)


def test_another_thread_may_ask_for_poses_during_a_step(robot: Robot) -> None:
    stamps_ns = [one.frame.stamp_ns - 1 for one in LIVE]
    ended, faults = threading.Event(), []

    def ask() -> None:
        while not ended.is_set():
            try:
                for stamp_ns in stamps_ns:
                    robot.pose_at(stamp_ns)
            except RuntimeError as fault:
                faults.append(fault)
                return

    asking, interval_s = threading.Thread(target=ask), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # changes of threads everywhere
    try:
        asking.start()
        for one in LIVE[1:]:
            robot.step(one.logged)
    finally:
        ended.set()
        asking.join()
        sys.setswitchinterval(interval_s)
    assert not faults
    assert robot.pose_at(stamps_ns[-1]) is not None


@pytest.mark.parametrize("given", ["sequences/06", Path("sequences/06"), [], None])
def test_what_is_not_a_drive_is_not_mapped_and_the_error_says_what_to_call(tmp_path, given) -> None:
    with pytest.raises(InputError, match=rf"{type(given).__name__} is not .*open_drive\(PATH\)"):
        map_drive(tmp_path / "town.engram", given)
    assert not list(tmp_path.iterdir())
