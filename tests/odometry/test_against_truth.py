"""Steps are judged by steps as strong as they are, and weighed against wheels and gyroscope."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.geometry.se3 import SE3
from engram.odometry.motion import GapConfig, GapFiller, Motion
from engram.odometry.outside import OutsideModel, OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep

STEP_S = 0.1
FIRST = OdometryStep(OdometryStatus.FIRST)


def step(metres: float, inliers: int, sigma_m: float = 1e-3, turn_rad: float = 0.0) -> OdometryStep:
    pose = SE3.exp([0.0, 0.0, metres, 0.0, turn_rad, 0.0])
    covariance = np.diag([sigma_m**2] * 3 + [(sigma_m / 10) ** 2] * 3)
    return OdometryStep(OdometryStatus.OK, pose, covariance, inliers)


def moved(steps: list[OdometryStep], landmarks: int = 0) -> list[Motion]:
    gaps = GapFiller()
    gaps.motion(FIRST, 0)
    return [
        gaps.motion(one, at * 10**8, landmarks=landmarks) for at, one in enumerate(steps, start=1)
    ]


def way_m(motions: list[Motion]) -> float:
    return sum(one.moved_m for one in motions)


def sigma_m(motion: Motion) -> float:
    assert motion.covariance is not None
    return float(np.sqrt(motion.covariance[2, 2]))


STRONG = st.integers(300, 500)
# Less than 0.6 of the fewest strong ones.
WEAK = st.tuples(st.integers(20, 170), st.floats(-5.0, 5.0))
# Runs of strong steps, each with the change of speed from one to the next, m/s², and weak runs.
RUNS = st.lists(
    st.tuples(
        st.lists(st.tuples(STRONG, st.floats(-6.0, 6.0)), min_size=1, max_size=12),
        st.lists(WEAK, max_size=30),
    ),
    min_size=1,
    max_size=6,
)


@given(st.lists(WEAK, max_size=30), RUNS)
def test_weak_steps_never_replace_strong_ones(
    before: list[tuple[int, float]], runs: list[tuple[list[tuple[int, float]], list]]
) -> None:
    steps, metres = [step(length, count) for count, length in before], 1.0
    for strong, weak in runs:
        for count, change in strong:
            metres += change * STEP_S**2
            steps.append(step(metres, count))
        steps += [step(length, count) for count, length in weak]
    for one in moved(steps):
        if one.odometry.inliers >= 300:
            assert one.guessed_m == 0
            assert one.prev_from_curr is one.odometry.prev_from_curr


@given(st.lists(st.tuples(st.integers(20, 500), st.floats(-3.5, 3.5)), max_size=60))
def test_sharp_steps_of_usual_driving_pass_and_only_drift_is_added(
    steps: list[tuple[int, float]],
) -> None:
    metres, driven = 1.0, []
    for count, change in steps:
        metres += change * STEP_S**2
        driven.append(step(metres, count))
    for one in moved(driven):
        assert one.prev_from_curr is one.odometry.prev_from_curr
        assert one.covariance is not None
        assert one.odometry.covariance is not None
        added = one.covariance - one.odometry.covariance
        drift_m2 = GapConfig().drift_m ** 2 * one.moved_m
        np.testing.assert_allclose(added, np.diag([drift_m2] * 3 + [0.0] * 3), atol=1e-15)
        assert one.guessed_m == 0


@pytest.mark.parametrize("weak", [1, 3, 20])
def test_weak_first_steps_are_refuted_by_strong_ones(weak: int) -> None:
    motions = moved([step(3.6, 100)] * weak + [step(1.0, 500)] * 40)
    refuting = motions[weak]
    assert way_m(motions[weak:]) == pytest.approx(40.0)
    assert refuting.guessed_m == 0
    assert refuting.jumped  # the position rests on steps that were wrong
    assert sigma_m(refuting) == pytest.approx(2.6 * min(weak, 20), rel=0.01)
    assert not any(one.jumped or sigma_m(one) > 0.02 for one in motions[weak + 1 :])


def test_weak_first_steps_are_guesses_where_few_landmarks_agree() -> None:
    motions = moved([step(3.6, 100)] * 3 + [step(1.0, 500)] * 5, landmarks=1000)
    assert all(one.guessed_m >= 3.6 for one in motions[:3])
    assert not any(one.guessed_m or one.jumped for one in motions[3:])
    sure = moved([step(1.0, 100)] * 3, landmarks=400)
    assert not any(one.guessed_m for one in sure)


def test_a_drive_that_stays_weak_is_believed_after_a_while() -> None:
    motions = moved([step(0.7, 60)] * 40, landmarks=1000)
    assert [one.guessed_m > 0 for one in motions] == [True] * 30 + [False] * 10


@pytest.mark.parametrize("length_m", [3.6, 0.0, 0.4])
@pytest.mark.parametrize("run", [3, 12])
def test_a_weak_run_among_strong_ones_leaves_the_way_right(length_m: float, run: int) -> None:
    motions = moved([step(1.0, 500)] * 30 + [step(length_m, 100)] * run + [step(1.0, 500)] * 10)
    assert way_m(motions) == pytest.approx(40 + run, abs=0.01)


def test_a_long_weak_run_claims_nothing_until_strong_steps_come() -> None:
    """After two seconds nothing strong is known, and it may be right."""
    motions = moved([step(1.0, 500)] * 30 + [step(0.0, 100)] * 45 + [step(1.0, 500)] * 10)
    assert min(sigma_m(one) for one in motions[30:75]) > 0.4
    assert way_m(motions[75:]) == pytest.approx(10.0)


def test_three_strong_steps_do_not_overrule_all_that_come_after() -> None:
    """As strong, but fewer: five that agree are enough."""
    motions = moved([step(3.6, 500)] * 3 + [step(1.0, 500)] * 40)
    assert [one.guessed_m > 0 for one in motions] == [False] * 3 + [True] * 4 + [False] * 36


def test_a_robot_that_brakes_where_little_is_seen_is_believed() -> None:
    lengths_m = [max(1.0 - 0.03 * at, 0.0) for at in range(40)]
    motions = moved([step(1.0, 500)] * 30 + [step(one, 100) for one in lengths_m])
    assert not any(one.guessed_m for one in motions)


# What wheels may measure where the robot drives so far, and did three steps before.
FAULTS = {
    "none": lambda now, then, at: now,
    "too much": lambda now, then, at: 1.02 * now,
    "sign": lambda now, then, at: -now,
    "scaled": lambda now, then, at: 1.3 * now,
    "late": lambda now, then, at: then,
    "stuck": lambda now, then, at: 0.0 if at > 40 else now,
    "held": lambda now, then, at: 0.7 if at > 40 else now,
    "slipping": lambda now, then, at: 2.5 * now if at % 50 > 35 else now,
}


def with_wheels(
    steps: list[OdometryStep], wheels_m: list[float], landmarks: int = 0
) -> tuple[list[Motion], OutsideModel]:
    gaps, model = GapFiller(), OutsideModel()
    gaps.motion(FIRST, 0)
    motions = []
    for at, (one, metres) in enumerate(zip(steps, wheels_m, strict=True), start=1):
        pose = SE3(np.eye(3), np.array([0.0, 0.0, metres]))
        model.add(OutsideMotion(pose, STEP_S, rates_rad_s=np.zeros(3)))
        doubted = model.disproves(one, landmarks)
        motions.append(gaps.motion(one, at * 10**8, model.guess(), doubted=doubted))
        model.compare(one)
    return motions, model


_OFTEN = {"none", "slipping", "late"}


@pytest.mark.parametrize(
    "fault",
    [pytest.param(one, marks=[pytest.mark.long] * (one not in _OFTEN)) for one in FAULTS],
)
@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_sure_images_are_believed_whatever_wheels_measure(fault: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    metres = np.clip(1.0 + np.cumsum(rng.normal(0, 0.02, 120)), 0.3, 2.0)
    steps = [step(one, int(rng.integers(300, 500)), 0.01) for one in metres]
    wrong = FAULTS[fault]
    wheels_m = [wrong(metres[at], metres[max(at - 3, 0)], at) for at in range(120)]
    for alone, aided in zip(moved(steps), with_wheels(steps, wheels_m)[0], strict=True):
        assert aided.prev_from_curr is alone.prev_from_curr
        np.testing.assert_array_equal(aided.covariance, alone.covariance)
        assert not aided.guessed_m


def test_wheels_settle_what_vague_steps_cannot() -> None:
    """As at night in rain: a third of the steps are too short, with few inliers."""
    rng = np.random.default_rng(5)
    steps = [
        step(0.3 if at > 20 and rng.random() < 0.3 else rng.normal(0.7, 0.1), 60, 0.15)
        for at in range(200)
    ]
    aided, _ = with_wheels(steps, [1.02 * 0.7] * 200, landmarks=600)
    alone = moved(steps, landmarks=600)
    assert sum(abs(one.moved_m - 0.7) > 0.3 for one in alone) > 30
    assert sum(abs(one.moved_m - 0.7) > 0.3 for one in aided) == 0
    assert way_m(aided) == pytest.approx(140.0, rel=0.03)


def test_an_image_that_stands_still_is_disproved_by_wheels_that_turn() -> None:
    """A bonnet, a frozen image and headlamps agree well on no motion."""
    motions, model = with_wheels([step(0.0, 500)] * 60, [0.3] * 60)
    assert all(one.guessed_m for one in motions)
    assert way_m(motions) == pytest.approx(18.0)
    assert model.slip == 0


def test_wheels_found_wrong_do_not_disprove_that_a_robot_stands() -> None:
    steps = [step(1.0, 500)] * 30 + [step(0.0, 500)] * 30
    motions, _ = with_wheels(steps, [-1.0] * 30 + [-0.3] * 30)
    assert way_m(motions[40:]) == 0


def test_a_gyroscope_disproves_that_a_robot_does_not_turn() -> None:
    model = OutsideModel()
    for turn_rad in [0.0] * 10 + [0.05]:
        turn = SE3.exp([0.0, 0.0, 0.0, 0.0, turn_rad, 0.0])
        model.add(OutsideMotion(turn, STEP_S, False, np.array([0.0, 10 * turn_rad, 0.0])))
        if turn_rad:
            break
        model.compare(step(0.5, 400))
    assert model.disproves(step(0.0, 400))
    assert not model.disproves(step(0.5, 400, turn_rad=0.05))


def outside(way_m: float, turn_rad: float = 0.0, *, has_way: bool = True) -> OutsideModel:
    model = OutsideModel()
    turn = SE3.exp([0.0, 0.0, way_m, 0.0, turn_rad, 0.0])
    model.add(OutsideMotion(turn, STEP_S, has_way, np.array([0.0, turn_rad / STEP_S, 0.0])))
    return model


def test_whether_a_robot_moves_is_asked_of_wheels_and_gyroscope() -> None:
    assert OutsideModel().moves is None
    assert outside(0.3).moves
    assert outside(0.0).moves is False
    assert outside(0.0, 0.1).moves
    assert outside(0.0, 0.1, has_way=False).moves
    assert outside(0.0, has_way=False).moves is None  # it may drive straight on
    wrong = with_wheels([step(1.0, 500)] * 20, [-1.0] * 20)[1]
    wrong.add(OutsideMotion(SE3.identity(), STEP_S))
    assert wrong.moves is None


def test_the_bias_of_a_gyroscope_is_learnt_from_sure_images_on_a_straight_road() -> None:
    bias = np.array([0.0, 0.02, 0.01])
    model = OutsideModel()
    for _ in range(50):
        model.add(OutsideMotion(SE3.exp([0.0, 0.0, 1.0, *(0.1 * bias)]), STEP_S, True, bias))
        model.compare(step(1.0, 400))
    np.testing.assert_allclose(model.bias_rad_s, bias, atol=1e-6)
