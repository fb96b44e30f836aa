"""Motion by the visual steps of the last seconds, and by wheels and gyroscope where there are any.

A drop on the lens, a flash or a bus that fills the view stops odometry for a frame or two. The
robot hardly changes its speed in that time, and discarding its position would break up every map
made in a shower. So its motion is extrapolated, with a covariance that allows for braking and
turning. Over longer gaps that covariance grows until the robot counts as lost.

A step that was measured may be wrong, too. It is weighed against the steps before and after it, by
how many landmarks agree on each, and against wheels and gyroscope, by their covariances.

Vague motion: guesses and steps of which odometry is unsure, one after the other. At night in rain a
robot's own headlamps seem to stand still, and so it seems to. Steps are too short then, one after
the other and for the same reason. Taken as independent, their errors would hide in a standard
deviation that grows by the root of their number.

Jumps: consecutive frames taken at different places. A robot is carried on unseen, a player skips, a
buffer lags behind. Odometry then finds next to nothing between two frames, and as much as ever
before and after them. A guess by the last speed would be wrong without a bound there, and all that
is tied to the position with it. Wipers, drops and flashes make steps fail, too, but again and
again, or two in a row: they spoil a frame. And where frames are missing the time that passed bounds
the guess.

Speeds measured in the last seconds, each with the evidence for it. A few landmarks may agree on a
wrong motion: the posts of a guard rail are as far apart as the robot drives between two frames, the
light of one's own headlamps moves with it. So a step is judged only by steps that are as strong as
itself, before and after it. A weak run never overrules strong steps, and what strong steps refute
was wrong.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.geometry.se3 import SE3
from engram.odometry.step import Guess, OdometryStatus, OdometryStep


class VagueRun:
    """Guesses and vague steps in a row: their errors add up, not their variances.

    Args:
        clear_steps: so many steps that are not vague, in a row, end the run.
    """

    def __init__(self, clear_steps: int) -> None:
        self._clear_steps = clear_steps
        self._clear = 0
        # Sum of their standard deviations.
        self._sum_m = 0.0

    def variance_m2(self, sigma_m: float) -> float:
        """What one more step, so wrong by itself, adds to the variance of the distance."""
        return sigma_m * (sigma_m + 2.0 * self._sum_m)

    def go_on(self, sigma_m: float) -> None:
        """One more step, so wrong by itself."""
        self._sum_m += sigma_m
        self._clear = 0

    def adds_up(self, covariance: NDArray[np.float64], sigma_m: float) -> NDArray[np.float64]:
        """One more vague step: its (6, 6) covariance as part of the run, m and rad."""
        scale = np.ones(6)
        scale[:3] = math.sqrt(self.variance_m2(sigma_m)) / sigma_m
        self.go_on(sigma_m)
        return covariance * np.outer(scale, scale)

    def break_off(self) -> None:
        """A step that is not vague; one by itself may be wrong."""
        self._clear += 1
        if self._clear >= self._clear_steps:
            self._sum_m = 0.0


_FRAMES_BEFORE = 20
# Where steps before had less than this share of their median, it is the frames that are poor.
_STEADY_SHARE = 0.3
# Frames are missing if one comes later than this many usual intervals after the last.
_GAP_RATIO = 1.5


class Jumps:
    """Detects jumps by the inliers of odometry's steps.

    Args:
        share: a step with less than this share of the inliers on either side of it is a jump.
        least: fewest inliers on either side: where landmarks are few steps fail by themselves.

    Attributes:
        suspected: whether the last step may be one, which the next step decides.
    """

    def __init__(self, share: float, least: int) -> None:
        self._share, self._least = share, least
        # Inliers of the last steps and the time that they took, the newest last.
        self._steps: deque[tuple[int, float]] = deque(maxlen=_FRAMES_BEFORE)
        self.suspected = False

    def jumped(self, inliers: int, seconds: float) -> bool:
        """Takes a step; whether the one before it was a jump.

        Args:
            inliers: of this step; 0 if it failed.
        """
        jumped = (
            self.suspected and inliers >= self._least and self._steps[-1][0] < self._share * inliers
        )
        self.suspected = self._is_suspect(inliers, seconds)
        self._steps.append((inliers, seconds))
        return jumped

    def _is_suspect(self, inliers: int, seconds: float) -> bool:
        """Whether a step fails after many that did not, and in the usual time."""
        if not self._steps:
            return False
        before = [count for count, _ in self._steps]
        usual, usual_s = statistics.median(before), statistics.median(s for _, s in self._steps)
        return (
            usual >= self._least
            and inliers < self._share * usual
            and min(before) >= _STEADY_SHARE * usual
            and seconds <= _GAP_RATIO * usual_s
        )


_NS_PER_S = 1e9


@dataclass(frozen=True, slots=True)
class Speed:
    """Evidence of one visual step about the speed.

    Attributes:
        stamp_ns: of the frame in which it ends.
        m_per_s: x, y, z in the camera that it begins in.
        sigma_m: standard deviation of its length.
        doubted: whether its covariance allows for its being wrong.
    """

    stamp_ns: int
    seconds: float
    m_per_s: list[float]
    sigma_m: float
    inliers: int
    doubted: bool = False

    def off_m(self, other: Speed) -> float:
        """How much further or shorter this step would be at the speed of another one."""
        return math.dist(self.m_per_s, other.m_per_s) * self.seconds

    def within_reach(self, other: Speed, since_s: float, acceleration_m_s2: float) -> bool:
        """Whether an acceleration since then leads from the speed of another step to this one."""
        possible_m = acceleration_m_s2 * since_s * self.seconds
        return self.off_m(other) <= possible_m + 3 * self.sigma_m


class Speeds:
    """Judges steps by those of the last seconds, and says how fast the robot is.

    Args:
        window_s: how long a step counts.
        weak_share: a step with less than this share of the usual inliers is weak.
        steps: so many of the newest make the median speed, and so many in a row may overrule.
        steps_to_know: after so many the speed counts as known.
        weak_m_s2: greatest one that a weak step may claim.
    """

    def __init__(
        self,
        window_s: float,
        weak_share: float,
        steps: int,
        steps_to_know: int,
        greatest_m_s2: float,
        weak_m_s2: float,
    ) -> None:
        self._window_ns = round(window_s * _NS_PER_S)
        self._weak_share = weak_share
        self._greatest_m_s2, self._weak_m_s2 = greatest_m_s2, weak_m_s2
        self._steps, self._steps_to_know = steps, steps_to_know
        # Stamp and inliers of all measured steps, and of those that were believed.
        self._seen: deque[tuple[int, int]] = deque()
        self._believed: deque[tuple[int, int]] = deque()
        # Those from which a speed was learnt, and consecutive ones that contradict these.
        self._learnt: deque[Speed] = deque()
        self._against: list[Speed] = []
        # Upper quartile of the inliers: a weak run is usual once it fills most of the window.
        self._usual = 0
        # Fewest inliers of a strong step.
        self.strong_from = 0.0
        # Median of the newest speeds.
        self.m_per_s: NDArray[np.float64] = np.zeros(3)

    @property
    def any(self) -> bool:
        """Whether there is a speed at all."""
        return bool(self._learnt)

    @property
    def known(self) -> bool:
        """Whether it rests on enough steps."""
        return len(self._learnt) >= self._steps_to_know

    def see(self, stamp_ns: int, inliers: int) -> None:
        """A step was measured."""
        for steps in (self._seen, self._believed):
            while len(steps) > self._steps and stamp_ns - steps[0][0] > self._window_ns:
                steps.popleft()
        while len(self._learnt) > self._steps and self._is_old(self._learnt[0], stamp_ns):
            self._learnt.popleft()
        self._seen.append((stamp_ns, inliers))
        counts = sorted(count for _, count in self._seen)
        self._usual = counts[(3 * len(counts)) // 4]
        self.strong_from = self._weak_share * self._usual

    def stronger_than_all(self, inliers: int) -> bool:
        """Whether the evidence for the speed is weak compared with so many inliers."""
        floor = self._floor(inliers)
        return self.any and all(one.inliers < floor for one in self._learnt)

    def possible(self, step: Speed) -> bool:
        """Whether the robot may be as fast as a step says, by what is as strong as it.

        The longer ago that was accepted, the more the speed may have changed; less so by weak
        steps. Steps that agree among themselves, as strong and as many as those that they
        contradict, overrule these.
        """
        floor = self._floor(step.inliers)
        if step.inliers < self.strong_from and not self._likely(step):
            return False
        newest = self._newest(floor)
        if newest is None or step.seconds <= 0:
            return True
        believed = (stamp for stamp, count in reversed(self._believed) if count >= floor)
        since_s = (step.stamp_ns - next(believed, newest.stamp_ns)) / _NS_PER_S
        if step.within_reach(newest, since_s, self._greatest_m_s2):
            return True
        judges = [one for one in self._learnt if one.inliers >= floor]
        return len(judges) < self._steps_to_know or self._overrules(step, judges)

    def believe(self, step: Speed) -> float:
        """Takes a step as true.

        Returns:
            How far earlier undoubted steps that it refutes were wrong in all, m.
        """
        refuted_m = 0.0
        while self._learnt and step.seconds > 0:
            newest = self._learnt[-1]
            since_s = (step.stamp_ns - newest.stamp_ns) / _NS_PER_S
            if step.within_reach(newest, since_s, self._greatest_m_s2):
                break
            overruled = self._against or newest.inliers < self._floor(step.inliers)
            if not overruled:
                break
            refuted_m += 0.0 if newest.doubted else newest.off_m(step)
            self._learnt.pop()
        self._against.clear()
        self._believed.append((step.stamp_ns, step.inliers))
        return refuted_m

    def _likely(self, step: Speed) -> bool:
        """Whether a weak step is one of usual driving, by the newest strong one."""
        strong = self._newest(self.strong_from)
        if strong is None or step.seconds <= 0:
            return True
        since_s = (step.stamp_ns - strong.stamp_ns) / _NS_PER_S
        return step.within_reach(strong, since_s, self._weak_m_s2)

    def learn(self, step: Speed) -> None:
        """Learns the speed from an accepted step."""
        self._learnt.append(step)
        newest = reversed(self._learnt)
        strong = [one.m_per_s for one in newest if one.inliers >= self.strong_from]
        self.m_per_s = _median(strong[: self._steps] or [step.m_per_s])

    def _newest(self, floor: float) -> Speed | None:
        """The newest with so many inliers; None without one."""
        return next((one for one in reversed(self._learnt) if one.inliers >= floor), None)

    def _floor(self, inliers: int) -> float:
        """Fewest inliers of what judges a step of so many: any if it is weak itself."""
        weak = inliers < self.strong_from
        return 0.0 if weak else self._weak_share * max(inliers, self._usual)

    def _overrules(self, step: Speed, judges: Sequence[Speed]) -> bool:
        """Whether steps in a row, with this one, are worth more than those they contradict."""
        if self._against:
            last = self._against[-1]
            since_s = (step.stamp_ns - last.stamp_ns) / _NS_PER_S
            if not step.within_reach(last, since_s, self._greatest_m_s2):
                self._against.clear()
        self._against.append(step)
        floor = self._weak_share * max(one.inliers for one in judges)
        strong = sum(one.inliers >= floor for one in self._against)
        return strong >= max(self._steps, len(judges))

    def _is_old(self, step: Speed, stamp_ns: int) -> bool:
        return stamp_ns - step.stamp_ns > self._window_ns


def _median(rows: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """The median of each column, as `np.median` has it."""
    low, high = (len(rows) - 1) // 2, len(rows) // 2
    columns = (sorted(column) for column in zip(*rows, strict=True))
    return np.array([0.5 * (column[low] + column[high]) for column in columns])


# Variance of an unknown turn rate, (rad/s)².
_ANY_TURN = 1e4
# Standard deviations apart from which wheels and odometry do not measure the same.
_GATE = 4.0


@dataclass(frozen=True, slots=True)
class GapConfig:
    """How motion is guessed where odometry fails. Source: `lab/reports/constants.md`."""

    sigma_per_m: Annotated[
        float,
        Meta(
            gt=0,
            description="standard deviation of a guess per metre of the gap; 0.5 covers 68 % of "
            "all but the longest gaps",
        ),
    ] = 0.5
    sigma_rad_per_m: Annotated[
        float, Meta(gt=0, description="standard deviation of its turn, rad per metre of the gap")
    ] = float(np.deg2rad(2.5))
    least_sigma_m: Annotated[
        float, Meta(gt=0, description="least standard deviation of a guess, m, even at rest")
    ] = 0.05
    least_sigma_rad: Annotated[
        float, Meta(gt=0, description="least standard deviation of its turn, rad")
    ] = float(np.deg2rad(0.5))
    speed_steps: Annotated[
        int,
        Meta(
            ge=1,
            description="steps in the median speed, and vague ones in a row that do not count: "
            "odometry often degrades before it fails",
        ),
    ] = 5
    steps_to_know_speed: Annotated[
        int, Meta(ge=1, description="measured steps after which the speed is used")
    ] = 3
    sharp_share: Annotated[
        float,
        Meta(
            gt=0,
            description="largest standard deviation of a step that counts for the speed, as a "
            "share of its length: wrong steps in rain and at night are mostly too short",
        ),
    ] = 0.25
    vague_share: Annotated[
        float,
        Meta(
            gt=0,
            description="standard deviation of a vague step, as a share of its length: errors of "
            "such steps in a row have one cause, and add up",
        ),
    ] = 0.4
    newest_steps: Annotated[
        int,
        Meta(
            ge=1,
            description="window of steps; the share that is missing is the share of measured steps "
            "taken to be wrong by their whole length",
        ),
    ] = 10
    greatest_acceleration_m_s2: Annotated[
        float,
        Meta(
            gt=0,
            description="m/s²; a measured step beyond it counts as missing: a car brakes with up "
            "to 8, a drone turns back with 10",
        ),
    ] = 10.0
    drift_m: Annotated[
        float,
        Meta(
            ge=0,
            description="standard deviation, m, that errors which steps share add over a metre: "
            "of offset and calibration, 0.4 % of 20 m",
        ),
    ] = 0.018
    acceleration_m_s2: Annotated[
        float,
        Meta(
            ge=0,
            description="standard deviation of the mean acceleration over a gap, m/s²: a car pulls "
            "away with 1",
        ),
    ] = 0.5
    jump_share: Annotated[
        float,
        Meta(
            ge=0,
            lt=1,
            description="a step with less than this share of the inliers before and after it was "
            "no motion: the frames were taken at different places. 0: never. "
            "Source: lab/reports/faults.md",
        ),
    ] = 0.1
    jump_inliers: Annotated[
        int, Meta(ge=1, description="fewest inliers before and after such a step")
    ] = 60
    steady_s: Annotated[
        float, Meta(ge=0, description="s within which no robot sets off unnoticed")
    ] = 0.5
    window_s: Annotated[
        float, Meta(gt=0, description="s for which a measured step is evidence of the speed")
    ] = 2.0
    weak_share: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="a step with less than this share of the usual inliers is weak: it is "
            "judged by strong ones and judges none of them",
        ),
    ] = 0.6
    weak_m_s2: Annotated[
        float,
        Meta(
            gt=0,
            description="m/s² since the last strong step; a weak one beyond it counts as missing: "
            "a car brakes with 3 in traffic",
        ),
    ] = 4.0
    refuted_m: Annotated[
        float,
        Meta(
            ge=0,
            description="greatest total error of weak steps refuted by a strong one, m; beyond it "
            "the position no longer follows from them",
        ),
    ] = 1.0
    sure_start: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="share of a frame's landmarks that agree on a sure step. A drive that "
            "begins with fewer is guessed to move so, until a sure step or for `unsure_s`",
        ),
    ] = 0.15
    unsure_s: Annotated[
        float,
        Meta(
            ge=0,
            description="s after which a series of weak steps is accepted: a dark or wet road",
        ),
    ] = 3.0

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion of the camera since the previous usable frame, with the gaps of odometry filled.

    Attributes:
        prev_from_curr: pose of this frame in the previous usable one; None at the first frame of a
            drive and at an unusable one.
        covariance: (6, 6) float64 of `prev_from_curr`, left perturbation, [translation in
            m, rotation in rad], as large as makes chains of motions right, whose errors are partly
            the same; `odometry` has that of the step by itself. None if the motion is.
        guessed_m: standard deviation of a guess, metres, also where a weak measurement is doubtful;
            0 if odometry measured the motion.
        ahead: at an unusable frame, the guess of the motion since the last usable one, with its
            (6, 6) float64 covariance; it is not part of the motion that the next usable frame
            brings.
        jumped: whether the frame before was taken at a different place, which this one decides:
            where the robot is now does not follow from where it was.
        suspected: whether this frame may be at a different place, which the next one decides.
    """

    odometry: OdometryStep
    prev_from_curr: SE3 | None = None
    covariance: NDArray[np.float64] | None = None
    guessed_m: float = 0.0
    ahead: tuple[SE3, NDArray[np.float64]] | None = None
    jumped: bool = False
    suspected: bool = False

    @property
    def moved_m(self) -> float:
        """Distance since the previous usable frame, metres."""
        return 0.0 if self.prev_from_curr is None else self.prev_from_curr.distance_m

    @property
    def usable(self) -> bool:
        """Whether the frame is usable; the next usable one carries the motion past it."""
        return self.odometry.status is not OdometryStatus.UNUSABLE_FRAME


