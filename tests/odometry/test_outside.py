"""Motion from outside: what is learnt of it, where it is used, and where it is not believed."""

from __future__ import annotations

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram.odometry.motion import GapFiller
from engram.odometry.outside import OutsideConfig, OutsideModel, OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep

STEP_M, STEP_S = 1.0, 0.1
COVARIANCE = np.diag([1e-4] * 3 + [1e-6] * 3)


def wheels(way_m: float = STEP_M, turn_rad: float = 0.0, rates=None) -> OutsideMotion:
    pose = SE3.exp(np.array([0.0, 0.0, way_m, 0.0, turn_rad, 0.0]))
    return OutsideMotion(pose, STEP_S, True, rates)


def seen(way_m: float = STEP_M, turn_rad: float = 0.0, inliers: int = 100) -> OdometryStep:
    pose = SE3.exp(np.array([0.0, 0.0, way_m, 0.0, turn_rad, 0.0]))
    return OdometryStep(OdometryStatus.OK, pose, COVARIANCE, inliers)


LOST = OdometryStep(OdometryStatus.NO_CONSENSUS)
DARK = OdometryStep(OdometryStatus.UNUSABLE_FRAME)


def driven(model: OutsideModel, steps: int = 20, scale: float = 1.0) -> OutsideModel:
    for _ in range(steps):
        model.add(wheels(STEP_M * scale))
        model.compare(seen())
    return model


class TestLearning:
    def test_the_scale_of_wheels_is_learnt(self) -> None:
        model = driven(OutsideModel(), scale=0.98)
        assert model.scale == pytest.approx(1 / 0.98, rel=1e-6)
        model.add(wheels(0.98))
        guess = model.guess()
        assert guess is not None
        assert guess.prev_from_curr.distance_m == pytest.approx(1.0, abs=1e-6)

    def test_before_that_the_guess_is_vaguer(self) -> None:
        new, old = OutsideModel(), driven(OutsideModel())
        sigmas = []
        for model in (new, old):
            for _ in range(50):
                model.add(wheels())
            guess = model.guess()
            assert guess is not None
            assert guess.prev_from_curr.distance_m == pytest.approx(50.0)
            sigmas.append(guess.sigma_m)
        assert sigmas[0] > 2 * sigmas[1]
        assert sigmas[1] < 1.5  # of 50 m

    def test_slipping_wheels_change_no_scale_and_lose_trust(self) -> None:
        model = driven(OutsideModel(), 10)
        before = model.scale
        for number in range(1, 6):  # slips more and more
            model.add(wheels((1 + 0.15 * number) * STEP_M))
            model.compare(seen())
        assert model.scale == pytest.approx(before, rel=0.01)
        assert 0 < model.slip < 0.5
        model.add(wheels(1.6 * STEP_M))
        guess = model.guess()
        assert guess is not None
        assert guess.sigma_m > 0.2  # as much as wheels slip here
        for _ in range(20):
            model.compare(seen())
            model.add(wheels(1.7 * STEP_M))
        assert model.guess() is None

    @pytest.mark.parametrize("metres", [0.0, 3.0])
    def test_wheels_that_stick_or_spin_at_once_must_agree_anew(self, metres: float) -> None:
        model = driven(OutsideModel())
        model.add(wheels(metres))
        assert model.guess() is None  # from 10 m/s within 0.1 s
        assert model.moves is None
        model.compare(seen())
        driven(model, 5)
        model.add(wheels())
        assert model.guess() is not None

    def test_wheels_of_a_reversed_sign_are_left_aside(self) -> None:
        model = driven(OutsideModel(), 3, scale=-1.0)
        model.add(wheels(-STEP_M))
        assert model.slip == 1.0
        assert model.guess() is None

    @pytest.mark.parametrize("has_way", [True, False])
    def test_a_gyroscope_in_degrees_is_left_aside(self, has_way: bool) -> None:
        model, turn_rad = OutsideModel(), 0.02
        rates = np.array([0.0, np.rad2deg(turn_rad) / STEP_S, 0.0])
        way = STEP_M if has_way else 0.0
        told = OutsideMotion(
            wheels(way, np.rad2deg(turn_rad)).prev_from_curr, STEP_S, has_way, rates
        )
        for _ in range(3):
            model.add(told)
            model.compare(seen(turn_rad=turn_rad))
        model.add(told)
        assert model.slip == 1.0
        assert model.guess() is None

    def test_nothing_outside_overrules_the_first_step_of_odometry(self) -> None:
        model = OutsideModel()
        assert model.is_sure(seen(inliers=20))
        assert not model.is_sure(LOST)

    def test_the_bias_of_the_gyroscope_is_learnt_at_rest_only(self) -> None:
        bias = np.array([0.0, 0.02, 0.01])
        model = OutsideModel()
        for _ in range(10):
            model.add(wheels(0.0, rates=bias))
            model.compare(seen(0.0))
        np.testing.assert_allclose(model.bias_rad_s, bias, atol=1e-9)
        for _ in range(10):  # in a bend nothing is learnt
            model.add(wheels(STEP_M, 0.05, rates=np.array([0.0, 0.5, 0.0])))
            model.compare(seen(STEP_M, 0.05))
        np.testing.assert_allclose(model.bias_rad_s, bias, atol=1e-9)

    def test_the_bias_is_taken_out_of_turn_and_way(self) -> None:
        bias = np.array([0.0, 0.02, 0.0])
        model = OutsideModel()
        for _ in range(20):
            model.add(OutsideMotion(SE3.identity(), STEP_S, True, bias))
            model.compare(seen(0.0))
        for _ in range(50):  # straight on, as the biased gyroscope sees it
            twist = np.array([0.0, 0.0, 0.1, *(bias * STEP_S)])
            model.add(OutsideMotion(SE3.exp(twist), STEP_S, True, bias))
        guess = model.guess()
        assert guess is not None
        np.testing.assert_allclose(guess.prev_from_curr.translation, [0, 0, 5], atol=0.01)
        assert guess.prev_from_curr.angle_rad < 1e-4


