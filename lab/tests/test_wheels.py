"""Wheels of simulated robots measure what they should, and are wrong as they claim."""

from __future__ import annotations

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram_lab.wheels import SCALE, Wheels, measured

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
