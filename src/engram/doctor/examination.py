"""Collects evidence about a drive from frames as they are computed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from engram.doctor.rematching import APART, MOST, Rematched
from engram.doctor.settings import DoctorConfig
from engram.doctor.sides import Alignment
from engram.frontend import Frame, FrameStatus, StereoPair
from engram.frontend.matching import MatcherConfig
from engram.frontend.sides import SideMatches, match_sides
from engram.geometry import SE3, StereoCamera
from engram.graph.model import Clock
from engram.odometry import Motion, OdometryStatus
from engram.odometry.frozen import equal_share
from engram.sequences import LoggedFrame
from engram.sequences.clocks import StampReport

Array = NDArray[np.float64]

# Pixels are looked at in steps of this, both ways.
_STEP = 8
_WHITE, _BLACK = 250, 8


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts about a drive in addition to its frames.

    Attributes:
        clock: meaning of the stamps.
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
        brightness: mean grey levels.
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
        config: the limits.
        camera: of the drive; None before the first frame.
        facts: facts in addition to the frames.
        stamps_ns: stamps in the order of arrival.
        first: whether a stretch begins with the frame, so that nothing is known of the time before.
        statuses: of the frames.
        odometry: whether odometry measured the motion, or had none to measure.
        moved: `prev_from_curr`, None where it was not measured.
        sigma_m: standard deviation of that, m; 0 where it was not measured.
        looks: of the images; empty for a frame log.
        disparity_px: median of the landmarks.
        sharpness: of every few pairs.
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
            frame: what the front-end made of it.
            motion: the motion that led to it.
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
        """Matches a live frame again with a frame of the map that it matched best."""
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
                max(float((one >= _WHITE).mean()) for one in small),
                max(float((one <= _BLACK).mean()) for one in small),
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