class TestUse:
    def test_it_carries_on_over_dark_frames(self) -> None:
        model, gaps = OutsideModel(), GapFiller()
        gaps.motion(OdometryStep(OdometryStatus.FIRST), 0)
        for number in range(1, 21):
            model.add(wheels())
            gaps.motion(seen(), number * 10**8, model.guess())
            model.compare(seen())
        for number in range(21, 71):  # 50 frames, turning half-way: no constant speed
            model.add(wheels(STEP_M, 0.02 if number > 45 else 0.0))
            assert gaps.motion(DARK, number * 10**8, model.guess()).prev_from_curr is None
            model.compare(DARK)
        model.add(wheels(STEP_M, 0.02))
        motion = gaps.motion(LOST, 71 * 10**8, model.guess())
        expected = SE3.identity()
        for number in range(21, 72):
            turn = 0.02 if number > 45 else 0.0
            expected = expected @ SE3.exp(np.array([0, 0, STEP_M, 0, turn, 0]))
        assert motion.prev_from_curr is not None
        error = motion.prev_from_curr.inverse() @ expected
        assert error.distance_m < 0.01
        assert 0 < motion.guessed_m < 4.0  # wheels turn vaguely; a guess by the last speed has 25 m

    def test_a_frame_without_it_ends_its_use_until_the_next_usable_one(self) -> None:
        model = driven(OutsideModel())
        model.add(wheels())
        model.add(None)
        assert model.guess() is None
        model.compare(LOST)
        model.add(wheels())
        assert model.guess() is not None

    def test_it_overrules_doubtful_odometry_only(self) -> None:
        model = driven(OutsideModel())
        model.add(wheels())
        guess = model.guess()
        assert guess is not None
        short = seen(0.2, inliers=20)
        assert guess.contradicts(short.prev_from_curr, COVARIANCE, OutsideConfig().gate)
        assert not model.is_sure(short)
        assert model.is_sure(seen(0.2, inliers=90))  # many landmarks against slipping wheels

    def test_a_gyroscope_alone_gives_the_turn_of_a_guess(self) -> None:
        model, gaps = OutsideModel(), GapFiller()
        gaps.motion(OdometryStep(OdometryStatus.FIRST), 0)
        turn = SE3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.03, 0.0]))
        for number in range(1, 12):
            last = number == 11
            rates = np.array([0.0, 0.3 if last else 0.0, 0.0])
            pose = turn if last else SE3.identity()
            model.add(OutsideMotion(pose, STEP_S, False, rates))
            step = LOST if last else seen()
            motion = gaps.motion(step, number * 10**8, model.guess())
            model.compare(step)
        assert motion.prev_from_curr is not None
        assert motion.prev_from_curr.distance_m == pytest.approx(STEP_M, abs=1e-6)
        assert motion.prev_from_curr.angle_rad == pytest.approx(0.03, abs=1e-6)
