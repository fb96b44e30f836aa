"""Failure curves by session, and confidence intervals by bootstrap over sessions (method §8).

Frames of one session share its light, weather and driving line, so that sessions, not frames, are
what is drawn again. Every measure here is a ratio of sums over sessions (metres without a match ÷
metres driven, and so on): a resample weighs the sessions' numerators and denominators alike.
Measures of one set of sessions are to be compared under the same draws: pass the same `Resamples`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.measures import Drive

Array = NDArray[np.float64]
# (N, S) weights of the sessions → (N,) values.
Statistic: TypeAlias = Callable[[Array], Array]

# Intervals are stated at this level throughout ("90 % interval").
LEVEL = 0.9


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimate and the ends of its confidence interval."""

    estimate: float
    low: float
    high: float

    @property
    def lower(self) -> bool | None:
        """Whether a difference is below 0; None if its interval does not lie clear of 0."""
        if self.high < 0:
            return True
        return False if self.low > 0 else None


@dataclass(frozen=True, slots=True, eq=False)
class Resamples:
    """How often each resample draws each session.

    Attributes:
        counts: (R, S) float64, non-negative whole numbers; each row sums to S.
    """

    counts: Array

    @staticmethod
    def of(sessions: int, resamples: int = 2000, seed: int = 0) -> Resamples:
        """Draws `sessions` sessions with replacement, `resamples` times."""
        if sessions < 1 or resamples < 1:
            raise InputError(f"cannot draw {resamples} times from {sessions} sessions")
        rng = np.random.default_rng(seed)
        shares = np.full(sessions, 1.0 / sessions)
        return Resamples(rng.multinomial(sessions, shares, resamples).astype(np.float64))

    def interval(self, statistic: Statistic, level: float = LEVEL) -> Interval:
        """The percentile interval of a statistic.

        Args:
            statistic: (N, S) weights of the sessions → (N,) values; a row of ones gives the
                estimate itself. Values that are not numbers (0 ÷ 0) are left out.
            level: share of the resamples within the interval.
        """
        estimate = float(statistic(np.ones((1, self.counts.shape[1])))[0])
        values = statistic(self.counts)
        values = values[~np.isnan(values)]
        if len(values) == 0:
            return Interval(estimate, np.nan, np.nan)
        tail = 50.0 * (1.0 - level)
        # Of infinite ratios the nearest value is taken: nothing lies between it and infinity.
        low, high = np.percentile(values, [tail, 100.0 - tail], method="nearest")
        return Interval(estimate, float(low), float(high))


@dataclass(frozen=True, slots=True, eq=False)
class SessionSums:
    """A measure that is a ratio of sums: its parts, one per session.

    Attributes:
        numerator, denominator: (S,) float64.
    """

    numerator: Array
    denominator: Array

    def __post_init__(self) -> None:
        if self.numerator.shape != self.denominator.shape or self.numerator.ndim != 1:
            raise InputError(
                f"a measure over sessions needs two arrays of one length, not shapes "
                f"{self.numerator.shape} and {self.denominator.shape}"
            )

    def __call__(self, weights: Array) -> Array:
        """(N,) the measure under (N, S) weights; NaN where nothing was driven."""
        if weights.ndim != 2 or weights.shape[1] != len(self.numerator):
            raise InputError(
                f"a measure over {len(self.numerator)} sessions cannot be weighed by draws of "
                f"shape {weights.shape}; draw as many sessions as there are"
            )
        below = weights @ self.denominator
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(below > 0, (weights @ self.numerator) / below, np.nan))

    @property
    def value(self) -> float:
        """The measure itself."""
        return float(self(np.ones((1, len(self.numerator))))[0])


def difference(a: SessionSums, b: SessionSums) -> Statistic:
    """A − b, paired: both under the same draws of the same sessions."""
    return lambda weights: a(weights) - b(weights)


def product(a: SessionSums, b: SessionSums) -> Statistic:
    """A · B, paired."""
    return lambda weights: a(weights) * b(weights)


def ratio(a: SessionSums, b: SessionSums, added: float = 0.0) -> Statistic:
    """(a + added) ÷ (b + added), paired; infinite where only b is 0, NaN where both are."""
    return lambda weights: _divided(a(weights) + added, b(weights) + added)


def excess_ratio(a: SessionSums, b: SessionSums, bound: SessionSums) -> Statistic:
    """(a − bound) ÷ (b − bound), paired: how many times more a loses than it must.

    What falls below the bound counts as reaching it.
    """

    def statistic(weights: Array) -> Array:
        floor = bound(weights)
        return _divided(np.maximum(a(weights) - floor, 0), np.maximum(b(weights) - floor, 0))

    return statistic


def not_localised_sums(drives: Sequence[Drive]) -> SessionSums:
    """`route_not_localised` by its parts: metres without a match and metres driven, by session."""
    missed_m = [float(one.step_m[~one.matched].sum()) for one in drives]
    driven_m = [float(one.step_m.sum()) for one in drives]
    return SessionSums(np.array(missed_m, np.float64), np.array(driven_m, np.float64))


def _divided(above: Array, below: Array) -> Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(above / below)
