"""The driving line: where the robot is at each frame; and the robots' cameras and how they ride."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab.town.streets import Junction, Route, StreetPlan


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot's eyes."""

    name: str
    camera: StereoCamera
    height_m: float = 1.55
    pitch_rad: float = 0.0
    read_noise: float = 0.0022
    shot_noise: float = 5e-5
    vignette: float = 0.12
    shake: float = 1.0
    on_handlebars: bool = False


def _pinhole(
    width: int, height: int, across_deg: float, baseline_m: float, down: float = 0.0
) -> StereoCamera:
    focal = width / 2 / math.tan(math.radians(across_deg) / 2)
    middle = ((width - 1) / 2, (height - 1) / 2 + down)
    return StereoCamera(focal, focal, *middle, baseline_m, width, height)


# The town's default camera (512×384, 65° across, 0.24 m), variants of it on other robots, and
# KITTI's, for the calibration against its clip.
ROBOTS: dict[str, Robot] = {
    robot.name: robot
    for robot in (
        Robot("wildcat", _pinhole(512, 384, 65, 0.24)),
        Robot(
            "courier", _pinhole(512, 384, 74, 0.16), height_m=1.15, pitch_rad=-0.03, vignette=0.2
        ),
        Robot("scout", _pinhole(512, 384, 70, 0.2), height_m=1.3),
        Robot("bicycle", _pinhole(512, 384, 65, 0.24), height_m=1.3, shake=2.2, on_handlebars=True),
        Robot(
            "kitti",
            StereoCamera(707.0912, 707.0912, 601.8873, 183.1104, 0.537, 1226, 370),
            height_m=1.65,
        ),
    )
}


@dataclass(frozen=True, slots=True)
class Residual:
    """What calibration leaves of a stereo rig's errors.

    Attributes:
        disparity_px: added to every disparity.
        rows_px: how far the right picture stands too high.
        roll_rad: of the right camera against the left one.
        focal: true focal length ÷ the calibrated one.
    """

    disparity_px: float = 0.0
    rows_px: float = 0.0
    roll_rad: float = 0.0
    focal: float = 1.0

    @staticmethod
    def of_rig(name: str, seed: int) -> Residual:
        """That of one robot of a fleet, as good calibrations leave them."""
        rng = np.random.default_rng([seed & 0x7FFFFFFF, 0xCA11, *name.encode()])
        disparity, rows, roll, focal = rng.normal(0, [0.2, 0.1, 3e-4, 1e-3])
        return Residual(float(disparity), float(rows), float(roll), 1 + float(focal))

    def turn(self, camera: StereoCamera) -> tuple[float, float, float]:
        """Of the right camera against the left one about its axes, radians."""
        return self.rows_px / camera.fy, self.disparity_px / camera.fx, self.roll_rad

    def text(self) -> str:
        """For the head of a truth."""
        return (
            f"disparity {self.disparity_px:+.3f} px, rows {self.rows_px:+.3f} px, "
            f"roll {self.roll_rad:+.6f} rad, focal length x {self.focal:.5f}"
        )


EXACT = Residual()


def robot_named(name: str) -> Robot:
    """A robot of the fleet."""
    if name not in ROBOTS:
        raise ConfigError(f"unknown robot '{name}'; known are: {', '.join(ROBOTS)}")
    return ROBOTS[name]


Array = NDArray[np.float64]

