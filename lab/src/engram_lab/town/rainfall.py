"""When and how hard it rains: a process with the distribution of rates of a real place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray

STEP = timedelta(minutes=5)
# ITU-R P.837-7 for Oxford (51.76 N, 1.26 W): share of all time in which it rains harder, mm/h.
_RATES_MM_H = np.array([0.1, 1.0, 4.0, 9.0, 26.0])
_EXCEEDED = np.array([0.0566, 0.018, 0.0037, 0.001, 0.0001])
WET_SHARE = 0.0566
# Fronts pass in hours, showers within them in minutes: e-folding times in steps, and variances.
_PARTS = ((48.0, 0.75), (8.0, 0.25))
_MEMORY = 6  # e-foldings that are summed


_LEVELS = np.linspace(-6, 6, 4801)
_TAILS = np.array([0.5 * math.erfc(level / math.sqrt(2)) for level in _LEVELS])


def rates_exceeded(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rates, mm/h, that Oxford's rain exceeds in shares of all time; 0 where it is dry.

    They fall off exponentially between the tabled shares and beyond them, up to 60 mm/h.
    """
    logs, wanted = np.log(_EXCEEDED[::-1]), np.log(np.maximum(share, 1e-12))
    rates = np.interp(wanted, logs, _RATES_MM_H[::-1])
    slope = (_RATES_MM_H[-1] - _RATES_MM_H[-2]) / (logs[1] - logs[0])
    steep = rates + slope * np.maximum(logs[0] - wanted, 0)
    return np.where(share < WET_SHARE, np.minimum(steep, 60.0), 0.0)


@dataclass(frozen=True, slots=True)
class Rainfall:
    """The rain over a place.

    Attributes:
        seed: of one course of it.
        wet: share of the time in which it rains; how hard is as in Oxford all the same.
    """

    seed: int
    wet: float = WET_SHARE

    def rates_mm_h(self, steps: int) -> NDArray[np.float64]:
        """(steps,) rates, `STEP` apart; 0 where it is dry.

        A normal process, slow and quick, is cut where it exceeds what it exceeds `wet` of the
        time; above, each share of the time has the rate of the same share of Oxford's rain.
        """
        rng = np.random.default_rng([self.seed & 0x7FFFFFFF, 0x4A17])
        level = sum(
            np.sqrt(variance) * _persistent(rng, steps, lasting) for lasting, variance in _PARTS
        )
        exceeded = np.interp(np.asarray(level), _LEVELS, _TAILS)
        return rates_exceeded(exceeded * WET_SHARE / self.wet)

    def at(self, first: datetime, times: Sequence[datetime]) -> list[float]:
        """mm/h at each time, none before `first`."""
        steps = [int((when - first) / STEP) for when in times]
        rates = self.rates_mm_h(max(steps, default=0) + 1)
        return [float(rates[step]) for step in steps]

    def fallen_mm(self, steps: int) -> float:
        """What falls in so many steps."""
        return float(self.rates_mm_h(steps).sum() * (STEP / timedelta(hours=1)))


def _persistent(rng: np.random.Generator, steps: int, lasting: float) -> NDArray[np.float64]:
    """Normal noise (steps,) of variance 1 that forgets itself exponentially."""
    weights = np.exp(-np.arange(int(_MEMORY * lasting)) / lasting)
    weights /= np.sqrt((weights**2).sum())
    white = rng.standard_normal(steps + len(weights) - 1)
    return np.convolve(white, weights, mode="valid")
