"""Motion over the frames at which odometry fails.

A drop on the lens, a flash, a bus that fills the view: for a frame or two odometry finds no motion.
The robot has hardly changed its speed meanwhile, and to give up all that is known about where it is
would tear maps and localisation to pieces in every shower. So the last speed is kept, straight on,
with a covariance that allows for braking and turning. Over longer gaps that covariance grows past
use, and the robot counts as lost.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.odometry import OdometryStatus, OdometryStep

_NS_PER_S = 1e9
# A guessed step is uncertain by twice its length and this, in metres.
_LEAST_SIGMA_M = 0.1
# Nothing is known of a turn but that it goes on at most about as the last one.
_LEAST_SIGMA_RAD = float(np.deg2rad(5.0))


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How the camera moved since the usable frame before.

    Attributes:
        prev_from_curr: pose of this frame in that one.
        covariance: (6, 6) float64 of it, left perturbation, [translation, rotation].
        guessed_m: standard deviation of a guess, metres; 0 where odometry measured the motion.
    """

    prev_from_curr: SE3
    covariance: NDArray[np.float64]
    guessed_m: float = 0.0


def driven_steps_m(
    odometry: Iterable[OdometryStep], stamps_ns: Iterable[int]
) -> NDArray[np.float64]:
    """Distance of each step of a drive, (F,) metres, guessed where odometry failed.

    Args:
        odometry: (F) steps, each ending in one frame.
        stamps_ns: (F) stamps of these frames.
    """
    gaps = GapFiller()
    motions = (gaps.motion(step, stamp) for step, stamp in zip(odometry, stamps_ns, strict=True))
    return np.array([0.0 if one is None else one.prev_from_curr.distance_m for one in motions])


class GapFiller:
    """Takes the steps of odometry one after another, and guesses the missing ones."""

    def __init__(self) -> None:
        self._velocity_m_s: NDArray[np.float64] | None = None
        self._turn_rad_s = 0.0
        self._stamp_ns: int | None = None

    def motion(self, odometry: OdometryStep, stamp_ns: int) -> Motion | None:
        """The motion since the usable frame before; None where the next one will tell.

        Args:
            odometry: the step that ends in this frame.
            stamp_ns: stamp of the frame.
        """
        if odometry.status is OdometryStatus.UNUSABLE_FRAME:
            return None
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        if odometry.status is OdometryStatus.FIRST:
            return None
        seconds = 0.0 if before is None else (stamp_ns - before) / _NS_PER_S
        measured, covariance = odometry.prev_from_curr, odometry.covariance
        if measured is None or covariance is None:
            return self._guess(seconds)
        if seconds > 0:
            self._velocity_m_s = measured.translation / seconds
            self._turn_rad_s = measured.angle_rad / seconds
        return Motion(measured, covariance)

    def _guess(self, seconds: float) -> Motion:
        """Straight on at the last speed; where that is not known, any motion whatever."""
        if self._velocity_m_s is None or seconds <= 0:
            return Motion(SE3.identity(), np.eye(6) * np.pi**2, guessed_m=np.inf)
        moved = self._velocity_m_s * seconds
        sigma_m = 2 * float(np.linalg.norm(moved)) + _LEAST_SIGMA_M
        sigma_rad = min(_LEAST_SIGMA_RAD + self._turn_rad_s * seconds, np.pi)
        covariance = np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
        return Motion(SE3(np.eye(3), moved), covariance, sigma_m)