_STEP_M = 0.25  # between points of the line
_ROUND_M = 5.5  # standard deviation of the smoothing that rounds corners: a radius of 4.9 m


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A closed curve that is driven along, by arc length.

    Attributes:
        points: (N, 2) metres, about `_STEP_M` apart.
    """

    points: Array
    length_m: float

    def at(self, driven_m: float) -> tuple[Array, float, float]:
        """Position (2,), heading (radians, anticlockwise from east) and curvature (1/m)."""
        count = len(self.points)
        place = (driven_m / self.length_m) % 1.0 * count
        k, share = int(place) % count, place - int(place)
        a, b, c, d = (self.points[(k + m) % count] for m in (-1, 0, 1, 2))
        # Catmull-Rom: a smooth heading between points.
        position = 0.5 * (
            2 * b
            + (c - a) * share
            + (2 * a - 5 * b + 4 * c - d) * share**2
            + (3 * b - a - 3 * c + d) * share**3
        )
        tangent = 0.5 * (
            (c - a)
            + 2 * (2 * a - 5 * b + 4 * c - d) * share
            + 3 * (3 * b - a - 3 * c + d) * share**2
        )
        ahead = self.points[(k + 9) % count] - self.points[(k + 5) % count]
        behind = self.points[(k - 4) % count] - self.points[(k - 8) % count]
        turn = np.arctan2(behind[0] * ahead[1] - behind[1] * ahead[0], behind @ ahead)
        return position, float(np.arctan2(tangent[1], tangent[0])), float(turn / (13 * _STEP_M))


def driving_line(plan: StreetPlan, route: Route, reverse: bool) -> Line:
    """The middle of the left lane along a route, corners rounded."""
    junctions: tuple[Junction, ...] = route.junctions[::-1] if reverse else route.junctions
    pieces = []
    for k, start in enumerate(junctions):
        end = junctions[(k + 1) % len(junctions)]
        centre = plan.centreline(start, end)[:-1]
        aside_m = min(1.7, 0.42 * plan.half_width_m(start, end))
        # Across a junction one drives closer to the middle, or left turns would be too tight.
        aside = np.array([0.35 * aside_m, *([aside_m] * (len(centre) - 1))])
        pieces.append(np.column_stack([centre, aside]))
    middle = closed_line(np.concatenate(pieces), _ROUND_M).points
    along = np.roll(middle[:, :2], -1, axis=0) - np.roll(middle[:, :2], 1, axis=0)
    left = np.column_stack([-along[:, 1], along[:, 0]])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    even = _resampled(middle[:, :2] + middle[:, 2:] * left, _STEP_M)
    return Line(even, _length_m(even))


def closed_line(corners: Array, round_m: float) -> Line:
    """The curve through corners (N, 2) and back to the first, smoothed over so many metres.

    Further columns are carried along.
    """
    smooth = _rounded(_resampled(corners, _STEP_M), round_m / _STEP_M)
    even = _resampled(smooth, _STEP_M)
    return Line(even, _length_m(even))


def _length_m(closed: Array) -> float:
    return float(np.linalg.norm((np.roll(closed, -1, 0) - closed)[:, :2], axis=1).sum())


def _resampled(closed: Array, step_m: float) -> Array:
    looped = np.vstack([closed, closed[:1]])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(looped[:, :2], axis=0), axis=1))])
    count = round(float(along[-1] / step_m))
    wanted = np.arange(count) * along[-1] / count
    return np.stack(
        [np.interp(wanted, along, looped[:, k]) for k in range(closed.shape[1])], axis=1
    )


def _rounded(closed: Array, sigma: float) -> Array:
    reach = int(4 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights /= weights.sum()
    wrapped = np.vstack([closed[-reach:], closed, closed[:reach]])
    return np.stack(
        [np.convolve(wrapped[:, k], weights, "valid") for k in range(closed.shape[1])], axis=1
    )


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Where the left camera is at one frame.

    Attributes:
        twist: (6,) motion in camera axes a second: translation m/s, rotation rad/s.
    """

    world_from_cam: SE3
    driven_m: float
    elapsed_s: float
    speed_m_s: float
    twist: Array


@dataclass(frozen=True, slots=True)
class DrivingStyle:
    """How one session strays from the line."""

    seed: int
    offset_m: float = 0.3
    sway_m: float = 0.2
    speed_m_s: float = 5.5


