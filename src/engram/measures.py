"""Measures of a map's quality: how often and how far a robot drives without a match (SPEC §8).

All are pure functions of two arrays per session, one row per live frame: the odometry distance of
the step that ends in the frame, and whether the frame was matched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engram.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """The input of the measures from one localised session.

    Attributes:
        step_m: (F,) float64, distance driven from the previous frame to this one, metres, >= 0.
        matched: (F,) bool, or numbers 0 and 1: whether this frame was localised.

    Raises:
        InputError: the arrays differ in length or hold invalid values.
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
    """

    length_m: NDArray[np.float64]
    failed: NDArray[np.bool_]


def gaps(drives: Sequence[Drive]) -> Gaps:
    """All gaps of the given sessions. Source: SPEC §8."""
    lengths: list[float] = []
    failed: list[bool] = []
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
    return Gaps(np.array(lengths, dtype=np.float64), np.array(failed, dtype=bool))


def failure_curve(drives: Sequence[Drive], at_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """P(X >= x) from a uniformly random point of the route, for many distances x.

    Args:
        drives: the localised sessions.
        at_m: (X,) float64, the distances, metres.

    Returns:
        (X,) float64; 0 for a route of length 0.

    Source: SPEC §8, estimator *route*.
    """
    above, below = np.zeros(len(at_m)), 0.0
    for drive in drives:
        beyond = gaps([drive]).length_m[None, :] - at_m[:, None]
        above = above + np.maximum(beyond, 0.0).sum(axis=1)
        below = below + float(drive.step_m.sum())
    return above / below if below else above


def failure_route(drives: Sequence[Drive], at_m: float) -> float:
    """P(X >= x) from a uniformly random point of the route: (1/L) Σ max(0, g − x).

    0 for a route of length 0. Source: SPEC §8, estimator *route*.
    """
    length_m = route_m(drives)
    if length_m == 0.0:
        return 0.0
    return float(np.maximum(gaps(drives).length_m - at_m, 0.0).sum() / length_m)


def route_m(drives: Sequence[Drive]) -> float:
    """Length of the route, metres."""
    return float(sum(drive.step_m.sum() for drive in drives))


def route_not_localised(drives: Sequence[Drive]) -> float:
    """Share of the route whose steps end without an accepted match. Source: SPEC §8."""
    length_m = route_m(drives)
    missed_m = sum(float(drive.step_m[~drive.matched].sum()) for drive in drives)
    return missed_m / length_m if length_m else 0.0


def longest_gap_m(drives: Sequence[Drive]) -> float:
    """The longest distance without a match, metres."""
    return float(gaps(drives).length_m.max(initial=0.0))
