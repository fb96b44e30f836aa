"""The robots of the fleet: their cameras and how these ride."""

from __future__ import annotations

import math
from dataclasses import dataclass

from engram.errors import ConfigError
from engram.geometry import StereoCamera


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot's eyes.

    Attributes:
        name: key in `ROBOTS`.
        camera: rectified stereo pair.
        height_m: of the left camera above the road.
        pitch_rad: downwards.
        read_noise, shot_noise: of the sensor, see `engram_lab._town.develop`.
        vignette: loss of light in the corners.
        shake: factor on the unsteadiness of its ride.
        on_handlebars: rolls into bends and yaws with the steering, as on a bicycle.
    """

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


# The town's default camera (512×384, 65° across, 0.24 m), two variants of it on other robots, and
# KITTI's, for the calibration against its clip.
ROBOTS: dict[str, Robot] = {
    robot.name: robot
    for robot in (
        Robot("wildcat", _pinhole(512, 384, 65, 0.24)),
        Robot(
            "courier", _pinhole(512, 384, 74, 0.16), height_m=1.15, pitch_rad=-0.03, vignette=0.2
        ),
        Robot("bicycle", _pinhole(512, 384, 65, 0.24), height_m=1.3, shake=2.2, on_handlebars=True),
        Robot(
            "kitti",
            StereoCamera(707.0912, 707.0912, 601.8873, 183.1104, 0.537, 1226, 370),
            height_m=1.65,
        ),
    )
}


def robot_named(name: str) -> Robot:
    """A robot of the fleet.

    Raises:
        ConfigError: no such robot.
    """
    if name not in ROBOTS:
        raise ConfigError(f"unknown robot '{name}'; known are: {', '.join(ROBOTS)}")
    return ROBOTS[name]
