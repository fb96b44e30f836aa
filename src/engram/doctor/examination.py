"""Collects evidence about a drive from frames as they are computed.

Live frames matched with those of a map as if the live camera were calibrated otherwise. A wrong
focal length or baseline bends the scene that a robot measures. Fewer landmarks then fit the map,
and where they do, the position is off: of a scene 15 m away by 1.5 m for a focal length that is
wrong by a tenth. As they fit best by the right calibration, the map shows what that is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import PUBLIC, check_bounds
from engram.frontend.features import SideMatches, match_sides
from engram.frontend.frame import Frame, FrameStatus, StereoPair
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import Clock
from engram.odometry.motion import Motion
from engram.odometry.outside import equal_share
from engram.odometry.step import OdometryStatus
from engram.sequences.clocks import StampReport
from engram.sequences.sequence import LoggedFrame

# Factors by which focal length or baseline may be too large: 0.75 to 1.33, in steps of 5 %.
FACTORS: NDArray[np.float64] = np.exp(np.linspace(-1, 1, 13) * np.log(4 / 3))
AS_IT_IS = len(FACTORS) // 2
# So many frames are matched again, each at least so many after the one before.
MOST, APART = 16, 8
# Inliers tell something if there are so many a frame, and stand out of their median by so many of
# its standard deviations, as chance would have it.
_LEAST, _STANDS_OUT = 5, 6.0
# Another calibration fits better that has so many times the inliers, and so many standard
# deviations more.
_GAIN, _MORE = 1.03, 1.0


class Rematched:
    """Frames to be matched again by other calibrations, and the factors that this decides.

    Each costs twice as many matches as there are `FACTORS`. They are made once a factor is asked
    for, not while the robot drives.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._waiting: list[tuple[Frame, Frame, MatcherConfig]] = []
        # (13,) int64: sums of inliers if that is too large by `FACTORS`.
        self._focal = np.zeros(len(FACTORS), np.int64)
        self._baseline = np.zeros(len(FACTORS), np.int64)

    def add(self, reference: Frame, live: Frame, matcher: MatcherConfig) -> None:
        """Takes one more live frame with a frame of the map that shows the same."""
        self._waiting.append((reference, live, matcher))
        self.frames += 1

    def _match(self) -> None:
        first = self.frames - len(self._waiting)
        for seed, (reference, live, matcher) in enumerate(self._waiting, first):
            for sums, changed in ((self._focal, _refocused), (self._baseline, _rebased)):
                seen = (replace(live, camera=changed(live.camera, by)) for by in FACTORS.tolist())
                sums += [match_frames(reference, one, matcher, seed).inliers for one in seen]
        self._waiting.clear()

    @property
    def focal_factor(self) -> float | None:
        """Factor by which the focal length is too long; None if undetermined."""
        self._match()
        return self._factor(self._focal, self._baseline)

    @property
    def baseline_factor(self) -> float | None:
        """The same of the baseline."""
        self._match()
        return self._factor(self._baseline, self._focal)

    def _factor(self, inliers: NDArray[np.int64], other: NDArray[np.int64]) -> float | None:
        """Where the inliers are most; 1 where the calibration, or the other fault, fits better."""
        most, usual = int(inliers.max()), int(inliers[AS_IT_IS])
        chance = float(np.median([inliers, other]))
        least = max(_LEAST * self.frames, chance + _STANDS_OUT * chance**0.5)
        if self.frames == 0 or max(most, int(other.max())) < least:
            return None
        better = most >= _GAIN * usual and most >= usual + _MORE * usual**0.5
        if not better or most < other.max():
            return 1.0
        return float(np.exp(_peak(np.log(FACTORS), inliers)))


def _refocused(camera: StereoCamera, by: float) -> StereoCamera:
    return replace(camera, fx=camera.fx / by, fy=camera.fy / by)


def _rebased(camera: StereoCamera, by: float) -> StereoCamera:
    return replace(camera, baseline_m=camera.baseline_m / by)


def _peak(at: NDArray[np.float64], heights: NDArray[np.int64]) -> float:
    """Peak of a parabola through the highest of evenly spaced heights and its neighbours."""
    top = int(heights.argmax())
    if not 0 < top < len(at) - 1:
        return float(at[top])
    before, highest, after = (float(one) for one in heights[top - 1 : top + 2])
    bend = before - 2 * highest + after
    return float(at[top] + (at[1] - at[0]) * (0.5 * (before - after) / bend if bend else 0.0))


