"""Failure curves, comparisons and pose errors against cases worked by hand."""

import numpy as np
import pytest

from engram.errors import InputError
from engram.geometry.se3 import SE3
from engram.measures import FORMULAS, Drive, Estimator, failure, failure_sums, gaps
from engram_lab.accuracy import pose_errors


def drive(marks: str, step_m: float = 1.0) -> Drive:
    return Drive(np.full(len(marks), step_m), np.array([mark == "x" for mark in marks]))


def curve_at(drives, x: float, estimator: Estimator) -> float:
    parts = [failure_sums(one, np.array([x]), estimator) for one in drives]
    return sum(part[0][0] for part in parts) / sum(part[1] for part in parts)


def test_four_estimators_of_a_worked_case() -> None:
    # Gaps of 2, 1, 5 and 2 m, that of 1 m without a failure. Route at 1.5 m:
    # (0.5 + 3.5 + 0.5) / 10; gap: three of four; lost: three of three.
    worked = drive(".xx....x..")
    assert curve_at([worked], 1.5, Estimator.ROUTE) == pytest.approx(0.45)
    assert curve_at([worked], 1.5, Estimator.GAP) == pytest.approx(0.75)
    assert curve_at([worked], 1.5, Estimator.LOST) == pytest.approx(1.0)
    assert curve_at([worked], 2.5, Estimator.LOST) == pytest.approx(1 / 3)
    # From the first failed frame on: 1, 4 and 1 m.
    assert gaps([worked]).lost_m.tolist() == [1.0, 0.0, 4.0, 1.0]
    assert curve_at([worked], 1.5, Estimator.REACQUIRED) == pytest.approx(1 / 3)
    assert curve_at([worked], 1.0, Estimator.REACQUIRED) == pytest.approx(1.0)
    assert set(FORMULAS) == set(Estimator)


def test_a_curve_is_its_points() -> None:
    drives = [drive(".xx....x.."), drive("x....x", 1.7), drive("......")]
    at_m = np.array([0.0, 0.5, 1.0, 1.7, 2.0, 5.0, 8.5, 50.0])
    found = failure(drives, at_m)
    np.testing.assert_allclose(found, [failure(drives, float(x)) for x in at_m], atol=1e-12)
    by_session = [curve_at(drives, float(x), Estimator.ROUTE) for x in at_m]
    np.testing.assert_allclose(found, by_session, atol=1e-12)


def test_route_curve_begins_at_one_and_falls() -> None:
    curve = failure([drive("..x...x")], np.arange(0.0, 10.0, 0.5))
    assert curve[0] == 1.0
    assert (np.diff(curve) <= 0).all()
    assert curve[-1] == 0.0


def test_nothing_driven_has_no_failures() -> None:
    nothing = Drive(np.zeros(0), np.zeros(0, bool))
    assert failure([], np.array([1.0]))[0] == 0
    assert failure([nothing], np.array([1.0]))[0] == 0


def test_pose_errors_are_metres_and_angles() -> None:
    true = SE3(np.eye(3), np.array([1.0, 0.0, 2.0]))
    aside = SE3(np.eye(3), np.array([1.0, 0.3, 2.4]))
    turned = SE3.exp([0, 0, 0, 0, np.deg2rad(6.0), 0])
    errors = pose_errors([aside, SE3(turned.rotation, true.translation)], [true, true])
    np.testing.assert_allclose(errors.offset_m, [0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(errors.turn_rad), [0.0, 6.0], atol=1e-9)
    assert errors.false.tolist() == [False, True]


def test_a_success_more_than_a_metre_off_is_false() -> None:
    there = SE3.identity()
    just, beyond = (SE3(np.eye(3), np.array([x, 0.0, 0.0])) for x in (1.0, 1.001))
    assert pose_errors([just, beyond], [there, there]).false.tolist() == [False, True]
    with pytest.raises(InputError, match="1 estimated poses, but 2"):
        pose_errors([there], [there, there])
