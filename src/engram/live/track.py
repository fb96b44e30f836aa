"""A robot's own odometry as it goes out: continuous, never corrected by the map, never a jump."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3, propagate_covariance
from engram.live.driving import Step

# A motion that was guessed for longer, or less surely, is no step: the robot may have stood.
_LONGEST_GUESS_NS, _LARGEST_SIGMA_M = 1_000_000_000, 1.0
# A step of one frame may be longer than the longest of the last ones by so much, m.
_LONGER_BY, _LEAST_STEP_M = 2.0, 0.05
_STEPS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Odometry since the start. While the camera sees nothing it goes on by the guess for a while.

    Where that turns out wrong, or nothing is known any more, the track stays where it is, rather
    than jump; its covariance keeps the error that may be in it.

    Attributes:
        odom_from_live: pose of the camera in that of its first image.
        covariance: (6, 6) float64 of `odom_from_live`, left perturbation, [translation, rotation].
    """

    odom_from_live: SE3 = field(default_factory=SE3.identity)
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))
    # Of the newest usable frame, from which a guess goes ahead.
    _usable: tuple[SE3, NDArray[np.float64]] | None = None
    _stamp_ns: int | None = None
    _steps_m: tuple[float, ...] = ()

    def after(self, step: Step, stamp_ns: int) -> Track:
        """The track after one more frame; it holds still where nothing is known of the motion."""
        motion = step.motion
        since_ns = None if self._stamp_ns is None else stamp_ns - self._stamp_ns
        if motion is None:
            return self if since_ns is not None and since_ns <= 0 else self._at(stamp_ns)
        base, base_covariance = self._usable or (self.odom_from_live, self.covariance)
        ahead = motion.ahead
        if motion.prev_from_curr is not None and motion.covariance is not None:
            ahead = motion.prev_from_curr, motion.covariance
            measured = motion.odometry.prev_from_curr
            if not motion.guessed_m and measured is not None:
                # What it makes up for, from before odometry began, would be a jump.
                ahead = measured, _held(measured, *ahead)
        if ahead is None:
            return replace(self, _usable=None, _stamp_ns=stamp_ns)
        to = base @ ahead[0]
        covariance = propagate_covariance(base, base_covariance, ahead[1])
        guessed = motion.guessed_m > 0 or motion.ahead is not None
        moved = self.odom_from_live.inverse() @ to
        blind = self._usable is not None or guessed
        doubtful = guessed and (
            (since_ns or 0) > _LONGEST_GUESS_NS or ahead[1][:3, :3].max() > _LARGEST_SIGMA_M**2
        )
        if doubtful or (blind and moved.distance_m > self._longest_m):
            to, covariance = self.odom_from_live, _held(self.odom_from_live, to, covariance)
            steps_m = self._steps_m
        else:
            steps_m = (*self._steps_m, moved.distance_m)[-_STEPS:]
        usable = (base, base_covariance) if motion.ahead is not None else None
        return Track(to, covariance, usable, stamp_ns, steps_m)

    @property
    def _longest_m(self) -> float:
        return _LONGER_BY * max(self._steps_m, default=np.inf) + _LEAST_STEP_M

    def _at(self, stamp_ns: int) -> Track:
        return replace(self, _stamp_ns=stamp_ns)


def _held(held: SE3, believed: SE3, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """The covariance of a pose that stays although another is believed: with what lies between."""
    error = (believed @ held.inverse()).log()
    return covariance + np.outer(error, error)
