"""How right the poses of successes are (method §8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.geometry.se3 import SE3

# A success with a greater error is a false one. Source: method §8.
FALSE_BEYOND_M = 1.0
FALSE_BEYOND_RAD = float(np.deg2rad(5.0))
# Shares of errors that the ellipsoids of covariances should hold.
LEVELS = (0.5, 0.9, 0.99)


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """Errors of estimated poses.

    Attributes:
        offset_m: (N,) float64, distance between the estimated and the true position.
        turn_rad: (N,) float64, angle between the estimated and the true orientation.
    """

    offset_m: NDArray[np.float64]
    turn_rad: NDArray[np.float64]

    @property
    def false(self) -> NDArray[np.bool_]:
        """(N,) bool: more than 1 m or 5° off. Source: method §8."""
        return (self.offset_m > FALSE_BEYOND_M) | (self.turn_rad > FALSE_BEYOND_RAD)


def pose_errors(estimated: Sequence[SE3], true: Sequence[SE3]) -> PoseErrors:
    """Errors of ``node_from_live`` estimates against the true ones, pairwise.

    Raises:
        InputError: there are more of the one than of the other.
    """
    if len(estimated) != len(true):
        raise InputError(f"{len(estimated)} estimated poses, but {len(true)} true ones")
    offsets = [
        float(np.linalg.norm(e.translation - t.translation))
        for e, t in zip(estimated, true, strict=True)
    ]
    turns = [(t.inverse() @ e).angle_rad for e, t in zip(estimated, true, strict=True)]
    return PoseErrors(np.array(offsets, np.float64), np.array(turns, np.float64))


def squared(found: SE3, covariance: NDArray[np.float64], truth: SE3) -> float:
    """χ² of a pose with its (6, 6) covariance, left perturbation."""
    off = (truth @ found.inverse()).log()
    return float(off @ np.linalg.solve(covariance + 1e-12 * np.eye(6), off))
