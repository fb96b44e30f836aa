"""Measures of a map's quality: how often and how far a robot drives without a match (method §8).

All are pure functions of two arrays per session, one row per live frame: the odometry distance of
the step that ends in the frame, and whether the frame was matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engram.errors import InputError


class Estimator(StrEnum):
    """What P(X >= x), the chance of a long distance without a match, is taken over."""

    ROUTE = "route"
    GAP = "gap"
    LOST = "lost"
    REACQUIRED = "reacquired"


# What is shown beside every figure; g is the distance between two successive matches, d the
# distance from the first frame without a match to the next one with. Source: method §8;
# `reacquired` is the measure of [G16] §VI-B: "after becoming lost, before reacquiring".
FORMULAS = {
    Estimator.ROUTE: "(1/L) Σ max(0, g − x)",
    Estimator.GAP: "#{g ≥ x} / #{g}",
    Estimator.LOST: "#{g ≥ x} / #{g}, gaps with a failed frame",
    Estimator.REACQUIRED: "#{d ≥ x} / #{d}, from becoming lost to reacquiring",
}


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """The input of the measures from one localised session.

    Attributes:
        step_m: (F,) float64, distance driven from the previous frame to this one, metres, >= 0.
        matched: (F,) bool, or numbers 0 and 1: whether this frame was localised.
    """

    step_m: NDArray[np.float64]
    matched: NDArray[np.bool_]

    def __post_init__(self) -> None:
        object.__setattr__(self, "step_m", _numbers("step_m", self.step_m))
        matched = np.asarray(self.matched)
        if matched.dtype != np.bool_:
            numbers = _numbers("matched", matched)
            if not np.isin(numbers, (0.0, 1.0)).all():
                raise InputError("a drive's matched must hold only true and false, or 0 and 1")
            matched = numbers.astype(np.bool_)
        object.__setattr__(self, "matched", matched)
        if self.step_m.shape != self.matched.shape or self.step_m.ndim != 1:
            raise InputError(
                f"a drive needs two arrays of one length, not shapes {self.step_m.shape} and "
                f"{self.matched.shape}"
            )
        if not (np.isfinite(self.step_m).all() and (self.step_m >= 0).all()):
            raise InputError("a drive's steps must be finite and >= 0 metres")


def _numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"a drive's {name} must be an array of numbers") from None


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """The distances between successive matches; start and end of a session close a gap.

    A match at the position where the session starts or ends makes no gap there.

    Attributes:
        length_m: (G,) float64, metres.
        failed: (G,) bool, whether at least one frame within the gap was not matched.
        lost_m: (G,) float64, distance from its first unmatched frame to its end, metres; 0
            without one.
    """

    length_m: NDArray[np.float64]
    failed: NDArray[np.bool_]
    lost_m: NDArray[np.float64]


def gaps(drives: Sequence[Drive]) -> Gaps:
    """All gaps of the given sessions. Source: method §8."""
    lengths: list[float] = []
    failed: list[bool] = []
    lost_m: list[float] = []
    for drive in drives:
        if not len(drive.step_m):
            continue
        positions = np.cumsum(drive.step_m)
        ends = np.flatnonzero(drive.matched)
        marks = np.concatenate([[0.0], positions[ends], positions[-1:]])
        length_m = np.diff(marks)
        # There are `j - i - 1` unmatched frames between two matches `i < j`.
        without = np.diff(np.concatenate([[-1], ends, [len(positions)]])) > 1
        real = np.ones(len(length_m), dtype=bool)
        real[[0, -1]] = (length_m[[0, -1]] > 0) | without[[0, -1]]
        lengths.extend(length_m[real])
        failed.extend(without[real])
        first = np.minimum(np.concatenate([[0], ends + 1]), len(positions) - 1)
        lost_m.extend(np.where(without, marks[1:] - positions[first], 0.0)[real])
    return Gaps(
        np.array(lengths, dtype=np.float64),
        np.array(failed, dtype=bool),
        np.array(lost_m, dtype=np.float64),
    )


def failure(
    drives: Sequence[Drive], at_m: ArrayLike, estimator: Estimator = Estimator.ROUTE
) -> NDArray[np.float64]:
    """P(X >= x): the one function for all failure estimators; see `FORMULAS`.

    Args:
        at_m: distances x, metres; a number or an array.

    Returns:
        (N,) float64, or () for one distance, probabilities; 0 where nothing was driven or
        never failed.
    """
    at = np.asarray(at_m, np.float64)
    above, below = np.zeros(at.size), 0.0
    for drive in drives:
        part, count = failure_sums(drive, at.reshape(-1), estimator)
        above, below = above + part, below + count
    return np.asarray((above / below if below else above).reshape(at.shape))


def failure_sums(
    drive: Drive, at_m: NDArray[np.float64], estimator: Estimator = Estimator.ROUTE
) -> tuple[NDArray[np.float64], float]:
    """One session's part of `failure`: numerators (X,) at distances (X,), and denominator.

    The curve over several sessions is the sum of the numerators ÷ the sum of the denominators.
    """
    found = gaps([drive])
    lengths = found.length_m
    if estimator is Estimator.ROUTE:
        beyond = np.maximum(lengths[None, :] - at_m[:, None], 0.0)
        return beyond.sum(axis=1), float(drive.step_m.sum())
    if estimator is not Estimator.GAP:
        lengths = found.lost_m if estimator is Estimator.REACQUIRED else lengths
        lengths = lengths[found.failed]
    return (lengths[None, :] >= at_m[:, None]).sum(axis=1).astype(np.float64), float(len(lengths))


def route_m(drives: Sequence[Drive]) -> float:
    """Length of the route, metres."""
    return float(sum(drive.step_m.sum() for drive in drives))


def route_not_localised(drives: Sequence[Drive]) -> float:
    """Share of the route whose steps end without an accepted match. Source: method §8."""
    length_m = route_m(drives)
    missed_m = sum(float(drive.step_m[~drive.matched].sum()) for drive in drives)
    return missed_m / length_m if length_m else 0.0


def longest_gap_m(drives: Sequence[Drive]) -> float:
    """The longest distance without a match, metres."""
    return float(gaps(drives).length_m.max(initial=0.0))