UNMOVED = Motion(OdometryStep(OdometryStatus.FIRST))


def driven_steps_m(motions: Sequence[Motion], stamps_ns: Sequence[int]) -> NDArray[np.float64]:
    """Distance of each step of a drive, with a share for each unusable frame.

    The distance past unusable frames is known at the next usable one, and is shared among them by
    time, as a robot was not localised there (method §8). The distance after the last usable frame
    is unknown and counts as 0.

    Args:
        motions: F motions, each ending in one frame.
        stamps_ns: F stamps of these frames, increasing.

    Returns:
        (F,) float64, metres.
    """
    steps_m = np.array([one.moved_m for one in motions], np.float64)
    seen = np.array([one.usable for one in motions], np.bool_)
    if seen.all() or not seen.any():
        return steps_m
    since_ns = np.array([stamp - stamps_ns[0] for stamp in stamps_ns], np.float64)
    driven_m = np.interp(since_ns, since_ns[seen], np.cumsum(steps_m)[seen])
    return np.diff(driven_m, prepend=driven_m[0]).clip(0.0)


_ANY_MOTION = Guess(SE3.identity(), np.eye(6) * np.pi**2, np.inf)


class GapFiller:
    """Takes the steps of odometry in order, weighs them, and guesses the missing ones.

    - A measurement less certain than the guess counts as missing, but only for a few steps, as the
      robot may change its speed.
    - A measurement that needs an impossible acceleration counts as missing. At night in rain, the
      robot's own headlamps on the road make it seem to stop at once, with a small covariance. The
      longer ago the speed was measured, the larger the change allowed. Only steps as strong as it
      may decide (`Speeds`).
    - The first weak measurements of a drive, and those that follow others which contradicted
      strong ones, are guesses that may be wrong by their whole length, until strong ones come.
    - Where wheels and gyroscope agree with a measurement that is vaguer, both are weighed.
    - The covariance of measured steps grows with the share of missing steps among the newest, and
      by the distance that earlier ones, refuted by it, were wrong.
    - Calibration and the offset of disparities err alike from step to step: `drift_m`.
    - Errors of guesses and vague steps in a row have one cause, and add up: at night in rain all
      are too short. Among them the robot may be as fast as when odometry was last sharp.
    - A robot that starts its drive moving, without a measured step, has no known speed. Its first
      measured step also accounts for the time before, at the same speed.
    """

    def __init__(self, config: GapConfig = GapConfig()) -> None:
        self.config = self._config = config
        self._speeds = Speeds(
            config.window_s,
            config.weak_share,
            config.speed_steps,
            config.steps_to_know_speed,
            config.greatest_acceleration_m_s2,
            config.weak_m_s2,
        )
        # Consecutive measurements too uncertain to determine the speed.
        self._unlearnt = 0
        self._turn_per_s = np.zeros(3)
        self._turn_variance = _ANY_TURN
        self._stamp_ns: int | None = None
        self._run = VagueRun(config.steps_to_know_speed)
        self._jumps = Jumps(config.jump_share, config.jump_inliers)
        # Speed of the newest sharp step, or the greatest since.
        self._fast_m_per_s = 0.0
        # Consecutive measurements less certain than a guess.
        self._vague = 0
        # Stamp of the newest motion that was measured and accepted.
        self._believed_ns: int | None = None
        # Whether each of the newest steps was missing.
        self._missing: deque[bool] = deque(maxlen=self._config.newest_steps)
        # Speed that was expected at each of the newest steps.
        self._guessed_m_per_s: deque[float] = deque(maxlen=self._config.newest_steps)
        # Time for which the robot has moved at a speed not yet known.
        self._unknown_s = 0.0
        # Whether steps are unsure: at the start, and since weak ones contradicted strong ones.
        self._unsure = True
        # When the first such step was believed, and the inliers of a sure one; None at the start.
        self._unsure_from_ns: int | None = None
        self._sure_from: float | None = None

    def motion(
        self,
        odometry: OdometryStep,
        stamp_ns: int,
        outside: Guess | None = None,
        *,
        doubted: bool = False,
        landmarks: int = 0,
    ) -> Motion:
        """The motion since the previous usable frame.

        Args:
            odometry: the step that ends in this frame.
            stamp_ns: stamp of the frame.
            outside: the same motion by wheels and gyroscope; None if unknown.
            doubted: whether it disproves odometry, which then counts as missing.
            landmarks: of the frame; 0 if unknown. Where that is, or the step comes from a map and
                has no inliers, it is taken to be as strong as any.
        """
        if odometry.status is OdometryStatus.UNUSABLE_FRAME:
            return Motion(odometry, ahead=self._ahead(stamp_ns, outside))
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        if odometry.status is OdometryStatus.FIRST:
            return Motion(odometry)
        seconds = 0.0 if before is None else (stamp_ns - before) / _NS_PER_S
        moved = self._moved(odometry, stamp_ns, seconds, outside, landmarks, doubted=doubted)
        # Wheels or a gyroscope know of a motion that the images do not show.
        jumped, suspected = self._jumps.jumped(odometry.inliers, seconds), self._jumps.suspected
        if outside is not None or not (jumped or suspected):
            return moved
        return replace(moved, jumped=jumped or moved.jumped, suspected=suspected)

    def _moved(
        self,
        odometry: OdometryStep,
        stamp_ns: int,
        seconds: float,
        outside: Guess | None,
        landmarks: int,
        *,
        doubted: bool,
    ) -> Motion:
        """The motion within so many seconds: measured, or a guess."""
        measured, covariance = odometry.prev_from_curr, odometry.covariance
        if not doubted and outside is not None and outside.contradicts(measured, covariance, _GATE):
            outside = None  # the images are surer
        guess = self._guess(seconds, stamp_ns, outside)
        if seconds > 0 and self._speeds.known:
            self._guessed_m_per_s.append(guess.prev_from_curr.distance_m / seconds)
        if measured is None or covariance is None or doubted:
            return self._missed(odometry, guess, outside, seconds)
        if outside is not None and outside.is_sharper(covariance):
            measured, covariance = outside.weighed_with(measured, covariance)
        sigma_m = _core.greatest_sigma(covariance)
        twist = measured.log()
        per_s = twist / seconds if seconds > 0 else twist
        speed = Speed(stamp_ns, seconds, per_s[:3].tolist(), sigma_m, odometry.inliers)
        self._speeds.see(stamp_ns, odometry.inliers)
        confirmed = outside is not None and outside.has_way
        if not confirmed and not self._plausible(speed, guess, measured.distance_m):
            return self._missed(odometry, guess, outside, seconds)
        refuted_m = self._speeds.believe(speed)
        unsure_m = self._unsure_m(odometry.inliers, landmarks, measured, seconds)
        if confirmed:
            refuted_m = unsure_m = 0.0
        self._missing.append(False)
        self._believed_ns = stamp_ns
        if seconds > 0:
            speed = replace(speed, doubted=True) if unsure_m else speed
            self._learn(speed, measured.distance_m, per_s[3:], covariance)
        wrong_m = math.hypot(unsure_m, refuted_m)
        measured, covariance = self._as_sure(measured, covariance, sigma_m, wrong_m, seconds)
        covariance = covariance + self._drift(measured)
        jumped = refuted_m > self._config.refuted_m
        return Motion(odometry, measured, covariance, unsure_m, jumped=jumped)

    def _as_sure(
        self,
        measured: SE3,
        covariance: NDArray[np.float64],
        sigma_m: float,
        wrong_m: float,
        seconds: float,
    ) -> tuple[SE3, NDArray[np.float64]]:
        """An accepted step, with its possible error and the error of missing steps before it."""
        if wrong_m:
            covariance, sigma_m = covariance + self._wrong_by(wrong_m), math.hypot(sigma_m, wrong_m)
        if sigma_m <= self._vague_from_m(measured, seconds):
            self._run.break_off()
        else:
            covariance = self._run.adds_up(covariance, sigma_m)
        if any(self._missing):
            covariance = covariance + self._doubt(measured, seconds)
        if self._unknown_s and seconds > 0:
            return self._made_up_for(measured, covariance, seconds)
        return measured, covariance

    def _plausible(self, speed: Speed, guess: Guess, step_m: float) -> bool:
        """Whether a measured step is better than the guess, and possible."""
        if self._too_vague(speed.sigma_m, guess) and not (
            self._is_sharp(speed, step_m) and self._speeds.stronger_than_all(speed.inliers)
        ):
            return False
        possible, strong_from = self._speeds.possible(speed), self._speeds.strong_from
        if not possible and speed.inliers < strong_from:
            before = self._sure_from if self._unsure else None
            self._sure_from = max(before or 0.0, strong_from)
            self._unsure, self._unsure_from_ns = True, None
        return possible

    def _missed(
        self, odometry: OdometryStep, guess: Guess, outside: Guess | None, seconds: float
    ) -> Motion:
        """A step that was not measured, or is not accepted."""
        self._missing.append(True)
        if guess is not outside:
            self._run.go_on(self._wrong_m(guess.prev_from_curr, seconds))
        if guess is _ANY_MOTION:
            self._unknown_s += max(seconds, 0.0)
        return Motion(odometry, guess.prev_from_curr, guess.covariance, guess.sigma_m)

    def _unsure_m(self, inliers: int, landmarks: int, measured: SE3, seconds: float) -> float:
        """How wrong an unsure step may be: all of it, until enough landmarks agree on one."""
        if not self._unsure:
            return 0.0
        assert self._stamp_ns is not None
        if self._unsure_from_ns is None:
            self._unsure_from_ns = self._stamp_ns
        sure_from = self._sure_from
        if sure_from is None:
            sure_from = self._config.sure_start * landmarks
        unsure_s = (self._stamp_ns - self._unsure_from_ns) / _NS_PER_S
        self._unsure = 0 < inliers < sure_from and unsure_s < self._config.unsure_s
        if not self._unsure:
            return 0.0
        return max(self._step_m(measured, seconds), self._config.least_sigma_m)

    def _learn(
        self,
        speed: Speed,
        step_m: float,
        turn_per_s: NDArray[np.float64],
        covariance: NDArray[np.float64],
    ) -> None:
        """Updates speed and turn rate for later guesses, weighted by certainty."""
        seconds, speeds, sharp = speed.seconds, self._speeds, self._is_sharp(speed, step_m)
        self._unlearnt = 0 if sharp else self._unlearnt + 1
        # An uncertain speed is better than none, or an old one.
        if sharp or not speeds.known or self._unlearnt > self._config.speed_steps:
            speeds.learn(speed)
            speed_m_per_s = math.sqrt(speeds.m_per_s @ speeds.m_per_s)
            since_m_per_s = 0.0 if sharp else self._fast_m_per_s
            self._fast_m_per_s = max(speed_m_per_s, since_m_per_s)
        # A Kalman filter; the turn rate changes per step by the error of a guess. The change does
        # not grow over a gap: the next guesses would then rest on the first uncertain step.
        change_rad = max(self._config.sigma_rad_per_m * step_m, self._config.least_sigma_rad)
        expected = self._turn_variance + (change_rad / seconds) ** 2
        measured_to = float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) / seconds**2
        gain = expected / (expected + measured_to)
        self._turn_per_s = self._turn_per_s + gain * (turn_per_s - self._turn_per_s)
        self._turn_variance = (1.0 - gain) * expected

    def _made_up_for(
        self, measured: SE3, covariance: NDArray[np.float64], seconds: float
    ) -> tuple[SE3, NDArray[np.float64]]:
        """The first measured step, preceded by the unmeasured motion at the same speed.

        The turn is left out: over several steps it does not stay constant.
        """
        steps, self._unknown_s = self._unknown_s / seconds, 0.0
        before = SE3(np.eye(3), measured.log()[:3] * steps)
        per_m = [self._config.sigma_per_m, self._config.sigma_rad_per_m]
        wrong = np.repeat(per_m, 3) * before.distance_m
        adjoint = before.adjoint()
        carried = adjoint @ covariance @ adjoint.T
        return before @ measured, carried + steps**2 * covariance + np.diag(wrong**2)

    def _drift(self, measured: SE3) -> NDArray[np.float64]:
        """(6, 6) covariance that a measured step adds to the errors that steps share."""
        variance_m2 = self._config.drift_m**2 * measured.distance_m
        return np.diag([variance_m2] * 3 + [0.0] * 3)

    def _doubt(self, measured: SE3, seconds: float) -> NDArray[np.float64]:
        """(6, 6) additional covariance of a measured step among missing ones.

        For a robot that seems to have stopped it follows from its previous speed.
        """
        share = sum(self._missing) / self._config.newest_steps
        return share * self._wrong_by(self._step_m(measured, seconds))

    def _wrong_by(self, wrong_m: float) -> NDArray[np.float64]:
        """(6, 6) covariance of a step that may be wrong by so much."""
        return np.diag(np.repeat([wrong_m**2, (self._config.sigma_rad_per_m * wrong_m) ** 2], 3))

    def _is_sharp(self, speed: Speed, step_m: float) -> bool:
        """Whether a step is certain enough to count for the speed."""
        config = self._config
        return speed.sigma_m <= max(config.sharp_share * step_m, 0.5 * config.least_sigma_m)

    def _step_m(self, measured: SE3, seconds: float) -> float:
        """Length of a step, metres, or what was expected lately if that is more."""
        return max(measured.distance_m, max(self._guessed_m_per_s, default=0.0) * seconds)

    def _vague_from_m(self, measured: SE3, seconds: float) -> float:
        """Standard deviation from which a step is vague, metres."""
        share = self._config.vague_share
        return max(share * self._step_m(measured, seconds), self._config.least_sigma_m)

    def _wrong_m(self, guess: SE3, seconds: float) -> float:
        """How wrong a guess is by itself, metres: the robot may be as fast as it was."""
        fast_m = self._fast_m_per_s * seconds
        return self._config.sigma_per_m * max(guess.distance_m, fast_m)

    def _too_vague(self, sigma_m: float, guess: Guess) -> bool:
        vague = sigma_m > guess.sigma_m
        self._vague = self._vague + 1 if vague else 0
        return vague and self._vague <= self._config.speed_steps

    def _ahead(
        self, stamp_ns: int, outside: Guess | None
    ) -> tuple[SE3, NDArray[np.float64]] | None:
        """Guess of the motion since the last usable frame; None before the first."""
        if self._stamp_ns is None or stamp_ns <= self._stamp_ns:
            return None
        guess = self._guess((stamp_ns - self._stamp_ns) / _NS_PER_S, stamp_ns, outside)
        return guess.prev_from_curr, guess.covariance

    def _guess(self, seconds: float, stamp_ns: int, outside: Guess | None = None) -> Guess:
        """Motion from outside, or at the last speed and turn rate; unbounded if all is unknown.

        A gyroscope alone replaces the turn.
        """
        if outside is not None and outside.has_way:
            return outside
        if not self._speeds.any or seconds <= 0:
            return _ANY_MOTION
        guess = SE3.exp(np.concatenate([self._speeds.m_per_s, self._turn_per_s]) * seconds)
        config = self._config
        grown_m = math.sqrt(self._run.variance_m2(self._wrong_m(guess, seconds)))
        least_m = max(config.least_sigma_m, self._started_m(seconds, stamp_ns))
        sigma_m = math.hypot(grown_m, least_m)
        turned_rad = config.sigma_rad_per_m / config.sigma_per_m * grown_m
        sigma_rad = math.hypot(turned_rad, config.least_sigma_rad)
        covariance = np.zeros((6, 6))
        variances = covariance.reshape(-1)[::7]
        variances[:3], variances[3:] = sigma_m**2, sigma_rad**2
        if outside is not None:
            guess = SE3(outside.prev_from_curr.rotation, guess.translation)
            covariance[3:, 3:] = outside.covariance[3:, 3:]
        return Guess(guess, covariance, sigma_m)

    def _started_m(self, seconds: float, stamp_ns: int) -> float:
        """How far a robot that stood, or held its speed, may have got by speeding up, metres."""
        gap_s = seconds if self._believed_ns is None else (stamp_ns - self._believed_ns) / _NS_PER_S
        steady_s, acceleration_m_s2 = self._config.steady_s, self._config.acceleration_m_s2
        until_s, since_s = (max(one - steady_s, 0.0) for one in (gap_s, gap_s - seconds))
        return 0.5 * acceleration_m_s2 * float(np.sqrt(max(until_s**4 - since_s**4, 0.0)))