def drive(
    line: Line, robot: Robot, style: DrivingStyle, spacing_m: float, count: int
) -> list[Pose]:
    """Poses of `count` frames, `spacing_m` apart along the line."""
    waves = _Waves(style, robot.shake)
    poses, elapsed = [], 0.0
    for k in range(count):
        driven = k * spacing_m
        speed = waves.speed_m_s(driven, line)
        here = _pose(line, robot, waves, driven)
        soon = _pose(line, robot, waves, driven + 0.05)
        step = here.inverse() @ soon
        poses.append(Pose(here, driven, elapsed, speed, step.log() * speed / 0.05))
        elapsed += spacing_m / speed
    return poses


class _Waves:
    """Sums of sines with random phases: the unsteadiness of a ride as functions of distance."""

    def __init__(self, style: DrivingStyle, shake: float) -> None:
        rng = np.random.default_rng([style.seed & 0x7FFFFFFF, 0xD817E])
        self._style = style
        self._shake = shake
        self._offset_m = style.offset_m * float(np.clip(rng.standard_normal(), -2, 2))
        self._phases = rng.uniform(0, 2 * np.pi, (6, 3))

    def _wave(self, which: int, driven_m: float, lengths_m: tuple[float, float, float]) -> float:
        angle = 2 * np.pi * driven_m / np.array(lengths_m) + self._phases[which]
        return float(np.sin(angle).sum() / np.sqrt(1.5))

    def lateral_m(self, driven_m: float) -> float:
        return self._offset_m + self._style.sway_m * self._wave(0, driven_m, (31, 53, 97))

    def yaw_rad(self, driven_m: float) -> float:
        return self._shake * 0.007 * self._wave(1, driven_m, (7.1, 13.0, 23.0))

    def pitch_rad(self, driven_m: float) -> float:
        return self._shake * 0.005 * self._wave(2, driven_m, (2.9, 5.3, 11.0))

    def roll_rad(self, driven_m: float) -> float:
        return self._shake * 0.004 * self._wave(3, driven_m, (3.7, 7.9, 17.0))

    def heave_m(self, driven_m: float) -> float:
        return self._shake * 0.008 * self._wave(4, driven_m, (2.3, 4.1, 9.0))

    def speed_m_s(self, driven_m: float, line: Line) -> float:
        _, _, curvature = line.at(driven_m)
        slow = 1 / (1 + 6 * abs(curvature))
        return float(
            self._style.speed_m_s * slow * (1 + 0.12 * self._wave(5, driven_m, (60, 110, 170)))
        )


def pose_on(line: Line, robot: Robot, driven_m: float, aside_m: float = 0.0) -> SE3:
    """The pose of a steady ride: on the line, or so far to the left of it."""
    position, heading, _ = line.at(driven_m)
    left = np.array([-np.sin(heading), np.cos(heading)])
    return _looking(position + aside_m * left, robot.height_m, heading, -robot.pitch_rad, 0.0)


def _pose(line: Line, robot: Robot, waves: _Waves, driven_m: float) -> SE3:
    position, heading, curvature = line.at(driven_m)
    left = np.array([-np.sin(heading), np.cos(heading)])
    position = position + waves.lateral_m(driven_m) * left
    yaw = heading - waves.yaw_rad(driven_m)
    pitch = -robot.pitch_rad + waves.pitch_rad(driven_m)
    roll = waves.roll_rad(driven_m)
    if robot.on_handlebars:  # leans into the bend and looks where it steers
        roll += float(np.clip(2.2 * curvature, -0.2, 0.2))
        yaw += float(np.clip(0.9 * curvature, -0.12, 0.12))
    return _looking(position, robot.height_m + waves.heave_m(driven_m), yaw, pitch, roll)


def _looking(position: Array, height_m: float, yaw: float, pitch: float, roll: float) -> SE3:
    """Yaw anticlockwise from east, pitch upwards, roll clockwise; radians."""
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    level_right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    level_down = np.cross(forward, level_right)
    right = np.cos(roll) * level_right - np.sin(roll) * level_down
    down = np.cross(forward, right)
    centre = np.array([*position, height_m])
    return SE3(np.stack([right, down, forward], axis=1), centre)
