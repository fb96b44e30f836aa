"""One step of odometry, and the motion to be expected before it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from engram.geometry.se3 import SE3


class OdometryStatus(StrEnum):
    """Whether a motion was estimated, and if not, why."""

    FIRST = "first"
    OK = "ok"
    UNUSABLE_FRAME = "unusable_frame"
    TOO_FEW_MATCHES = "too_few_matches"
    NO_CONSENSUS = "no_consensus"


@dataclass(frozen=True, slots=True, eq=False)
class OdometryStep:
    """Motion since the previous frame of the sequence; a failure carries no made-up motion.

    An unusable frame is skipped: the next usable one is matched to the frame before the gap, and
    its `prev_from_curr` spans the gap. So `prev` is the previous frame of the sequence whose
    status is not `UNUSABLE_FRAME`, and the chain of motions is complete. After `TOO_FEW_MATCHES`
    or `NO_CONSENSUS` the chain is broken: the motion to this frame is unknown, and the next one
    starts here.

    Attributes:
        status: `OK`, `FIRST` for the first usable frame of a drive, or the reason for a failure.
        prev_from_curr: pose of this frame in the previous usable one; None unless `OK`.
        covariance: (6, 6) float64 of `prev_from_curr`, left perturbation,
            [translation, rotation]; None unless `OK`.
        inliers: landmarks that agree with the motion, 0 unless `OK`.
    """

    status: OdometryStatus
    prev_from_curr: SE3 | None = None
    covariance: NDArray[np.float64] | None = None
    inliers: int = 0

    @property
    def moved_m(self) -> float:
        """Distance of `prev_from_curr`, metres; 0 without one."""
        return 0.0 if self.prev_from_curr is None else self.prev_from_curr.distance_m


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """A motion to be expected.

    Attributes:
        prev_from_curr: pose of this frame in the previous usable one, metres.
        covariance: (6, 6) float64, left perturbation, [translation, rotation].
        sigma_m: standard deviation along the least certain axis; infinite if nothing is known.
        has_way: whether the translation was measured.
    """

    prev_from_curr: SE3
    covariance: NDArray[np.float64]
    sigma_m: float
    has_way: bool = True

    def contradicts(
        self, measured: SE3 | None, covariance: NDArray[np.float64] | None, gate: float
    ) -> bool:
        """Whether a measured motion is too far from it, in standard deviations of both.

        Args:
            measured: pose of this frame in the one before; None if it was not measured.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m, rotation
                in rad]; None with it.
            gate: most standard deviations along each axis.
        """
        if measured is None or covariance is None:
            return False
        known = self._known
        off = (self.prev_from_curr @ measured.inverse()).log()[known]
        variances = np.diag(self.covariance)[known] + np.diag(covariance)[known]
        return bool((off**2 > gate**2 * variances).any())

    def is_sharper(self, covariance: NDArray[np.float64]) -> bool:
        """Whether any component is more certain than in a measurement of (6, 6) covariance."""
        known = self._known
        return bool((np.diag(self.covariance)[known] < np.diag(covariance)[known]).any())

    def weighed_with(
        self, measured: SE3, covariance: NDArray[np.float64]
    ) -> tuple[SE3, NDArray[np.float64]]:
        """The mean of it and of a measured motion, each by its information; its covariance.

        Args:
            measured: pose of this frame in the one before.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m, rotation
                in rad].
        """
        known = self._known
        both = covariance[known, known] + self.covariance[known, known]
        gain = np.linalg.solve(both, covariance[known]).T
        off = (self.prev_from_curr @ measured.inverse()).log()[known]
        mean = covariance - gain @ covariance[known]
        return SE3.exp(gain @ off) @ measured, 0.5 * (mean + mean.T)

    @property
    def _known(self) -> slice:
        """Of the six: all that was measured."""
        return slice(0 if self.has_way else 3, 6)
