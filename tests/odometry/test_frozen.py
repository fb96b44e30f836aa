"""Old pictures under new stamps, with and without a text or noise on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.odometry.outside import FrozenConfig, OutsideMotion, Repeats, StandsStill, rests
from engram_lab.bench.data import synthetic_drive
from engram_lab.studies.faults.injected import brightened, halved, on_both, written

AHEAD = SE3(np.eye(3), np.array([0.0, 0.0, 0.2]))
STILL = SE3(np.eye(3), np.array([0.0, 0.0, 0.001]))
TURN = SE3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.06, 0.0]))


@pytest.fixture(scope="module")
def pairs() -> list[StereoPair]:
    return [halved(one, 4.0) for one in synthetic_drive(frames=4, step_m=0.8)]


def noisy(pair: StereoPair, sigma: float, seed: int) -> StereoPair:
    rng = np.random.default_rng(seed)
    return on_both(
        pair,
        lambda one: np.clip(np.rint(one + rng.normal(0, sigma, one.shape)), 0, 255).astype(
            np.uint8
        ),
    )


def seen(shown: list[StereoPair]) -> list[tuple[bool, bool]]:
    repeats = Repeats(FrozenConfig())
    return [repeats.sides(one) for one in shown]


def test_a_repeated_picture_is_old(pairs) -> None:
    assert seen([pairs[0], pairs[0]]) == [(False, False), (True, True)]


def test_a_text_burnt_in_does_not_make_it_new(pairs) -> None:
    stamped = [
        on_both(pairs[0], lambda one, k=k: written(one, f"12:00:{k:02d}.1")) for k in range(3)
    ]
    assert seen(stamped)[1:] == [(True, True)] * 2


def test_one_side_may_be_old_alone(pairs) -> None:
    assert seen([pairs[0], replace(pairs[1], right=pairs[0].right)])[1] == (False, True)


def test_pictures_that_alternate_are_old(pairs) -> None:
    assert seen([pairs[0], pairs[1], pairs[0], pairs[1]])[2:] == [(True, True)] * 2


@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.0])
def test_a_sensor_at_rest_gives_new_pictures(pairs, sigma) -> None:
    assert seen([noisy(pairs[0], sigma, k) for k in range(3)]) == [(False, False)] * 3


def test_the_dark_tells_nothing(pairs) -> None:
    dark = on_both(pairs[0], lambda one: brightened(one, 0.001))
    assert seen([dark, dark]) == [(False, False)] * 2


def stands(steps: list[tuple[SE3 | None, OutsideMotion | None]]) -> list[bool]:
    still = StandsStill(FrozenConfig())
    return [still.add(*one) for one in steps]


def test_wheels_that_turn_disprove_a_picture_that_stands_still() -> None:
    told = OutsideMotion(AHEAD, 0.1)
    assert stands([(STILL, told)] * 6) == [False, True, True, True, True, True]


def test_a_gyroscope_alone_disproves_it_too() -> None:
    told = OutsideMotion(TURN, 0.1, has_way=False, rates_rad_s=np.array([0.0, 0.6, 0.0]))
    assert stands([(STILL, told)] * 4)[-1]


@pytest.mark.parametrize("share", [0.3, 1.0, 1.5])
def test_a_robot_that_moves_is_believed(share) -> None:
    moved = SE3(np.eye(3), share * AHEAD.translation)
    assert not any(stands([(moved, OutsideMotion(AHEAD, 0.1))] * 20))


def test_a_slow_robot_is_believed() -> None:
    slow = SE3(np.eye(3), np.array([0.0, 0.0, 0.003]))
    assert not any(stands([(slow, OutsideMotion(slow, 0.1))] * 300))


def test_a_parked_robot_is_believed() -> None:
    parked = OutsideMotion(SE3.identity(), 0.1)
    assert not any(stands([(STILL, parked)] * 50))
    assert rests(parked, FrozenConfig())


def test_a_stream_that_goes_on_is_believed_again() -> None:
    told = OutsideMotion(AHEAD, 0.1)
    assert not any(stands([(STILL, told)] * 6 + [(AHEAD, told)] * 4)[-2:])


def test_without_wheels_nothing_is_disproved() -> None:
    assert not any(stands([(STILL, None)] * 20))
