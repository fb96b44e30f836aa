"""A robot's own odometry as it goes out: continuous, never corrected by the map, never a jump."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3, propagate_covariance
from engram.live.driving import Step

# A motion that was guessed for longer, or less surely, is no step: the robot may have stood.
_LONGEST_GUESS_NS, _LARGEST_SIGMA_M = 1_000_000_000, 1.0
# After a guess, a step may differ from going on as before by this share of it, and by so much;
# a guess itself, by wheels, by more.
_UNLIKE, _LONGER_BY, _LEAST_STEP_M, _LEAST_TURN_RAD = 0.5, 1.0, 0.05, 0.03
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Odometry since the start; while the camera sees nothing it continues by the guess.

    Where that turns out wrong, the track continues from the guess rather than jump to what was
    measured; once nothing bounds the motion it stays where it is. Its covariance keeps the
    possible error.

    Attributes:
        odom_from_live: pose of the camera in that of its first image.
        covariance: (6, 6) float64 of `odom_from_live`, left perturbation, [translation, rotation].
    """

    odom_from_live: SE3 = field(default_factory=SE3.identity)
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))
    # Of the newest usable frame, from which a guess goes ahead.
    _usable: tuple[SE3, NDArray[np.float64]] | None = None
    _stamp_ns: int | None = None
    # Of the newest step, (6,) m/s and rad/s; None before the first.
    _twist_per_s: NDArray[np.float64] | None = None
    # Whether the newest step was guessed, and taken.
    _guessed: bool = False

    def after(self, step: Step, stamp_ns: int) -> Track:
        """The track after one more frame; it holds still where the motion is unknown."""
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
        seconds = (since_ns or 0) / _NS_PER_S
        doubtful = guessed and (
            (since_ns or 0) > _LONGEST_GUESS_NS or ahead[1][:3, :3].max() > _LARGEST_SIGMA_M**2
        )
        taken = SE3.identity() if doubtful else self._without_jump(moved, seconds, guessed)
        stays = to if taken is moved else self.odom_from_live @ taken
        covariance = _held(stays, to, covariance)
        usable = None
        if motion.ahead is not None:
            # From where the guess would have led here: what comes next goes on from here.
            back = base if taken is moved or doubtful else stays @ ahead[0].inverse()
            usable = back, _held(stays, to, base_covariance)
        twist_per_s = taken.log() / seconds if seconds > 0 else self._twist_per_s
        return Track(stays, covariance, usable, stamp_ns, twist_per_s, guessed and not doubtful)

    def _without_jump(self, moved: SE3, seconds: float, guessed: bool) -> SE3:
        """A step; the same motion as before where the step would make up for a wrong guess."""
        blind = self._usable is not None or guessed or self._guessed
        if not blind or self._twist_per_s is None:
            return moved
        as_before = SE3.exp(self._twist_per_s * seconds)
        away = as_before.inverse() @ moved
        longer_by = _LONGER_BY if guessed else _UNLIKE
        most_m = longer_by * as_before.distance_m + _LEAST_STEP_M
        # A gyroscope may feel a turn that the camera does not see.
        most_rad = np.inf if guessed else _UNLIKE * as_before.angle_rad + _LEAST_TURN_RAD
        jumps = (
            min(moved.distance_m, away.distance_m) > most_m
            or min(moved.angle_rad, away.angle_rad) > most_rad
        )
        return as_before if jumps else moved

    def _at(self, stamp_ns: int) -> Track:
        return replace(self, _stamp_ns=stamp_ns)


def _held(held: SE3, believed: SE3, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of the held pose, including its offset from the current estimate."""
    error = (believed @ held.inverse()).log()
    return covariance + np.outer(error, error)
