"""Vague motion: guesses and steps of which odometry is unsure, one after the other.

At night in rain a robot's own headlamps seem to stand still, and so it seems to. Steps are too
short then, one after the other and for the same reason. Taken as independent, their errors would
hide in a standard deviation that grows by the root of their number.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


class VagueRun:
    """Guesses and vague steps in a row: their errors add up, not their variances.

    Args:
        clear_steps: so many steps that are not vague, in a row, end the run.
    """

    def __init__(self, clear_steps: int) -> None:
        self._clear_steps = clear_steps
        self._clear = 0
        # Sum of their standard deviations.
        self._sum_m = 0.0

    def variance_m2(self, sigma_m: float) -> float:
        """What one more step, so wrong by itself, adds to the variance of the distance."""
        return sigma_m * (sigma_m + 2.0 * self._sum_m)

    def go_on(self, sigma_m: float) -> None:
        """One more step, so wrong by itself."""
        self._sum_m += sigma_m
        self._clear = 0

    def adds_up(self, covariance: NDArray[np.float64], sigma_m: float) -> NDArray[np.float64]:
        """One more vague step: its (6, 6) covariance as part of the run, m and rad."""
        scale = np.ones(6)
        scale[:3] = math.sqrt(self.variance_m2(sigma_m)) / sigma_m
        self.go_on(sigma_m)
        return covariance * np.outer(scale, scale)

    def break_off(self) -> None:
        """A step that is not vague; one by itself may be wrong."""
        self._clear += 1
        if self._clear >= self._clear_steps:
            self._sum_m = 0.0
