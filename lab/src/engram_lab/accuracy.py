"""How right the poses of successes are (method §8), and what robots made of their frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engram.geometry.se3 import SE3

# A success with a greater error is a false one. Source: method §8.
FALSE_M = 1.0
FALSE_RAD = float(np.deg2rad(5.0))
# Reported in addition to what is false; false fixes closer than this are one event, metres.
NEAR_M, EVENT_M = 0.5, 20.0
# A fix claims to be sure from this confidence on.
SURE = 7.0
# Lengths over which drift is measured. Source: KITTI's odometry benchmark.
STRETCHES_M = (100.0, 200.0, 300.0)
# Shares of errors that the ellipsoids of covariances should hold.
LEVELS = (0.5, 0.9, 0.99)


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """Errors of estimated poses: (N,) float64 between the positions, and between the headings."""

    offset_m: NDArray[np.float64]
    turn_rad: NDArray[np.float64]

    @property
    def false(self) -> NDArray[np.bool_]:
        """(N,) bool: more than 1 m or 5° off. Source: method §8."""
        return (self.offset_m > FALSE_M) | (self.turn_rad > FALSE_RAD)


def is_false(error_m: float, error_rad: float) -> bool:
    """Whether a fix is more than 1 m or 5° off."""
    return error_m > FALSE_M or error_rad > FALSE_RAD


def squared(found: SE3, covariance: NDArray[np.float64], truth: SE3) -> float:
    """χ² of a pose with its (6, 6) covariance, left perturbation."""
    off = (truth @ found.inverse()).log()
    return float(off @ np.linalg.solve(covariance + 1e-12 * np.eye(6), off))


def way_m(poses: Sequence[SE3]) -> float:
    """Length of a path, metres."""
    return sum((a.inverse() @ b).distance_m for a, b in pairwise(poses))


@dataclass(frozen=True, slots=True)
class Fix:
    """A fix: the frame shown to the robot at which it came, and how far off it is."""

    at: int
    error_m: float
    false: bool
    confidence: float = 0.0


@dataclass(frozen=True, slots=True)
class Count:
    """What robots made of the frames that they were shown; counts add up.

    Attributes:
        fixes: whose truth is known; `off` more than 0.5 m off, `false` more than 1 m or 5°, and
            `sure` false ones that claim a confidence above 7.
    """

    robots: int = 0
    frames: int = 0
    metres: float = 0.0
    fixes: int = 0
    off: int = 0
    false: int = 0
    sure: int = 0
    hurt: int = 0
    events: int = 0
    worst_m: float = 0.0
    again: tuple[int, ...] = ()

    @staticmethod
    def of(fixes: Sequence[Fix], world_from_cam: Sequence[SE3], after: int = 0) -> Count:
        """One robot."""
        false = [one for one in fixes if one.false]
        right = [one.at - after for one in fixes if not one.false and one.at >= after]
        return Count(
            robots=1,
            frames=len(world_from_cam),
            metres=way_m(world_from_cam),
            fixes=len(fixes),
            off=sum(one.error_m > NEAR_M for one in fixes),
            false=len(false),
            sure=sum(one.confidence > SURE for one in false),
            hurt=bool(false),
            events=events(world_from_cam[one.at] for one in false),
            worst_m=max((one.error_m for one in fixes), default=0.0),
            again=tuple(right[:1]),
        )

    @property
    def right(self) -> int:
        """Fixes that are right."""
        return self.fixes - self.false

    def __add__(self, other: Count) -> Count:
        return Count(
            self.robots + other.robots,
            self.frames + other.frames,
            self.metres + other.metres,
            self.fixes + other.fixes,
            self.off + other.off,
            self.false + other.false,
            self.sure + other.sure,
            self.hurt + other.hurt,
            self.events + other.events,
            max(self.worst_m, other.worst_m),
            self.again + other.again,
        )


def events(false_fixes: Iterable[SE3]) -> int:
    """Runs of false fixes, by where the robot truly was: less than 20 m apart is one event."""
    count, last = 0, None
    for here in false_fixes:
        count += last is None or (last.inverse() @ here).distance_m > EVENT_M
        last = here
    return count


def lap_drift(poses: Sequence[SE3], truth: Sequence[SE3]) -> float:
    """Median error over `STRETCHES_M`, as a share of their length; NaN for a shorter lap."""
    steps = [(a.inverse() @ b).distance_m for a, b in pairwise(truth)]
    driven_m = np.concatenate([[0.0], np.cumsum(steps)])
    errors = []
    for first in range(0, len(truth), 10):
        for length_m in STRETCHES_M:
            last = int(np.searchsorted(driven_m, driven_m[first] + length_m))
            if last < len(truth):
                found = poses[first].inverse() @ poses[last]
                wrong = found.inverse() @ (truth[first].inverse() @ truth[last])
                errors.append(wrong.distance_m / length_m)
    return float(np.median(errors)) if errors else float("nan")