Array = NDArray[np.float64]

# Fewest matches that must agree on the alignment of a pair, or of a part of the image.
_LEAST_MATCHES = 20
_LEAST_SHARE = 0.4
_LEAST_CELLS = 3
_AGREE_PX = 1.5
_LEAST_SCATTER_PX = 0.3
_SAMPLES = 200
_FURTHEST_M = 3.0
# Of offset, roll, scale and way forwards; far points alone cannot tell the last two apart.
_DAMPING = np.diag([0.05, 0.05, 0.5, 0.05])
# A match that decides the fit by itself is likelier a wrong one.
_MOST_LEVERAGE = 0.3
_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """How the right image of one pair is aligned with the left one.

    Attributes:
        offset_px: vertical offset, left minus right, at the principal point.
        slope_px: (2,) change of that over the width and the height of the image: roll and scale.
        forward_m: distance forwards from where the left image was taken to where the right one was.
        sigma_m: standard deviation of that.
    """

    offset_px: float
    slope_px: tuple[float, float]
    forward_m: float
    sigma_m: float
    agreeing: SideMatches

    @property
    def rms_px(self) -> float:
        """Root of the mean square of the vertical offset over the image."""
        return math.sqrt(self.offset_px**2 + sum(one**2 for one in self.slope_px) / 12)


def align(matches: SideMatches, camera: StereoCamera, seed: int = 0) -> Alignment | None:
    """Fits the vertical offsets of one pair's matches; None if too few agree.

    If the right image is taken t_z further ahead, rays meet where dv = −t_z·(y·d − x·dv)/b, with
    x, y the left pixel from the principal point over f (the epipolar constraint of a translation
    (b, 0, t_z)). An offset, a roll and a scale shift rows, too. The best of random quadruples,
    refined: far points, whose offset says nothing of t_z, are often the majority.
    """
    if len(matches) < _LEAST_MATCHES:
        return None
    across = (matches.pixels[:, 0] - camera.cx) / camera.fx
    down = (matches.pixels[:, 1] - camera.cy) / camera.fy
    disparity, offset = matches.shift.T
    nearness = (down * disparity - across * offset) / camera.baseline_m
    rows = np.column_stack([np.ones_like(across), across, down, -nearness])
    found = _consensus(rows, offset, np.random.default_rng(seed))
    for _ in range(_ROUNDS):
        agree = np.abs(offset - rows @ found) < _AGREE_PX
        if agree.sum() < max(_LEAST_MATCHES, _LEAST_SHARE * len(rows)):
            return None
        normal = rows[agree].T @ rows[agree] + _DAMPING
        agree &= np.sum(rows @ np.linalg.inv(normal) * rows, axis=1) < _MOST_LEVERAGE
        normal = rows[agree].T @ rows[agree] + _DAMPING
        found = np.linalg.solve(normal, rows[agree].T @ offset[agree])
    scatter = max(float(np.std((offset - rows @ found)[agree])), _LEAST_SCATTER_PX)
    sigma = scatter * float(np.sqrt(np.linalg.inv(normal)[3, 3]))
    slope_px = (
        float(found[1]) * camera.width / camera.fx,
        float(found[2]) * camera.height / camera.fy,
    )
    agreeing = SideMatches(matches.pixels[agree], matches.shift[agree])
    return Alignment(float(found[0]), slope_px, float(found[3]), sigma, agreeing)


def _consensus(rows: Array, values: Array, rng: np.random.Generator) -> Array:
    """The solution of one quadruple of rows, or 0, that fits most rows."""
    drawn = rng.integers(0, len(rows), (_SAMPLES, 4))
    sound = np.abs(np.linalg.det(rows[drawn])) > 1e-6
    solved = np.linalg.solve(rows[drawn][sound], values[drawn][sound][..., None])[..., 0]
    tried = np.vstack([solved[np.abs(solved[:, 3]) < _FURTHEST_M], np.zeros(4)])
    misfit = np.minimum(np.abs(values - tried @ rows.T), _AGREE_PX).sum(axis=1)
    best: Array = tried[int(misfit.argmin())]
    return best


