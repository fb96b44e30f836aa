"""Wheels and a gyroscope of simulated robots, right and wrong in all the ways that wheels are."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engram.geometry.se3 import SE3
from engram.odometry.outside import OutsideMotion

# Wheels measure too much and scatter, as shares; the gyroscope has a bias and noise.
SCALE, SCATTER = 1.02, 0.01
BIAS_RAD_S, NOISE_RAD_S = np.array([0.01, -0.01, 0.01]), 0.002
_LATE_S = 0.3
_SLIPS_EACH_S = 5.0


class Wheels(StrEnum):
    """How wheels may be."""

    RIGHT = "right"
    SIGN = "wrong sign"
    SCALED = "times 1.3"
    LATE = "0.3 s late"
    STUCK = "stuck at 0"
    HELD = "stuck at a speed"
    SLIPPING = "slipping"


def measured(
    truth: Sequence[SE3], stamps_ns: Sequence[int], seed: int, wheels: Wheels = Wheels.RIGHT
) -> list[OutsideMotion | None]:
    """What wheels and gyroscope measure between the frames.

    Late ones are late both; stuck ones stick from a third of the drive on; slipping ones turn 1.3
    to 3 times too far for 0.5 to 3 s, every five seconds or so.

    Args:
        truth: world_from_cam of each frame.
    """
    rng = np.random.default_rng(seed)
    seconds = np.diff(np.array(stamps_ns)) / 1e9
    true = _steps(truth, stamps_ns, _LATE_S if wheels is Wheels.LATE else 0.0)
    gains = _gains(wheels, seconds, np.random.default_rng([seed, 1]))
    found: list[OutsideMotion | None] = [None]
    held = np.zeros(3)
    for at, (step, step_s) in enumerate(zip(true, seconds.tolist(), strict=True)):
        rates = step.log()[3:] / step_s + BIAS_RAD_S + rng.normal(0, NOISE_RAD_S, 3)
        way = gains[at] * step.translation * (SCALE + rng.normal(0, SCATTER))
        held = held if wheels is Wheels.HELD and 3 * at > len(true) else way / step_s
        turn = SE3.exp(np.r_[np.zeros(3), rates * step_s]).rotation
        found.append(OutsideMotion(SE3(turn, held * step_s), step_s, True, rates))
    return found


def _steps(truth: Sequence[SE3], stamps_ns: Sequence[int], late_s: float) -> list[SE3]:
    """True motion between the frames, or what it was some time before; at rest before the start."""
    then = np.maximum(np.array(stamps_ns) - round(late_s * 1e9), stamps_ns[0])
    at = np.interp(then, stamps_ns, np.arange(len(truth)))
    poses = [_between(truth, float(one)) for one in at]
    return [a.inverse() @ b for a, b in pairwise(poses)]


def _between(truth: Sequence[SE3], at: float) -> SE3:
    """The pose at a fraction of a frame."""
    first = min(int(at), len(truth) - 2)
    step = (truth[first].inverse() @ truth[first + 1]).log()
    return truth[first] @ SE3.exp((at - first) * step)


def _gains(
    wheels: Wheels, seconds: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """(F − 1,) by what the wheels turn too far in each step."""
    at = np.arange(len(seconds))
    if wheels is Wheels.STUCK:
        return np.where(3 * at > len(at), 0.0, 1.0)
    if wheels is Wheels.SLIPPING:
        gains, since_s = np.ones(len(seconds)), np.cumsum(seconds)
        for start_s in np.arange(_SLIPS_EACH_S, since_s[-1], _SLIPS_EACH_S) + rng.uniform(-2, 2):
            slips = (since_s >= start_s) & (since_s < start_s + rng.uniform(0.5, 3.0))
            gains[slips] = rng.uniform(1.3, 3.0)
        return gains
    constant = {Wheels.SIGN: -1.0, Wheels.SCALED: 1.3}.get(wheels, 1.0)
    return np.full(len(seconds), constant)
