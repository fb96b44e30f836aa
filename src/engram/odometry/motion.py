"""Motion over the frames at which odometry fails, or knows less than a guess.

A drop on the lens, a flash, a bus that fills the view: for a frame or two odometry finds no motion.
The robot has hardly changed its speed meanwhile, and to give up all that is known about where it is
would tear maps and localisation to pieces in every shower. So it is taken to go on as it did, with
a covariance that allows for braking and turning. Over longer gaps that covariance grows past use,
and the robot counts as lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.odometry.step import OdometryStatus, OdometryStep

_NS_PER_S = 1e9
# How wrong a guess is grows with the distance of the gap: of 428 gaps of wet drives of `village`,
# one to twelve frames long, 68 % lie within 0.17 to 0.6 m and 0.9 to 3 degrees a metre; the long
# ones are in bends.
_SIGMA_PER_M = 0.5
_SIGMA_RAD_PER_M = float(np.deg2rad(2.5))
# The speed is the median of so many steps: before odometry fails it is often wrong already.
_STEPS = 5
# A step tells the speed when its standard deviation is below this share of its own length: in rain
# and by night steps that are wrong are mostly too short. Half of what a guess is wrong by takes the
# ways of 20 m on wet drives of `village` that are further off than is forgiven
# (`benchmarks/dead_reckoning.py`) from 1.9 to 0 %; held against the length of the guess instead,
# 2 % are; with half of that again bends are known too late.
_SHARP = 0.5 * _SIGMA_PER_M
# Nothing is known of the turn, (rad/s)².
_ANY_TURN = 1e4
# A car brakes with up to 8 m/s², a drone turns about with 10.
_GREATEST_ACCELERATION_M_S2 = 10.0
# The speed is known after so many measurements.
_STEPS_TO_KNOW_SPEED = 3
# Where some of the newest ten steps are missing, the same share of those that were measured is
# taken to be wrong by all their length. On wet drives of `village@2`, with two, four and five of
# ten missing, steps of a metre are wrong by 0.30, 0.37 and 0.52 m (r.m.s.), where this says 0.45,
# 0.63 and 0.71 and odometry itself 0.3; on wet nights of `begbroke24h` by 0.41, 0.57 and 0.70 m,
# where odometry says 0.14.
_NEWEST_STEPS = 10
# Of a robot that stood still, too.
_LEAST_SIGMA_M = 0.05
_LEAST_SIGMA_RAD = float(np.deg2rad(0.5))


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How the camera moved since the usable frame before, with the gaps of odometry filled.

    Attributes:
        odometry: what odometry measured.
        prev_from_curr: pose of this frame in the usable one before; None where the next usable
            frame will tell: at the first frame of a drive, and at one of no use.
        covariance: (6, 6) float64 of it, left perturbation, [translation, rotation]; None with it.
        guessed_m: standard deviation of a guess, metres; 0 where odometry measured the motion.
    """

    odometry: OdometryStep
    prev_from_curr: SE3 | None = None
    covariance: NDArray[np.float64] | None = None
    guessed_m: float = 0.0

    @property
    def moved_m(self) -> float:
        """Distance since the usable frame before, metres."""
        return 0.0 if self.prev_from_curr is None else self.prev_from_curr.distance_m

    @property
    def usable(self) -> bool:
        """Whether the frame is of any use; what was moved until one that is not comes later."""
        return self.odometry.status is not OdometryStatus.UNUSABLE_FRAME


UNMOVED = Motion(OdometryStep(OdometryStatus.FIRST))


