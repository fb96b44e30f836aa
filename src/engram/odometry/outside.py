"""Motion measured by something else than the cameras, and streams that stand still meanwhile.

It is compared with visual odometry at every frame. Where the images are sure they teach it: scale
and slip of the wheels, the gyroscope's bias. Where they are vague the two are weighed by their
covariances, and where they contradict each other one of them is disproved: the images if few
landmarks agree, or if they stand still while wheels turn; else the wheels. A source that keeps
disagreeing with sure images is left aside.

A stream that stands still while the robot moves: a frozen driver, a player that holds a picture. A
standing robot and a frozen stream look alike. Two things tell them apart. No two pictures of a real
sensor are equal, not even at rest, so pixels that repeat are an old picture, whatever text is burnt
in; only wheels at rest excuse a simulator without noise. And where wheels or a gyroscope that have
agreed with the images so far say that the robot moves, pictures that stand still are old, though a
driver or a compressor added noise to them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated, Protocol

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.odometry.step import Guess, OdometryStatus, OdometryStep

# Steps compared before their scale counts.
_KNOWN_FROM = 5
# Cosine of the largest angle between two ways that are one: 60°.
_ALONG = 0.5
# Ways that differ by this share of them disagree, however vague odometry is.
_UNLIKE = 0.5
# Turns that differ by less agree: a bias not yet learnt, clocks some milliseconds apart.
_LEAST_UNLIKE_RAD = float(np.deg2rad(2.0))
# Least standard deviations of a motion from outside.
_LEAST_M = 0.02
_LEAST_RAD = float(np.deg2rad(0.2))
# Share of the newest sure steps with which a proven source agreed.
_PROVEN = 0.8
# Steps that are shorter than this share of what the wheels measured stand still.
_STILL = 0.1
# Time over which the gyroscope's bias is averaged.
_BIAS_S = 10.0


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
        newest: the newest of these; a source that has just failed is not used either.
        agreeing: least share of either that agrees, for the source to be used.
        gate: disagreement in standard deviations at which two measurements contradict each other.
        sure_share: share of the usual inliers from which a step of odometry is sure.
        sure_landmarks: share of a frame's landmarks from which a step overrules wheels that agreed
            with the steps before.
        sharp_share: most standard deviation of a sure step, as a share of its length: vague steps
            in rain are mostly too short, and teach nothing.
        rest_m_s, rest_rad_s: speeds below which the robot rests.
        straight_rad_s: turn rate below which the gyroscope's bias is learnt.
        greatest_m_s2, greatest_change: acceleration, and change of speed as a share of it, beyond
            which wheels slip or stick: they must agree again with sure images.
    """

    scale_error: Annotated[float, Meta(gt=0, le=1)] = 0.05
    least_scale_error: Annotated[float, Meta(gt=0, le=1)] = 0.01
    turn_error: Annotated[float, Meta(gt=0, le=2)] = 0.2
    gyro_error_rad_s: Annotated[float, Meta(gt=0, le=1)] = 0.003
    drift: Annotated[float, Meta(ge=0, le=1)] = 0.01
    compared: Annotated[int, Meta(ge=5, le=1000)] = 30
    newest: Annotated[int, Meta(ge=1, le=1000)] = 10
    agreeing: Annotated[float, Meta(ge=0, le=1)] = 0.5
    gate: Annotated[float, Meta(gt=0, le=100)] = 4.0
    sure_share: Annotated[float, Meta(ge=0, le=1)] = 0.5
    sure_landmarks: Annotated[float, Meta(ge=0, le=1)] = 0.15
    sharp_share: Annotated[float, Meta(gt=0, le=10)] = 0.1
    rest_m_s: Annotated[float, Meta(ge=0, le=10)] = 0.02
    rest_rad_s: Annotated[float, Meta(ge=0, le=10)] = 0.01
    straight_rad_s: Annotated[float, Meta(ge=0, le=10)] = 0.05
    greatest_m_s2: Annotated[float, Meta(gt=0, le=1000)] = 10.0
    greatest_change: Annotated[float, Meta(ge=0, le=1)] = 0.1

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class OutsideMotion:
    """What wheels and gyroscope measured between two frames, uncorrected.

    Attributes:
        prev_from_curr: pose of the camera at this frame in that at the previous frame, metres.
        seconds: time between the two.
        has_way: whether the wheels measured distance; else the translation is 0, without meaning.
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


class OutsideModel:
    """Weighs motion from outside against odometry, and says how far to trust it."""

    def __init__(self, config: OutsideConfig | None = None) -> None:
        self.config = config or OutsideConfig()
        compared = self.config.compared
        # Way by odometry over way by the wheels, of sure steps that agree.
        self._ratios: deque[float] = deque(maxlen=compared)
        # Whether each sure step agreed.
        self._agrees: deque[bool] = deque(maxlen=compared)
        # By how much sure turns differed, rad.
        self._turns_off: deque[float] = deque(maxlen=compared)
        self._inliers: deque[int] = deque(maxlen=compared)
        self._bias = np.zeros(3)
        self._bias_s = 0.0
        # Since the last usable frame; None if it was not measured throughout.
        self._since: OutsideMotion | None = None
        # Speed of the newest motion, m/s, and how often it must agree after an impossible change.
        self._m_per_s: NDArray[np.float64] | None = None
        self._to_prove = 0
        self._begun = False
        self._broken = False

    @property
    def scale(self) -> float:
        """Distance by odometry over distance by wheels: 1.02 if wheels measure 2 % too little."""
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

    @property
    def trusted(self) -> bool:
        """Whether the source agrees with sure images, or was never compared with any."""
        newest = list(self._agrees)[-self.config.newest :]
        agreeing = self.config.agreeing
        agrees = self.slip <= 1.0 - agreeing and sum(newest) >= agreeing * len(newest)
        return agrees and not self._to_prove

    @property
    def moves(self) -> bool | None:
        """Whether the robot has moved since the last usable frame; None if that is not known.

        A gyroscope alone detects a turn, but not standing still.
        """
        since = self._since
        if since is None or self._broken or not self.trusted:
            return None
        config, seconds = self.config, since.seconds
        rests_m = config.rest_m_s * seconds + _LEAST_M / 2
        rests_rad = config.straight_rad_s * seconds + _LEAST_RAD
        if since.prev_from_curr.angle_rad > rests_rad:
            return True
        return since.prev_from_curr.distance_m > rests_m if since.has_way else None

    def add(self, motion: OutsideMotion | None) -> None:
        """Takes in the motion that led to a frame; None if it was not measured."""
        self._begun = self._begun or motion is not None
        if motion is None or self._broken:
            self._broken = self._begun
            self._m_per_s = None
            return
        self._watch(motion)
        corrected = self.corrected(motion)
        self._since = corrected if self._since is None else _joined(self._since, corrected)

    def _watch(self, motion: OutsideMotion) -> None:
        """Whether the wheels change their speed as no robot does."""
        if not motion.has_way or motion.seconds <= 0:
            return
        before, config = self._m_per_s, self.config
        self._m_per_s = motion.prev_from_curr.translation / motion.seconds
        if before is None or np.linalg.norm(before) <= config.rest_m_s:
            return  # robots are set down, and logs begin, at any speed
        changed = float(np.linalg.norm(self._m_per_s - before))
        fast = max(float(np.linalg.norm(before)), float(np.linalg.norm(self._m_per_s)))
        if changed > config.greatest_m_s2 * motion.seconds + config.greatest_change * fast:
            self._to_prove = _KNOWN_FROM

    def guess(self) -> Guess | None:
        """The motion since the last usable frame; None if unknown or not to be trusted."""
        since = self._since
        if since is None or self._broken or not self.trusted:
            return None
        way = since.prev_from_curr.translation * (self.scale if since.has_way else 0.0)
        way_m = float(np.linalg.norm(way))
        sigma_rad = self._turn_error(since)
        along = way_m * (math.hypot(self._scale_error(), self._spread()) + self.slip)
        sideways = way_m * (sigma_rad / 2 + self.config.drift)
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

    def disproves(self, step: OdometryStep, landmarks: int = 0) -> bool:
        """Whether a step of odometry is wrong by what wheels and gyroscope measured.

        It contradicts them, and few landmarks agree on it or it stands still while they move: what
        is fixed to the camera, a frozen image and one's own headlamps agree well that it does not
        move. That wheels spin while the robot stands is rare, and no image tells the two apart.

        Args:
            step: that ends in this frame.
            landmarks: of the frame; 0 if unknown.
        """
        guess, since, measured = self.guess(), self._since, step.prev_from_curr
        if guess is None or since is None or measured is None:
            return False
        if not guess.contradicts(measured, step.covariance, self.config.gate):
            return False
        if self._stands_still(since, measured):
            return True
        if not self.is_sure(step):
            return bool(self._agrees)  # nothing has confirmed the source yet
        return self._proven and step.inliers < self.config.sure_landmarks * landmarks

    @property
    def _proven(self) -> bool:
        """Whether the source agreed with nearly all of the newest sure steps."""
        newest = list(self._agrees)[-self.config.newest :]
        return len(newest) >= _KNOWN_FROM and sum(newest) >= _PROVEN * len(newest)

    def compare(self, step: OdometryStep) -> None:
        """Learns from the step of odometry that ends in this frame; the next motion begins here."""
        if step.status is OdometryStatus.UNUSABLE_FRAME:
            return
        since, self._since, broken = self._since, None, self._broken
        sure, self._broken = since is not None and self.is_sure(step), False
        measured, covariance = step.prev_from_curr, step.covariance
        if step.status is OdometryStatus.OK:
            self._inliers.append(step.inliers)
        if since is None or broken or not sure or measured is None or covariance is None:
            return
        off_rad = (since.prev_from_curr.inverse() @ measured).angle_rad
        turns = off_rad <= max(self.config.gate * self._turn_error(since), _LEAST_UNLIKE_RAD)
        if turns:
            self._turns_off.append(off_rad)
        if turns or self._rests(since, measured):
            self._learn_bias(since, measured)
        if since.has_way:
            self._learn_scale(since, measured, covariance, turns=turns)
        else:
            self._agrees.append(turns)

    def _stands_still(self, since: OutsideMotion, measured: SE3) -> bool:
        """Whether odometry measures next to nothing of a motion."""
        config = self.config
        wheels_m, seconds = since.prev_from_curr.distance_m, since.seconds
        if since.has_way:
            return measured.distance_m < max(_STILL * wheels_m, config.rest_m_s * seconds)
        return measured.angle_rad < config.rest_rad_s * seconds + _LEAST_RAD

    def _rests(self, since: OutsideMotion, measured: SE3) -> bool:
        config, seconds = self.config, since.seconds
        return (
            measured.distance_m < config.rest_m_s * seconds + 0.002
            and measured.angle_rad < config.rest_rad_s * seconds + 0.0005
            and since.prev_from_curr.distance_m <= config.rest_m_s * seconds
        )

    def _turn_error(self, since: OutsideMotion) -> float:
        """Standard deviation of a turn, rad."""
        if since.rates_rad_s is not None:
            sigma_rad = self.config.gyro_error_rad_s * since.seconds
        else:
            turned_rad = since.prev_from_curr.angle_rad
            sigma_rad = self.config.turn_error * turned_rad + self.config.drift
        off = self._turns_off
        learnt_rad = math.sqrt(sum(one**2 for one in off) / len(off) / 3) if off else 0.0
        return math.hypot(sigma_rad, _LEAST_RAD, learnt_rad)

    def _learn_scale(
        self, since: OutsideMotion, measured: SE3, covariance: NDArray[np.float64], *, turns: bool
    ) -> None:
        wheels_m, seen_m = since.prev_from_curr.distance_m, measured.distance_m
        sigma_m = float(np.sqrt(np.trace(covariance[:3, :3])))
        longest_m = max(wheels_m, seen_m)
        if longest_m < 4 * max(sigma_m, _LEAST_M / 2) or self._stands_still(since, measured):
            return  # too short to tell, or what no image can
        ratio = seen_m / max(wheels_m, 1e-3)
        spread = self._scale_error() + sigma_m / max(seen_m, 1e-3)
        expected = self.scale if len(self._ratios) >= _KNOWN_FROM else 1.0
        limit = min(self.config.gate * max(spread, self.config.scale_error), _UNLIKE)
        along_m2 = float(since.prev_from_curr.translation @ measured.translation)
        alike = along_m2 >= _ALONG * wheels_m * seen_m  # not so by wheels of a reversed sign
        agrees = turns and alike and abs(ratio / expected - 1.0) <= limit
        self._agrees.append(agrees)
        self._to_prove = max(self._to_prove - agrees, 0)
        if agrees and sigma_m <= self.config.sharp_share * longest_m:
            self._ratios.append(ratio)

    def _scale_error(self) -> float:
        """Standard deviation of the scale: of the median of the ratios, once they are known."""
        config = self.config
        if len(self._ratios) < _KNOWN_FROM:
            return config.scale_error
        spread = 1.25 * self._spread() / math.sqrt(len(self._ratios))
        return max(config.least_scale_error, spread)

    def _spread(self) -> float:
        """Standard deviation of the ratio of one step about the scale; 0 until that is known."""
        if len(self._ratios) < _KNOWN_FROM:
            return 0.0
        ratios = np.array(self._ratios)
        return 1.4826 * float(np.median(np.abs(ratios - np.median(ratios))))

    def _learn_bias(self, since: OutsideMotion, measured: SE3) -> None:
        """The mean rate beyond what odometry measures while the robot hardly turns."""
        seconds, config = since.seconds, self.config
        if since.rates_rad_s is None or seconds <= 0:
            return
        turned = measured.log()[3:]
        if np.linalg.norm(turned) < config.straight_rad_s * seconds:
            self._bias_s = min(self._bias_s + seconds, _BIAS_S)
            share = min(seconds / self._bias_s, 1.0)
            off = since.rates_rad_s - turned / seconds - self._bias
            self._bias = self._bias + share * off

    def corrected(self, motion: OutsideMotion) -> OutsideMotion:
        """A motion without the gyroscope's bias, as far as that is known.

        The bias turns the translation by half of what it turns the end.
        """
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


# Every so many-th pixel is compared, both ways.
_STEP = 4
# Pixels this close to black or white say nothing: noise is cut off there.
_BLACK, _WHITE = 2, 253
# Fewer pixels than this share say nothing: the image is dark.
_LEAST = 0.05


@dataclass(frozen=True, slots=True)
class FrozenConfig:
    """When pictures count as old. Source: `lab/reports/fixed.md`."""

    equal_share: Annotated[
        float,
        Meta(
            gt=0,
            le=1,
            description="share of equal pixels from which a picture repeats an earlier one; noise "
            "of half a grey level leaves half of them equal",
        ),
    ] = 0.9
    pictures: Annotated[
        int, Meta(ge=1, description="earlier pictures that each is compared with")
    ] = 4
    rest_m: Annotated[
        float, Meta(ge=0, description="distance by wheels between frames that is rest, m")
    ] = 0.02
    rest_rad: Annotated[
        float, Meta(ge=0, description="turn from frame to frame that is rest, rad")
    ] = float(np.deg2rad(0.2))
    moved_m: Annotated[
        float,
        Meta(gt=0, description="distance by wheels, m, over which a still picture is old"),
    ] = 0.3
    moved_rad: Annotated[float, Meta(gt=0, description="turn over which it is old, rad")] = float(
        np.deg2rad(10.0)
    )
    still_share: Annotated[
        float,
        Meta(gt=0, lt=1, description="share of that motion, below which the picture stands still"),
    ] = 0.25

    def __post_init__(self) -> None:
        check_bounds(self)


class Repeats:
    """Recognises pictures that repeat an earlier one."""

    def __init__(self, config: FrozenConfig) -> None:
        self._config = config
        self._last: deque[tuple[NDArray[np.uint8], NDArray[np.uint8]]] = deque(
            maxlen=config.pictures
        )

    def sides(self, pair: StereoPair) -> tuple[bool, bool]:
        """Whether the left and the right picture repeat one of the last pairs.

        Every fourth pixel both ways is compared, by a copy: a camera's driver may fill the same
        arrays again and again.
        """
        left, right = (one[::_STEP, ::_STEP].copy() for one in (pair.left, pair.right))
        found = [
            (self._equal(left, before[0]), self._equal(right, before[1])) for before in self._last
        ]
        self._last.append((left, right))
        both = next((one for one in found if all(one)), None)
        return both or next((one for one in reversed(found) if any(one)), (False, False))

    def _equal(self, now: NDArray[np.uint8], before: NDArray[np.uint8]) -> bool:
        return equal_share(now, before) >= self._config.equal_share


def equal_share(now: NDArray[np.uint8], before: NDArray[np.uint8]) -> float:
    """Share of the pixels of two pictures that are equal, of those that are not black or white.

    Args:
        now: (h, w) uint8 grey.
        before: (h, w) uint8 grey.

    Returns:
        The share; 0 where the picture is too dark or too bright to decide.
    """
    telling, equal = _core.equal_pixels(now, before, _BLACK, _WHITE)
    return 0.0 if telling < _LEAST * now.size else equal / telling


class StandsStill:
    """Recognises pictures that stand still while wheels or a gyroscope say that the robot moves."""

    def __init__(self, config: FrozenConfig) -> None:
        self._config = config
        self._seen = self._told = SE3.identity()
        self._still = False

    def add(self, seen: SE3 | None, told: OutsideMotion | None) -> bool:
        """Whether the picture is old.

        Args:
            seen: prev_from_curr by odometry; None if it failed.
            told: the same motion by a trusted source; None without one.
        """
        if seen is None or told is None:
            self._begin()
            self._still = False
            return False
        self._seen, self._told = self._seen @ seen, self._told @ told.prev_from_curr
        config = self._config
        way_m = self._told.distance_m if told.has_way else 0.0
        turn_rad = self._told.angle_rad
        if way_m >= config.moved_m or turn_rad >= config.moved_rad:
            stood_m = self._seen.distance_m < config.still_share * max(way_m, config.moved_m)
            unturned = self._seen.angle_rad < config.still_share * config.moved_rad
            self._still = stood_m and unturned
            self._begin()
        elif self._seen.distance_m > config.moved_m or self._seen.angle_rad > config.moved_rad:
            self._still = False
            self._begin()
        return self._still

    def _begin(self) -> None:
        self._seen = self._told = SE3.identity()


def rests(told: OutsideMotion | None, config: FrozenConfig) -> bool:
    """Whether wheels say that the robot stands.

    Args:
        told: the motion from frame to frame by a trusted source; None without one.
    """
    if told is None or not told.has_way:
        return False
    moved = told.prev_from_curr
    return moved.distance_m <= config.rest_m and moved.angle_rad <= config.rest_rad
