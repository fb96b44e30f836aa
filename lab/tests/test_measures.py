"""Failure curves, intervals, pose errors, ground truth and wheels, against cases by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.sequences.synthetic import only_engram_errors, write_log

from engram.errors import InputError
from engram.geometry.se3 import SE3
from engram.measures import FORMULAS, Drive, Estimator, failure, failure_sums, gaps
from engram.sequences.motion_files import Trajectory, read_kitti_poses, write_tum
from engram.sequences.opening import open_drive
from engram_lab.accuracy import PoseErrors
from engram_lab.intervals import Resamples, SessionSums, difference, excess_ratio, ratio
from engram_lab.truth import read_matrix_truth, read_truth, truth_path
from engram_lab.wheels import SCALE, Wheels, measured


def sums(numerator, denominator) -> SessionSums:
    return SessionSums(np.array(numerator, float), np.array(denominator, float))


def test_a_measure_is_pooled_over_sessions_not_averaged() -> None:
    # 1 of 2 m and 0 of 8 m missed: a tenth of the way, though half of the first session.
    assert sums([1, 0], [2, 8]).value == pytest.approx(0.1)


def test_two_sessions_draw_as_two_coins_do() -> None:
    # Drawn with replacement both are the first in a quarter of the cases, both the second in
    # another: the middle half is the pooled value, the 90 % interval reaches the ends.
    resamples = Resamples.of(2, 4000, seed=1)
    measure = sums([1, 0], [1, 1])
    interval = resamples.interval(measure)
    assert (interval.estimate, interval.low, interval.high) == (0.5, 0.0, 1.0)
    assert resamples.interval(measure, level=0.4).low == 0.5


def test_equal_sessions_leave_no_doubt() -> None:
    interval = Resamples.of(5, 100).interval(sums([3] * 5, [10] * 5))
    assert interval.low == interval.high == interval.estimate == pytest.approx(0.3)


def test_a_paired_difference_is_certain_where_every_session_agrees() -> None:
    resamples = Resamples.of(4, 500)
    a, b = sums([1, 2, 3, 4], [10] * 4), sums([2, 3, 4, 5], [10] * 4)
    interval = resamples.interval(difference(a, b))
    assert interval.low == pytest.approx(interval.high) == pytest.approx(-0.1)
    assert resamples.interval(a).high - resamples.interval(a).low > 0.05


def test_excess_is_counted_above_the_bound() -> None:
    a, b, bound = sums([9], [10]), sums([3], [10]), sums([1], [10])
    ones = np.ones((1, 1))
    assert excess_ratio(a, b, bound)(ones)[0] == pytest.approx(4.0)
    assert ratio(a, b)(ones)[0] == pytest.approx(3.0)
    assert ratio(a, b, added=0.3)(ones)[0] == pytest.approx(2.0)
    # What reaches the bound is infinitely better than what does not, and as good as its like.
    assert np.isinf(excess_ratio(a, bound, bound)(ones)[0])
    assert np.isnan(excess_ratio(bound, bound, bound)(ones)[0])


def test_the_same_seed_gives_the_same_interval() -> None:
    measure = sums([1, 5, 2, 0, 7], [10, 11, 9, 12, 10])
    first, again, other = (Resamples.of(5, 200, seed).interval(measure) for seed in (3, 3, 4))
    assert first == again
    assert first != other


@given(st.lists(st.tuples(st.floats(0, 10), st.floats(0.1, 10)), min_size=1, max_size=12))
def test_an_interval_lies_within_the_sessions_extremes(parts) -> None:
    above, below = zip(*parts, strict=True)
    interval = Resamples.of(len(parts), 200).interval(sums(above, below))
    shares = np.array(above) / np.array(below)
    slack = 1e-9  # rounding of the weighted sums
    assert shares.min() - slack <= interval.low <= interval.high <= shares.max() + slack


def test_draws_of_other_sessions_are_refused() -> None:
    with pytest.raises(InputError, match=r"over 3 sessions .* as many sessions as there are"):
        Resamples.of(2).interval(SessionSums(np.ones(3), np.ones(3)))


def test_no_sessions_are_refused() -> None:
    with pytest.raises(InputError, match="0 sessions"):
        Resamples.of(0)
    with pytest.raises(InputError, match="one length"):
        SessionSums(np.zeros(2), np.zeros(3))


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


def test_a_success_more_than_a_metre_or_five_degrees_off_is_false() -> None:
    errors = PoseErrors(np.array([1.0, 1.001, 0.0]), np.deg2rad([0.0, 0.0, 5.1]))
    assert errors.false.tolist() == [False, True, True]


@given(content=st.one_of(st.binary(max_size=80), st.text(max_size=60).map(str.encode)))
def test_any_bytes_give_our_errors_or_a_trajectory(tmp_path_factory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("any") / "a.txt"
    path.write_bytes(content)
    only_engram_errors(lambda: read_matrix_truth(path))
    only_engram_errors(lambda: read_kitti_poses(path, [0, 1]))


def test_the_truth_of_a_log_stands_beside_it(tmp_path: Path) -> None:
    log = write_log(tmp_path / "monday.framelog")
    assert read_truth(log) is None
    stamps_ns = np.arange(5) * 10**9
    write_tum(truth_path(log), Trajectory(stamps_ns, [SE3.identity()] * 5))
    assert (tmp_path / "monday.truth.txt").exists()
    found = read_truth(log)
    assert found is not None
    assert len(found) == 5


@pytest.mark.data
def test_kitti_poses_belong_to_the_frames(data_dir: Path) -> None:
    drive = open_drive(data_dir / "kitti_odometry/sequences/06")
    truth = read_kitti_poses(data_dir / "kitti_odometry/poses/06.txt", drive.stamps_ns)
    np.testing.assert_allclose(truth.world_from_cam[0].matrix(), np.eye(4), atol=1e-6)
    steps = [
        (one.inverse() @ other).distance_m
        for one, other in zip(truth.world_from_cam, truth.world_from_cam[1:], strict=False)
    ]
    assert sum(steps) == pytest.approx(59.9, abs=0.05)  # as stated beside the data


@pytest.mark.data
def test_euroc_truth_has_a_pose_for_every_pair(data_dir: Path) -> None:
    folder = data_dir / "euroc/V1_01_easy_sparse"
    truth = read_matrix_truth(folder / "poses_world_from_rectified_cam0.txt")
    stamps_ns = open_drive(folder).stamps_ns
    assert truth.stamps_ns.tolist() == stamps_ns.tolist()


FRAMES = 150
STAMPS = [at * 10**8 for at in range(FRAMES)]
# Sets off, and goes on at 1 m a step.
LENGTHS_M = np.minimum(np.arange(FRAMES) * 0.1, 1.0)
TRUTH = [SE3(np.eye(3), np.array([0.0, 0.0, at])) for at in np.cumsum(LENGTHS_M)]


def ways_m(wheels: Wheels) -> np.ndarray:
    found = measured(TRUTH, STAMPS, 3, wheels)
    assert found[0] is None
    return np.array([one.prev_from_curr.translation[2] for one in found[1:] if one is not None])


@pytest.mark.parametrize(
    ("wheels", "gain"), [(Wheels.RIGHT, 1.0), (Wheels.SIGN, -1.0), (Wheels.SCALED, 1.3)]
)
def test_a_constant_fault_scales_the_way(wheels: Wheels, gain: float) -> None:
    np.testing.assert_allclose(ways_m(wheels), SCALE * gain * LENGTHS_M[1:], rtol=0.05)


def test_late_wheels_measure_what_was_three_frames_ago() -> None:
    late = np.r_[np.zeros(3), LENGTHS_M[1:-3]]
    np.testing.assert_allclose(ways_m(Wheels.LATE), SCALE * late, rtol=0.05, atol=1e-9)


def test_wheels_stick_from_a_third_of_the_drive_on() -> None:
    stuck, held = ways_m(Wheels.STUCK), ways_m(Wheels.HELD)
    assert (stuck[60:] == 0).all()
    assert (stuck[12:49] > 0.9).all()
    assert np.ptp(held[60:]) < 1e-9
    assert held[60] == pytest.approx(SCALE, rel=0.05)


def test_slipping_wheels_turn_too_far_now_and_then() -> None:
    gains = ways_m(Wheels.SLIPPING) / LENGTHS_M[1:]
    slips = gains > 1.2
    assert 0.05 < slips.mean() < 0.6
    assert gains.max() < 3.2
