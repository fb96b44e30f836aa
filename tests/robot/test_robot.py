"""The one loop: its way to the kernel, its time, and what it keeps."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from tests.builders import TOWN, TOWN_ROAD, drive

import engram
from engram import _core
from engram.errors import MapError
from engram.localiser.localisation import (
    Budget,
    Hint,
    Localisation,
    LocalisationStatus,
    Position,
    ResultSink,
)
from engram.localiser.localiser import Localiser
from engram.maps.map import open_map
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.mapping import map_drive
from engram.robot.robot import Robot
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on
from engram.sequences.opening import open_drive
from engram.sequences.sequence import LoggedFrame

PACKAGE = str(Path(engram.__file__).parent)


@pytest.fixture
def localiser(town: Path) -> Iterator[Localiser]:
    with open_map(town) as opened:
        first = opened.graph.node(0)
        camera = opened.load().cameras[first.camera]
        budget = Budget(1, 4)
        with localiser_in(opened, camera, Settings(), budget=budget, relocaliser=None) as made:
            made.place_at(Position.at(first.id))
            yield made


LIVE = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)


def frames_of_the_package() -> list[str]:
    """The Python functions of Engram on the stack, innermost last."""
    frame, names = sys._getframe(), []
    while frame is not None:
        if frame.f_code.co_filename.startswith(PACKAGE):
            names.append(frame.f_code.co_name)
        frame = frame.f_back
    return names[::-1]


def test_four_hops_from_the_loop_to_the_kernel(
    street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, kernel, stacks = tmp_path / "street.engram", _core.attempt, []
    map_drive(path, open_drive(street, frames="::2"))

    def attempt(*given):
        return kernel(*given)

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code is attempt.__code__:
            stacks.append(frames_of_the_package())

    monkeypatch.setattr(_core, "attempt", attempt)
    sequence = open_drive(street, frames="1::2")
    with (
        open_map(path) as opened,
        robot_on(opened, sequence, Settings(), RobotOptions(lanes=1, rounds=4)) as robot,
    ):
        sys.setprofile(watch)
        try:
            list(robot.drive(sequence))
        finally:
            sys.setprofile(None)
    # Odometry matches frames, too, and the yardstick those of the map.
    attempts = [stack for stack in stacks if "localise" in stack and "usual" not in stack]
    assert len(attempts) > 5
    for stack in attempts:
        # The kernel itself is the fourth hop; lambdas and wrappers would stand between.
        assert stack == ["drive", "step", "localise", "attempts", "matches"]


def test_a_frame_stamped_too_early_is_left_out_and_reported(localiser: Localiser) -> None:
    robot = Robot(Front(Settings()), localiser)
    for seen in LIVE[:4]:
        robot.step(seen.logged)
    assert robot.outcomes
    for earlier in (LIVE[3], LIVE[2]):
        left_out = robot.step(earlier.logged)
        assert robot.outcomes == []
        assert left_out.status is LocalisationStatus.NO_ODOMETRY
        assert left_out.node_from_live is None
    assert robot.step(LIVE[4].logged).localised
    assert {one.code for one in robot.diagnosis.findings} >= {
        "stamps_backwards",
        "stamps_repeated",
    }


def set_back(at: int) -> list[LoggedFrame]:
    """The drive, with a clock that was set back by an hour."""
    hour_ns = 3600 * 10**9
    return [
        LoggedFrame(
            replace(one.frame, stamp_ns=one.frame.stamp_ns - (k >= at) * hour_ns), one.odometry
        )
        for k, one in enumerate(LIVE[:14])
    ]


def test_a_robot_goes_on_with_a_clock_that_is_set_back(localiser: Localiser) -> None:
    robot = Robot(Front(Settings()), localiser)
    frames = set_back(4)
    found = [robot.step(one) for one in frames]
    assert [one.localised for one in found] == [True] * 4 + [False] * 2 + [True] * 8
    assert [one.stamp_ns for one in found] == [one.frame.stamp_ns for one in frames]
    # Nothing of the way is missing, and the times between frames are right.
    assert localiser.driven_m == pytest.approx(13 * 0.7, rel=0.03)
    times_ns = [one.stamp_ns for one in robot.track]
    assert np.diff(times_ns).max() < 4 * np.diff(times_ns).min()
    assert "clock_set" in {one.code for one in robot.diagnosis.findings}


def test_poses_are_asked_for_by_the_stamps_of_the_frames(localiser: Localiser) -> None:
    robot = Robot(Front(Settings()), localiser)
    found = [robot.step(one) for one in set_back(4)]
    for one in (found[2], found[8]):
        asked = robot.pose_at(one.stamp_ns)
        assert asked is not None
        assert one.position is not None
        np.testing.assert_array_equal(
            asked.node_from_live.matrix(), one.position.node_from_live.matrix()
        )


def test_where_images_do_not_go_on_with_a_clock_set_back_the_robot_was_carried(
    localiser: Localiser,
) -> None:
    """A bag that is played in a loop, or a simulator that is reset."""
    robot = Robot(Front(Settings()), localiser)
    failed = OdometryStep(OdometryStatus.TOO_FEW_MATCHES)
    frames = set_back(4)
    frames[4:7] = [replace(one, odometry=failed) for one in frames[4:7]]
    found = [robot.step(one) for one in frames[:7]]
    assert found[3].localised
    assert found[5].position is not None
    assert found[6].position is None


def test_a_clock_that_is_set_forwards_by_hours_is_reported_and_does_no_harm(
    localiser: Localiser,
) -> None:
    robot = Robot(Front(Settings()), localiser)
    frames = [
        replace(one.frame, stamp_ns=one.frame.stamp_ns + (k >= 6) * 3600 * 10**9)
        for k, one in enumerate(LIVE[:12])
    ]
    found = [
        robot.step(LoggedFrame(frame, one.odometry))
        for frame, one in zip(frames, LIVE[:12], strict=True)
    ]
    assert [k for k, one in enumerate(found) if not one.localised] == [6, 7]
    assert "stamp_jump" in {one.code for one in robot.diagnosis.findings}


def test_a_pose_between_two_frames_lies_between_them(localiser: Localiser) -> None:
    robot = Robot(Front(Settings()), localiser)
    found = [robot.step(seen.logged) for seen in LIVE[:8]]
    before, after = found[5], found[6]
    assert robot.pose_at(before.stamp_ns) is before.position
    between = robot.pose_at((before.stamp_ns + after.stamp_ns) // 2)
    assert between is not None
    assert between.node == before.position.node
    ahead_m = between.node_from_live.translation - before.position.node_from_live.translation
    np.testing.assert_allclose(ahead_m, [0.0, 0.0, 0.35], atol=0.02)
    assert between.sigma_m >= before.position.sigma_m
    assert robot.pose_at(after.stamp_ns + 10**9) is None
    assert robot.pose_at(found[0].stamp_ns - 1) is None


def test_ctrl_c_waits_for_the_end_of_a_step(
    localiser: Localiser, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Robot(Front(Settings()), localiser)
    robot.step(LIVE[0].logged)
    move = localiser.move

    def interrupted(motion) -> None:
        signal.raise_signal(signal.SIGINT)
        move(motion)

    monkeypatch.setattr(localiser, "move", interrupted)
    with pytest.raises(KeyboardInterrupt):
        robot.step(LIVE[1].logged)
    assert robot.pose_at(LIVE[1].frame.stamp_ns) is localiser.best_position
    assert localiser.driven_m == pytest.approx(0.7, abs=0.05)


def test_a_pose_beside_a_frame_that_was_only_followed_lies_between(localiser: Localiser) -> None:
    robot = Robot(Front(Settings()), localiser)
    for seen in LIVE[:4]:
        robot.step(seen.logged)
    robot.follow(LIVE[4].logged)
    robot.step(LIVE[5].logged)
    known, followed = (robot.pose_at(one.frame.stamp_ns) for one in LIVE[3:5])
    between = robot.pose_at((LIVE[3].frame.stamp_ns + LIVE[4].frame.stamp_ns) // 2)
    assert known is not None
    for later, ahead_m in ((followed, 0.7), (between, 0.35)):
        assert later is not None
        way_m = later.node_from_live.translation - known.node_from_live.translation
        np.testing.assert_allclose(way_m, [0.0, 0.0, ahead_m], atol=0.02)


def test_a_frame_at_which_the_map_failed_is_driven_all_the_same(
    localiser: Localiser,
) -> None:
    at_ns = LIVE[4].frame.stamp_ns

    class Failing(ResultSink):
        def hint(self, live, motion) -> Hint | None:
            if live.stamp_ns == at_ns:
                raise MapError("the disk failed")
            return None

    robot = Robot(Front(Settings()), localiser, Failing())
    known = [robot.step(seen.logged) for seen in LIVE[:4]][-1].position
    with pytest.raises(MapError, match="disk"):
        robot.step(LIVE[4].logged)
    robot.step(LIVE[5].logged)
    for stamp_ns, ahead_m in ((at_ns, 0.7), ((at_ns + LIVE[5].frame.stamp_ns) // 2, 1.05)):
        where = robot.pose_at(stamp_ns)
        way_m = where.node_from_live.translation - known.node_from_live.translation
        np.testing.assert_allclose(way_m, [0.0, 0.0, ahead_m], atol=0.03)


def test_a_robot_is_placed_and_lost_again(localiser: Localiser) -> None:
    robot = Robot(Front(Settings()), localiser)
    known = robot.step(LIVE[0].logged)
    assert known.localised
    robot.lose()
    lost = robot.step(LIVE[1].logged)
    assert lost.position is None
    assert not lost.localised
    moved = LIVE[1].odometry
    robot.place_at(known.position.carried_on(moved.prev_from_curr, moved.covariance))
    assert robot.step(LIVE[2].logged).localised


class Recording(ResultSink):
    """Notes what it hears; holds back what may still be withdrawn."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, int]] = []

    def hint(self, live, motion) -> Hint | None:
        self.heard.append(("hint", live.stamp_ns))
        return None

    def keep(self, live, found: Localisation) -> Localisation:
        self.heard.append(("keep", found.stamp_ns))
        return replace(found, saved=None)

    def withdrawn(self, found: Localisation) -> None:
        self.heard.append(("withdrawn", found.stamp_ns))


def test_a_keeper_hears_what_was_found_and_later_what_was_withdrawn(localiser: Localiser) -> None:
    result_sink = Recording()
    robot = Robot(Front(Settings()), localiser, result_sink)
    found = [robot.step(seen.logged) for seen in LIVE[:3]]
    robot.withdraw(found[1])
    stamps_ns = [one.stamp_ns for one in found]
    told = [(what, stamp) for stamp in stamps_ns for what in ("hint", "keep")]
    assert result_sink.heard == [*told, ("withdrawn", stamps_ns[1])]
    assert robot.pose_at(stamps_ns[1]) is None
    assert robot.pose_at(stamps_ns[2]) is not None


def test_what_a_keeper_knows_is_not_localised_again(localiser: Localiser) -> None:
    known = Robot(Front(Settings()), localiser).step(LIVE[0].logged)

    class Knowing(ResultSink):
        def hint(self, live, motion) -> Hint:
            return Hint(known.position, found=replace(known, stamp_ns=live.stamp_ns))

    found = Robot(Front(Settings()), localiser, Knowing()).step(LIVE[1].logged)
    assert found.node == known.node
    assert found.stamp_ns == LIVE[1].frame.stamp_ns
    assert localiser.position is known.position
