"""The result of visual odometry for one frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3


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