def rows_off(samples: list[SideMatches], camera: StereoCamera) -> float | None:
    """Root of the mean square, over a 4×3 grid of the image, of the vertical offset there, px.

    Cells where no offset has a majority of the matches of all pairs do not count; None without
    any.
    """
    pixels = np.concatenate([np.zeros((0, 2)), *(sample.pixels for sample in samples)])
    offset = np.concatenate([np.zeros(0), *(sample.shift[:, 1] for sample in samples)])
    cells = (pixels[:, 0] * 4 // camera.width) * 3 + pixels[:, 1] * 3 // camera.height
    means = []
    for cell in np.unique(cells):
        here = offset[cells == cell]
        near = here[np.abs(here - np.median(here)) < _AGREE_PX]
        if len(near) >= max(_LEAST_MATCHES, 0.6 * len(here)):
            means.append(float(near.mean()))
    return float(np.sqrt(np.mean(np.square(means)))) if len(means) >= _LEAST_CELLS else None


_SOURCE = "Source: lab/reports/doctor.md"


@dataclass(frozen=True, slots=True)
class DoctorConfig:
    """Settings of `Examination`; beyond a limit a check makes a finding.

    Attributes:
        frames: frames that are examined at the start of a drive; 0 turns the doctor off.
        every: left and right are matched in every n-th of them.
        least_frames: fewest frames for a verdict.
        negative_share: largest share of left-right matches that lie to the right in the right
            image. Healthy drives stay below 0.2, swapped sides above 0.8.
        upright: least logarithm of how much further up than down the scene reaches.
        forward_m: distance between the instants of left and right image, metres.
        row_jump_px: scatter of the vertical offset from pair to pair, px.
        row_offset_px, slight_row_offset_px: vertical offset of left and right image, px, RMS over
            the image: fatal, and a warning.
        no_odometry: share of frames without odometry.
        frozen_frames: images in a row that repeat the one before.
        equal_share: share of equal pixels of an image that repeats the one before.
        fixed_share: share of the image that may move with the camera.
        doubted: share of the frames at which part of the image may stand still without a reason.
        gap_ratio: longest interval between frames, as a multiple of those around it.
        faulty_share: share of the drive's frames that are left out for a wrong stamp.
        jump_s: interval that is a step of the clock, not a gap, s.
        least_rate_hz: slower cameras give odometry no prediction.
        exposure_step: change of brightness from frame to frame, factors of two.
        exposure_difference: difference of brightness of left and right, factors of two.
        saturated, black: share of an image that is white (250 and more), or black (8 and less).
        spoilt_frames: share of frames that may be like that.
        sharpness: least mean square of the second difference along rows, as a share of the
            variance.
        least_px_per_deg: pixels per degree at the middle of the image.
        least_disparity_px: median disparity of the landmarks, px: below it depth is a guess.
        scale: difference of odometry's scale from that of motion from outside, and of focal length
            or baseline from what fits a map, as a share.
        turn_ratio: turn by gyroscope or wheels over that by odometry; degrees give 57.
        bits: bits of the brightest pixel of 16-bit images.
        other_size: distance of the principal point from the middle, both down and right, or both
            up and left, in half images. Real calibrations stay below 0.1; half images with the
            calibration of whole ones have 1.
    """

    frames: Annotated[int, Meta(ge=0), PUBLIC] = 200
    every: Annotated[int, Meta(ge=1)] = 3
    least_frames: Annotated[int, Meta(ge=2)] = 10
    negative_share: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    upright: float = -0.25
    forward_m: Annotated[float, Meta(gt=0)] = 0.15
    row_jump_px: Annotated[float, Meta(gt=0)] = 0.25
    row_offset_px: Annotated[float, Meta(gt=0), PUBLIC] = 1.3
    slight_row_offset_px: Annotated[float, Meta(gt=0)] = 0.8
    no_odometry: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    frozen_frames: Annotated[int, Meta(ge=1)] = 2
    equal_share: Annotated[float, Meta(gt=0, le=1)] = 0.9
    fixed_share: Annotated[float, Meta(ge=0, lt=1)] = 0.01
    doubted: Annotated[float, Meta(ge=0, lt=1)] = 0.1
    gap_ratio: Annotated[float, Meta(gt=1)] = 2.5
    faulty_share: Annotated[float, Meta(gt=0, le=1), PUBLIC] = 0.05
    jump_s: Annotated[float, Meta(gt=0)] = 60.0
    least_rate_hz: Annotated[float, Meta(gt=0)] = 4.0
    exposure_step: Annotated[float, Meta(gt=0)] = 0.8
    exposure_difference: Annotated[float, Meta(gt=0)] = 0.5
    saturated: Annotated[float, Meta(gt=0, lt=1)] = 0.4
    black: Annotated[float, Meta(gt=0, lt=1)] = 0.6
    spoilt_frames: Annotated[float, Meta(gt=0, lt=1)] = 0.03
    sharpness: Annotated[float, Meta(gt=0)] = 0.002
    least_px_per_deg: Annotated[float, Meta(gt=0)] = 4.0
    least_disparity_px: Annotated[float, Meta(gt=0)] = 2.0
    scale: Annotated[float, Meta(gt=0)] = 0.05
    turn_ratio: Annotated[float, Meta(gt=1)] = 8.0
    bits: Annotated[int, Meta(ge=1, le=16)] = 14
    other_size: Annotated[float, Meta(gt=0)] = 0.25

    def __post_init__(self) -> None:
        check_bounds(self)


# Pixels are looked at in steps of this, both ways.
_STEP = 8
_WHITE, _BLACK = 250, 8


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts about a drive in addition to its frames.

    Attributes:
        zone: time zone, if known.
        longitude_deg: where the drive was, if known.
        by_hour: whether missions by hour need its clock.
        step: every so many-th frame of the drive was chosen.
        bits: bits of the brightest pixel of 16-bit images; None for 8-bit ones.
    """

    clock: Clock = Clock.UNKNOWN
    zone: str | None = None
    longitude_deg: float | None = None
    by_hour: bool = False
    step: int = 1
    bits: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What one pair looks like; left and right, each from every 64th pixel.

    Attributes:
        saturated, black: largest share of white and of black pixels.
        repeats: whether the image is that of the pair before, but for a text in it.
        contrast: standard deviations, grey levels.
        rows: (2, R) float32, grey levels: mean of every eighth row, all its pixels.
    """

    brightness: tuple[float, float]
    saturated: float
    black: float
    repeats: tuple[bool, bool]
    contrast: tuple[float, float]
    rows: NDArray[np.float32]


@dataclass(slots=True)
class Evidence:
    """Evidence about a drive; one entry per frame unless noted.

    Attributes:
        camera: of the drive; None before the first frame.
        facts: facts in addition to the frames.
        first: whether a stretch begins with the frame, so that nothing is known of the time before.
        statuses: of the frames.
        odometry: whether odometry measured the motion, or had none to measure.
        moved: `prev_from_curr`, None where it was not measured.
        sigma_m: standard deviation of that, m; 0 where it was not measured.
        looks: of the images; empty for a frame log.
        matches: left-right matches of every few pairs, and the number of their frame.
        read: what happened to the stamps in the reader of the drive.
        taken: what happened to them in a robot, which has its frames one by one.
        bad: why other pairs were left out: an image is missing, unreadable or of another size.
        outside: each step as measured by wheels or another source; None where it was not.
        turned_rad: how far each step turned by gyroscope or wheels; None where it was not measured.
        rematched: how frames fit a map by other calibrations; of none without a map.
        alignments: of some pairs, worked out once at the end; None before.
        fixed_share: share of the image that moves with the camera.
        doubted: frames that leave open whether the camera or part of its image stood still.
    """

    config: DoctorConfig
    camera: StereoCamera | None = None
    facts: Facts = field(default_factory=Facts)
    stamps_ns: list[int] = field(default_factory=list)
    first: list[bool] = field(default_factory=list)
    statuses: list[FrameStatus] = field(default_factory=list)
    odometry: list[bool] = field(default_factory=list)
    moved: list[SE3 | None] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    looks: list[Look] = field(default_factory=list)
    disparity_px: list[float] = field(default_factory=list)
    sharpness: list[float] = field(default_factory=list)
    matches: list[tuple[int, SideMatches]] = field(default_factory=list)
    read: StampReport = field(default_factory=StampReport)
    taken: StampReport = field(default_factory=StampReport)
    bad: list[str] = field(default_factory=list)
    outside: list[SE3 | None] = field(default_factory=list)
    turned_rad: list[float | None] = field(default_factory=list)
    rematched: Rematched = field(default_factory=Rematched)
    alignments: list[Alignment] | None = None
    fixed_share: float = 0.0
    doubted: int = 0

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def intervals_s(self) -> Array:
        """(n,) float64, s: between successive frames of a stretch."""
        stamps, first = np.array(self.stamps_ns, np.int64), np.array(self.first, np.bool_)
        return (np.diff(stamps) / 1e9)[~first[1:]] if len(stamps) else np.zeros(0)

    @property
    def moved_m(self) -> Array:
        """(n,) float64, m: distance of each step; nan where it was not measured."""
        return np.array([np.nan if one is None else one.distance_m for one in self.moved])


class Examination:
    """Looks at the first frames of a drive, or of several stretches of it.

    Args:
        config: how many frames, and the limits.
    """

    def __init__(self, config: DoctorConfig | None = None) -> None:
        self.evidence = Evidence(config or DoctorConfig())
        self._last: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None
        self._begins = True
        # Frames since the last that was matched again with a map.
        self._unmatched = APART
        self._asked = 0

    @property
    def full(self) -> bool:
        """Whether enough frames were seen; further ones are not looked at."""
        return len(self.evidence) >= self.evidence.config.frames

    def begin(self) -> None:
        """Begins another stretch: the time before its first frame is unknown."""
        self._begins, self._last = True, None

    def see(
        self,
        arrived: StereoPair | LoggedFrame,
        frame: Frame,
        motion: Motion,
        outside: SE3 | None = None,
        turned_rad: float | None = None,
    ) -> None:
        """Looks at one frame.

        Args:
            arrived: its images, or the logged frame.
            outside: the same as measured by wheels or another source; None if it was not.
            turned_rad: how far it turned by gyroscope or wheels; None if that was not measured.
        """
        if self.full:
            return
        seen, number = self.evidence, len(self.evidence)
        seen.camera = frame.camera
        seen.stamps_ns.append(frame.stamp_ns)
        seen.first.append(self._begins)
        seen.statuses.append(frame.status)
        step = motion.odometry
        seen.odometry.append(step.status in {OdometryStatus.OK, OdometryStatus.FIRST})
        seen.moved.append(step.prev_from_curr)
        way = np.zeros((3, 3)) if step.covariance is None else step.covariance[:3, :3]
        seen.sigma_m.append(float(np.sqrt(np.trace(way))))
        seen.outside.append(outside)
        seen.turned_rad.append(turned_rad)
        disparity_px = frame.landmarks.disparity_px
        seen.disparity_px.append(float(np.median(disparity_px)) if len(disparity_px) else 0.0)
        self._begins = False
        if isinstance(arrived, StereoPair):
            self._look(arrived, number)

    def wants_match(self) -> bool:
        """Whether the next frame should be matched again with a map; call it once a frame."""
        self._asked, self._unmatched = self._asked + 1, self._unmatched + 1
        few = self.evidence.rematched.frames < MOST
        return few and self._unmatched >= APART and self._asked <= self.evidence.config.frames

    def match(self, reference: Frame, live: Frame, matcher: MatcherConfig) -> None:
        """Takes a live frame and the frame of the map that it matched best."""
        self.evidence.rematched.add(reference, live, matcher)
        self._unmatched = 0

    def _repeats(
        self,
        now: tuple[NDArray[np.uint8], NDArray[np.uint8]],
        last: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    ) -> tuple[bool, bool]:
        least = self.evidence.config.equal_share
        return equal_share(now[0], last[0]) >= least, equal_share(now[1], last[1]) >= least

    def _look(self, pair: StereoPair, number: int) -> None:
        small = pair.left[::_STEP, ::_STEP].copy(), pair.right[::_STEP, ::_STEP].copy()
        last, self._last = self._last, small
        self.evidence.looks.append(
            Look(
                (float(small[0].mean()), float(small[1].mean())),
                max(np.count_nonzero(one >= _WHITE) / one.size for one in small),
                max(np.count_nonzero(one <= _BLACK) / one.size for one in small),
                (False, False) if last is None else self._repeats(small, last),
                (float(small[0].std()), float(small[1].std())),
                np.array([one[::_STEP].mean(1, np.float32) for one in (pair.left, pair.right)]),
            )
        )
        if number % self.evidence.config.every == 0:
            self.evidence.sharpness.append(min(_sharpness(pair.left), _sharpness(pair.right)))
            self.evidence.matches.append((number, match_sides(pair)))
            self.evidence.alignments = None


def _sharpness(image: NDArray[np.uint8]) -> float:
    """Mean square of the second difference along every eighth row, over the variance."""
    rows = image[::_STEP].astype(np.float32)
    second = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    return float((second**2).mean() / max(float(rows.var()), 1e-6))
