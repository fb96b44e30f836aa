"""Motion measured by something else than the cameras: wheels, a gyroscope.

It fills the gaps of visual odometry, guides matching after them, and is a check where odometry is
doubtful. It is never trusted blindly: scale and slip are learnt wherever odometry is sure, the
gyroscope's bias wherever the robot rests, and a source that keeps disagreeing is left aside.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Annotated, Protocol

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.geometry import SE3
from engram.odometry.step import OdometryStatus, OdometryStep

# Steps compared before their scale counts.
_KNOWN_FROM = 5
# Cosine of the largest angle between two ways that are one: 60°.
_ALONG = 0.5
# Turns that differ by less agree: a bias not yet learnt, clocks some milliseconds apart.
_LEAST_UNLIKE_RAD = float(np.deg2rad(2.0))
# Least standard deviations of a motion from outside.
_LEAST_M = 0.02
_LEAST_RAD = float(np.deg2rad(0.2))


@dataclass(frozen=True, slots=True)
class OutsideConfig:
    """Settings of motion from outside.

    Attributes:
        scale_error: standard deviation of the wheels' scale before it is learnt.
        least_scale_error: and after, as wheels slip a little everywhere.
        turn_error: standard deviation of a turn by the wheels, as a share.
        gyro_error_rad_s: standard deviation of the gyroscope's rate, bias removed. Source: bias
            drift of consumer MEMS sensors over minutes.
        drift: standard deviation sideways per metre, from the mounting and from slip angles.
        compared: newest steps whose agreement with odometry counts.
        agreeing: least share of them that agree, for the source to be used.
        gate: disagreement in standard deviations at which two measurements contradict each other.
        sure_share: share of the usual inliers from which a step of odometry is sure.
        rest_m_s, rest_rad_s: speeds below which the robot rests.
    """

    scale_error: Annotated[float, Meta(gt=0, le=1)] = 0.05
    least_scale_error: Annotated[float, Meta(gt=0, le=1)] = 0.01
    turn_error: Annotated[float, Meta(gt=0, le=2)] = 0.2
    gyro_error_rad_s: Annotated[float, Meta(gt=0, le=1)] = 0.003
    drift: Annotated[float, Meta(ge=0, le=1)] = 0.01
    compared: Annotated[int, Meta(ge=5, le=1000)] = 30
    agreeing: Annotated[float, Meta(ge=0, le=1)] = 0.5
    gate: Annotated[float, Meta(gt=0, le=100)] = 4.0
    sure_share: Annotated[float, Meta(ge=0, le=1)] = 0.5
    rest_m_s: Annotated[float, Meta(ge=0, le=10)] = 0.02
    rest_rad_s: Annotated[float, Meta(ge=0, le=10)] = 0.01

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class OutsideMotion:
    """What wheels and gyroscope measured between two frames, uncorrected.

    Attributes:
        prev_from_curr: pose of the camera at this frame in that at the previous frame, metres.
        seconds: time between the two.
        has_way: whether the wheels measured the way; else the translation is 0 and means nothing.
        rates_rad_s: (3,) float64 mean rate of the gyroscope in the camera's axes; None if the turn
            is the wheels'.
    """

    prev_from_curr: SE3
    seconds: float
    has_way: bool = True
    rates_rad_s: NDArray[np.float64] | None = None

    @property
    def turned_rad(self) -> float:
        """How far the camera turned about any axis; by the gyroscope perhaps more than once."""
        if self.rates_rad_s is None:
            return self.prev_from_curr.angle_rad
        return float(np.linalg.norm(self.rates_rad_s)) * self.seconds


class MotionSource(Protocol):
    """Gives the motion between two frames, in the order of time."""

    def between(self, start_ns: int, end_ns: int) -> OutsideMotion | None:
        """The motion from one stamp to a later one; None if it was not measured throughout."""
        ...


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

    def contradicts(self, measured: SE3, covariance: NDArray[np.float64], gate: float) -> bool:
        """Whether a measured motion is too far from it, in standard deviations of both.

        Args:
            measured: pose of this frame in the one before.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m, rotation
                in rad].
            gate: most standard deviations along each axis.
        """
        if not self.has_way:
            return False
        off = (self.prev_from_curr.inverse() @ measured).log()
        sigmas = np.sqrt(np.diag(self.covariance) + np.diag(covariance))
        return bool((np.abs(off) > gate * sigmas).any())


class OutsideModel:
    """Corrects motion from outside by what odometry measured, and says how far to trust it."""

    def __init__(self, config: OutsideConfig | None = None) -> None:
        self.config = config or OutsideConfig()
        self._ratios: deque[float] = deque(maxlen=self.config.compared)
        self._agrees: deque[bool] = deque(maxlen=self.config.compared)
        self._inliers: deque[int] = deque(maxlen=self.config.compared)
        self._bias = np.zeros(3)
        self._rest_s = 0.0
        # Since the last usable frame; None if it was not measured throughout.
        self._since: OutsideMotion | None = None
        self._begun = False
        self._broken = False

    @property
    def scale(self) -> float:
        """Way by odometry over way by the wheels: 1.02 if the wheels measure 2 % too little."""
        known = len(self._ratios) >= _KNOWN_FROM
        return float(np.median(self._ratios)) if known else 1.0

    @property
    def slip(self) -> float:
        """Share of the newest sure steps at which wheels and odometry disagreed."""
        return 1.0 - float(np.mean(self._agrees)) if self._agrees else 0.0

    @property
    def bias_rad_s(self) -> NDArray[np.float64]:
        """(3,) float64 bias of the gyroscope in the camera's axes."""
        return self._bias

    def add(self, motion: OutsideMotion | None) -> None:
        """Takes in the motion that led to a frame; None if it was not measured."""
        self._begun = self._begun or motion is not None
        if motion is None or self._broken:
            self._broken = self._begun
            return
        corrected = self._corrected(motion)
        self._since = corrected if self._since is None else _joined(self._since, corrected)

    def guess(self) -> Guess | None:
        """The motion since the last usable frame; None if unknown or not to be trusted."""
        since = self._since
        if since is None or self._broken or self.slip > 1.0 - self.config.agreeing:
            return None
        config = self.config
        way = since.prev_from_curr.translation * (self.scale if since.has_way else 0.0)
        way_m = float(np.linalg.norm(way))
        sigma_rad = self._turn_error(since)
        along = way_m * (self._scale_error() + self.slip)
        sideways = way_m * (sigma_rad / 2 + config.drift)
        sigma_m = float(np.sqrt(along**2 + sideways**2 + _LEAST_M**2))
        covariance = np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
        pose = SE3(since.prev_from_curr.rotation, way)
        return Guess(pose, covariance, sigma_m, since.has_way)

    def is_sure(self, step: OdometryStep) -> bool:
        """Whether a step of odometry has the usual number of inliers, or nearly.

        The first one is: nothing has confirmed the source outside yet.
        """
        if step.status is not OdometryStatus.OK:
            return False
        usual = float(np.median(self._inliers)) if self._inliers else 0.0
        return step.inliers >= self.config.sure_share * usual

    def compare(self, step: OdometryStep) -> None:
        """Learns from the step of odometry that ends in this frame; the next motion begins here."""
        if step.status is OdometryStatus.UNUSABLE_FRAME:
            return
        since, self._since, broken = self._since, None, self._broken
        self._broken = False
        measured, covariance = step.prev_from_curr, step.covariance
        if step.status is OdometryStatus.OK:
            self._inliers.append(step.inliers)
        if since is None or broken or measured is None or covariance is None:
            return
        if not self.is_sure(step):
            return
        self._learn_bias(since, measured)
        off_rad = (since.prev_from_curr.inverse() @ measured).angle_rad
        turns = off_rad <= max(self.config.gate * self._turn_error(since), _LEAST_UNLIKE_RAD)
        if since.has_way:
            self._learn_scale(since, measured, covariance, turns=turns)
        else:
            self._agrees.append(turns)

    def _turn_error(self, since: OutsideMotion) -> float:
        """Standard deviation of a turn, rad."""
        if since.rates_rad_s is not None:
            sigma_rad = self.config.gyro_error_rad_s * since.seconds
        else:
            turned_rad = since.prev_from_curr.angle_rad
            sigma_rad = self.config.turn_error * turned_rad + self.config.drift
        return float(np.hypot(sigma_rad, _LEAST_RAD))

    def _learn_scale(
        self, since: OutsideMotion, measured: SE3, covariance: NDArray[np.float64], *, turns: bool
    ) -> None:
        wheels_m, seen_m = since.prev_from_curr.distance_m, measured.distance_m
        sigma_m = float(np.sqrt(np.trace(covariance[:3, :3])))
        if max(wheels_m, seen_m) < 4 * max(sigma_m, _LEAST_M / 2):
            return  # too short to tell
        ratio = seen_m / max(wheels_m, 1e-3)
        spread = self._scale_error() + sigma_m / max(seen_m, 1e-3)
        expected = self.scale if len(self._ratios) >= _KNOWN_FROM else 1.0
        limit = self.config.gate * max(spread, self.config.scale_error)
        along_m2 = float(since.prev_from_curr.translation @ measured.translation)
        alike = along_m2 >= _ALONG * wheels_m * seen_m  # not so by wheels of a reversed sign
        agrees = turns and alike and abs(ratio / expected - 1.0) <= limit
        self._agrees.append(agrees)
        if agrees:
            self._ratios.append(ratio)

    def _scale_error(self) -> float:
        """Standard deviation of the scale: of the median of the ratios, once they are known."""
        config = self.config
        if len(self._ratios) < _KNOWN_FROM:
            return config.scale_error
        ratios = np.array(self._ratios)
        spread = 1.4826 * float(np.median(np.abs(ratios - np.median(ratios))))
        return max(config.least_scale_error, 1.25 * spread / float(np.sqrt(len(ratios))))

    def _learn_bias(self, since: OutsideMotion, measured: SE3) -> None:
        """The mean rate while the robot rests, the newest ten seconds of it."""
        seconds, config = since.seconds, self.config
        if since.rates_rad_s is None or seconds <= 0:
            return
        rests = (
            measured.distance_m < config.rest_m_s * seconds + 0.002
            and measured.angle_rad < config.rest_rad_s * seconds + 0.0005
            and since.prev_from_curr.distance_m <= config.rest_m_s * seconds
        )
        if rests:
            self._rest_s = min(self._rest_s + seconds, 10.0)
            share = min(seconds / self._rest_s, 1.0)
            self._bias = self._bias + share * (since.rates_rad_s - self._bias)

    def _corrected(self, motion: OutsideMotion) -> OutsideMotion:
        """Without the gyroscope's bias: it turns the way by half of what it turns the end."""
        if motion.rates_rad_s is None:
            return motion
        half = SE3.exp(np.r_[np.zeros(3), -0.5 * motion.seconds * self._bias]).rotation
        pose = motion.prev_from_curr
        corrected = SE3(half @ pose.rotation @ half, half @ pose.translation)
        return OutsideMotion(corrected, motion.seconds, motion.has_way, motion.rates_rad_s)


def _joined(first: OutsideMotion, then: OutsideMotion) -> OutsideMotion:
    """Both motions, one after the other."""
    seconds = first.seconds + then.seconds
    rates = None
    if first.rates_rad_s is not None and then.rates_rad_s is not None and seconds > 0:
        rates = (first.seconds * first.rates_rad_s + then.seconds * then.rates_rad_s) / seconds
    return OutsideMotion(
        first.prev_from_curr @ then.prev_from_curr,
        seconds,
        first.has_way and then.has_way,
        rates,
    )
