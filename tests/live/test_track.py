"""Odometry as it goes out: it never jumps, and says how far it may be off."""

from __future__ import annotations

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram.live.driving import Step
from engram.live.process import Track
from engram.odometry.motion import GapFiller
from engram.odometry.step import OdometryStatus, OdometryStep

MS = 1_000_000
DARK = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
FAILED = OdometryStep(OdometryStatus.TOO_FEW_MATCHES)


def ahead(metres: float) -> OdometryStep:
    way = SE3(np.eye(3), np.array([0.0, 0.0, metres]))
    return OdometryStep(OdometryStatus.OK, way, np.eye(6) * 1e-6)


class Driven:
    """A robot with 10 frames a second, and where its track was."""

    def __init__(self) -> None:
        self.gaps, self.track, self.now_ms, self.way_m = GapFiller(), Track(), 0, [0.0]
        self.see(OdometryStep(OdometryStatus.FIRST))

    def see(self, step: OdometryStep, after_ms: int = 100) -> Track:
        self.now_ms += after_ms
        motion = self.gaps.motion(step, self.now_ms * MS)
        self.track = self.track.after(Step(motion), self.now_ms * MS)
        self.way_m.append(float(self.track.odom_from_live.translation[2]))
        return self.track

    @property
    def longest_step_m(self) -> float:
        return float(np.abs(np.diff(self.way_m)).max())

    @property
    def sigma_m(self) -> float:
        return float(np.sqrt(self.track.covariance[2, 2]))


@pytest.mark.parametrize("stood", [False, True])
def test_thirty_dark_seconds_bring_no_jump_and_no_false_certainty(stood: bool) -> None:
    """The robot drives on, or stands; nobody can tell, and the covariance covers both."""
    robot = Driven()
    for _ in range(10):
        robot.see(ahead(0.5))
    for _ in range(300):
        robot.see(DARK)
    assert robot.sigma_m > 50.0
    robot.see(FAILED)
    for _ in range(10):
        robot.see(ahead(0.0 if stood else 0.5))
    truth_m = 5.0 if stood else 5.0 + 150.0 + 0.5 * 11
    assert robot.longest_step_m <= 1.1
    assert abs(robot.way_m[-1] - truth_m) < 3 * robot.sigma_m


def test_a_short_gap_is_driven_through() -> None:
    robot = Driven()
    for _ in range(10):
        robot.see(ahead(0.5))
    for _ in range(3):
        robot.see(DARK)
    robot.see(ahead(2.0))
    assert robot.way_m[-1] == pytest.approx(7.0)
    assert robot.longest_step_m == pytest.approx(0.5)


@pytest.mark.parametrize("dark", [2, 4, 8, 12, 20])
@pytest.mark.parametrize("really_m_s", [0.0, 4.0, 7.0, 9.0, 12.0, 14.0, 20.0])
def test_a_wrong_guess_is_not_corrected_by_a_jump(dark: int, really_m_s: float) -> None:
    """Ten metres a second, and another speed while it was dark: no step back, and none of two."""
    robot = Driven()
    for _ in range(10):
        robot.see(ahead(1.0))
    for _ in range(dark):
        robot.see(DARK)
    way_m = 0.1 * really_m_s * (dark + 1)
    robot.see(ahead(way_m))
    for _ in range(5):
        robot.see(ahead(1.0))
    steps_m = np.diff(robot.way_m)
    assert steps_m.min() > -0.6
    assert steps_m.max() < 1.6
    assert abs(robot.way_m[-1] - (10.0 + way_m + 5.0)) < 3 * robot.sigma_m


def test_a_stop_that_was_not_seen_is_taken_at_once() -> None:
    robot = Driven()
    for _ in range(10):
        robot.see(ahead(1.0))
    for _ in range(4):
        robot.see(FAILED)
    robot.see(ahead(0.0))
    assert robot.way_m[-1] == robot.way_m[-2]


def test_a_turn_that_was_not_seen_is_not_made_up_for_at_once() -> None:
    robot = Driven()
    for _ in range(10):
        robot.see(ahead(1.0))
    for _ in range(4):
        robot.see(DARK)
    turned = SE3.exp(np.array([0.0, 0.0, 5.0, 0.0, 0.8, 0.0]))
    before = robot.track.odom_from_live
    after = robot.see(OdometryStep(OdometryStatus.OK, turned, np.eye(6) * 1e-6)).odom_from_live
    assert (before.inverse() @ after).angle_rad < 0.1
    assert np.sqrt(robot.track.covariance[4, 4]) > 0.3


def test_an_unplugged_camera_is_no_reason_to_jump() -> None:
    robot = Driven()
    for _ in range(10):
        robot.see(ahead(0.5))
    robot.see(FAILED, after_ms=30_000)
    assert robot.longest_step_m == pytest.approx(0.5)
    assert robot.sigma_m > 50.0


def test_a_start_that_was_not_seen_is_not_made_up_for_at_once() -> None:
    robot = Driven()
    for _ in range(3):
        robot.see(FAILED)
    robot.see(ahead(0.5))
    assert robot.longest_step_m == pytest.approx(0.5)
    assert 0.5 + 3 * robot.sigma_m > 2.0


def test_what_was_measured_over_a_pause_is_taken() -> None:
    """Wheels, or the same view: the robot did move in between."""
    robot = Driven()
    for _ in range(5):
        robot.see(ahead(0.5))
    robot.see(ahead(3.0), after_ms=600)
    assert robot.way_m[-1] == pytest.approx(5.5)