def driven_steps_m(motions: Sequence[Motion], stamps_ns: Sequence[int]) -> NDArray[np.float64]:
    """Distance of each step of a drive, (F,) metres, where each frame has its own part of the way.

    What was driven past frames of no use is known at the next usable one. It is shared among all
    of them by time: way on which a robot saw nothing was not localised (SPEC §8), whatever came
    after. What was driven after the last usable frame is not known.

    Args:
        motions: (F) motions, each ending in one frame.
        stamps_ns: (F) stamps of these frames, rising.
    """
    steps_m = np.array([one.moved_m for one in motions], np.float64)
    seen = np.array([one.usable for one in motions], np.bool_)
    if seen.all() or not seen.any():
        return steps_m
    since_ns = np.array([stamp - stamps_ns[0] for stamp in stamps_ns], np.float64)
    driven_m = np.interp(since_ns, since_ns[seen], np.cumsum(steps_m)[seen])
    return np.diff(driven_m, prepend=driven_m[0]).clip(0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    prev_from_curr: SE3
    covariance: NDArray[np.float64]
    sigma_m: float


_ANY_MOTION = _Guess(SE3.identity(), np.eye(6) * np.pi**2, np.inf)


class GapFiller:
    """Takes the steps of odometry one after another, and guesses the missing ones.

    A measurement that is vaguer than the guess counts as missing: in hard rain steps of ten metres
    in a tenth of a second are measured, with a covariance that says what they are worth. Not for
    long, though: a robot may have changed its speed.

    So does one that no robot could have followed. At night in rain, kerbs and the light of the own
    headlamps on the road look as if the robot had stopped from one frame to the next, and the
    covariance says two centimetres. The longer ago the speed was measured, the more is possible.

    And where steps are missing, those between are worth less than odometry says.

    A robot that is set down moving, in a shower, has no last speed. What it moved until its first
    measured step is made up for by that step: it had been as fast before.
    """

    def __init__(self) -> None:
        # (3,) m/s each, in the camera that they begin in; the newest last.
        self._velocities: deque[NDArray[np.float64]] = deque(maxlen=_STEPS)
        # Measurements at a stretch that were too vague to tell the speed by.
        self._unlearnt = 0
        self._turn_per_s = np.zeros(3)
        self._turn_variance = _ANY_TURN
        self._stamp_ns: int | None = None
        # Distance of the gap so far.
        self._gap_m = 0.0
        # Measurements at a stretch that were vaguer than a guess.
        self._vague = 0
        # Stamp of the newest motion that was measured and believed.
        self._believed_ns: int | None = None
        # Whether each of the newest steps was missing.
        self._missing: deque[bool] = deque(maxlen=_NEWEST_STEPS)
        # What the newest steps would have been at the speed that was known.
        self._guessed_m_per_s: deque[float] = deque(maxlen=_NEWEST_STEPS)
        # How long the robot has moved at a speed that is not known yet.
        self._unknown_s = 0.0

    def motion(self, odometry: OdometryStep, stamp_ns: int) -> Motion:
        """The motion since the usable frame before.

        Args:
            odometry: the step that ends in this frame.
            stamp_ns: stamp of the frame.
        """
        if odometry.status is OdometryStatus.UNUSABLE_FRAME:
            return Motion(odometry)
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        if odometry.status is OdometryStatus.FIRST:
            return Motion(odometry)
        seconds = 0.0 if before is None else (stamp_ns - before) / _NS_PER_S
        measured, covariance = odometry.prev_from_curr, odometry.covariance
        guess = self._guess(seconds)
        if seconds > 0 and self._knows_speed:
            self._guessed_m_per_s.append(guess.prev_from_curr.distance_m / seconds)
        if (
            measured is None
            or covariance is None
            or self._too_vague(covariance, guess)
            or self._impossible(measured, covariance, seconds)
        ):
            self._missing.append(True)
            self._gap_m += guess.prev_from_curr.distance_m
            if guess is _ANY_MOTION:
                self._unknown_s += max(seconds, 0.0)
            return Motion(odometry, guess.prev_from_curr, guess.covariance, guess.sigma_m)
        self._missing.append(False)
        self._gap_m = 0.0
        self._believed_ns = stamp_ns
        if seconds > 0:
            self._learn(measured, covariance, seconds)
        if any(self._missing):
            covariance = covariance + self._doubt(measured, seconds)
        if self._unknown_s and seconds > 0:
            measured, covariance = self._made_up_for(measured, covariance, seconds)
        return Motion(odometry, measured, covariance)

    def _learn(self, measured: SE3, covariance: NDArray[np.float64], seconds: float) -> None:
        """Speed and turn for guesses to come; vague steps say little of them."""
        twist_per_s, step_m = measured.log() / seconds, measured.distance_m
        sharp = _sigma_m(covariance) <= max(_SHARP * step_m, 0.5 * _LEAST_SIGMA_M)
        self._unlearnt = 0 if sharp else self._unlearnt + 1
        # A vague speed is better than none, or an old one.
        if sharp or not self._knows_speed or self._unlearnt > _STEPS:
            self._velocities.append(twist_per_s[:3])
        # From one step to the next the turn changes by as much as a guess of it is wrong: the rest
        # is a Kalman filter. After a gap it is not taken to have changed by more: that would hang
        # the next guesses on the first vague step.
        change_rad = max(_SIGMA_RAD_PER_M * step_m, _LEAST_SIGMA_RAD)
        expected = self._turn_variance + (change_rad / seconds) ** 2
        measured_to = float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) / seconds**2
        gain = expected / (expected + measured_to)
        self._turn_per_s = self._turn_per_s + gain * (twist_per_s[3:] - self._turn_per_s)
        self._turn_variance = (1.0 - gain) * expected

    def _made_up_for(
        self, measured: SE3, covariance: NDArray[np.float64], seconds: float
    ) -> tuple[SE3, NDArray[np.float64]]:
        """The first measured step, behind all that the robot moved before at its speed.

        The turn is left out: over several steps it is no longer that of the last.
        """
        steps, self._unknown_s = self._unknown_s / seconds, 0.0
        before = SE3(np.eye(3), measured.log()[:3] * steps)
        wrong = np.repeat([_SIGMA_PER_M, _SIGMA_RAD_PER_M], 3) * before.distance_m
        adjoint = before.adjoint()
        carried = adjoint @ covariance @ adjoint.T
        return before @ measured, carried + steps**2 * covariance + np.diag(wrong**2)

    def _doubt(self, measured: SE3, seconds: float) -> NDArray[np.float64]:
        """(6, 6) what a measured step among missing ones is to be doubted by.

        A robot that seems to have stopped is doubted by the speed that it had before.
        """
        step_m = max(measured.distance_m, max(self._guessed_m_per_s, default=0.0) * seconds)
        share = sum(self._missing) / _NEWEST_STEPS
        variances = np.repeat([step_m**2, (_SIGMA_RAD_PER_M * step_m) ** 2], 3)
        return np.diag(share * variances)

    def _too_vague(self, covariance: NDArray[np.float64], guess: _Guess) -> bool:
        vague = _sigma_m(covariance) > guess.sigma_m
        self._vague = self._vague + 1 if vague else 0
        return vague and self._vague <= _STEPS

    @property
    def _knows_speed(self) -> bool:
        return len(self._velocities) >= _STEPS_TO_KNOW_SPEED

    def _impossible(self, measured: SE3, covariance: NDArray[np.float64], seconds: float) -> bool:
        """Whether no robot changes its speed so much since a motion was last believed.

        The speed is that of the newest sharp step: what a vague one says may be the rain's.
        """
        if not self._knows_speed or seconds <= 0:
            return False
        assert self._stamp_ns is not None
        assert self._believed_ns is not None
        since_s = (self._stamp_ns - self._believed_ns) / _NS_PER_S
        changed_m = np.linalg.norm(measured.log()[:3] - self._velocities[-1] * seconds)
        possible_m = _GREATEST_ACCELERATION_M_S2 * since_s * seconds
        return bool(changed_m > possible_m + 3 * _sigma_m(covariance))

    def _guess(self, seconds: float) -> _Guess:
        """On at the last speed and turn; where these are not known, any motion whatever."""
        if not self._velocities or seconds <= 0:
            return _ANY_MOTION
        velocity = np.median(self._velocities, axis=0)
        guess = SE3.exp(np.r_[velocity, self._turn_per_s] * seconds)
        # The steps of a gap are wrong in the same way: their errors add up, not their variances.
        growth_m2 = (self._gap_m + guess.distance_m) ** 2 - self._gap_m**2
        sigma_m = float(np.hypot(_SIGMA_PER_M * np.sqrt(growth_m2), _LEAST_SIGMA_M))
        sigma_rad = float(np.hypot(_SIGMA_RAD_PER_M * np.sqrt(growth_m2), _LEAST_SIGMA_RAD))
        covariance = np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
        return _Guess(guess, covariance, sigma_m)


def _sigma_m(covariance: NDArray[np.float64]) -> float:
    """Standard deviation along the least certain axis."""
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))
