"""What a camera makes of light: exposure, noise, blur, glare, and what sticks to its lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.geometry.cameras import StereoCamera
from engram_lab import _town
from engram_lab.town.conditions import Moment
from engram_lab.town.drive import Pose, Robot
from engram_lab.town.glass import OPEN_GLASS, Glass, Pane, WetLens, film, streaks

Luminance = NDArray[np.float32]
Grey = NDArray[np.uint8]

_TARGET = 0.4  # exposed luminance that the metered highlights are brought to
_MOST_GAIN = 300.0
_SHUTTER_BY_DAY_S = 0.0007
_LONGEST_SHUTTER_S = 0.012
_GLARE = 0.1  # of the sun's power, right beside it
_CLOTH = 0.002  # share of the light that comes through what covers a lens


@dataclass(frozen=True, slots=True)
class Lens:
    """What is wrong with the front lens in a session.

    Attributes:
        dirt: 0…1, specks and smears that stay.
    """

    dirt: float = 0.0
    covered_from_m: float = np.inf
    covered_to_m: float = np.inf
    glass: Glass = OPEN_GLASS


CLEAN = Lens()


@dataclass(frozen=True, slots=True)
class Met:
    """What a drive met at one frame, to slice results by.

    Attributes:
        rain_mm_h: that falls.
        cover: share of the left and right pane that drops cover.
        sun_deg: height of the sun; below 0 at night.
        exposure: gain of the whole camera; 1 is a bright day's.
    """

    rain_mm_h: float
    cover: tuple[float, float]
    sun_deg: float
    exposure: float

    HEADER: ClassVar[str] = "rain_mm_h,cover_left,cover_right,sun_deg,exposure"

    def row(self) -> str:
        """A line of CSV."""
        left, right = self.cover
        values = (self.rain_mm_h, left, right, self.sun_deg, self.exposure)
        return ",".join(f"{value:.4g}" for value in values)


class CameraModel:
    """Turns luminance into grey levels; keeps the exposure from frame to frame."""

    def __init__(self, robot: Robot, seed: int, lens: Lens) -> None:
        self._robot = robot
        self._seed = seed
        self._lens = lens
        self._gain: float | None = None
        self._pace = 0.0  # change of its logarithm from frame to frame
        self._dirt = [self._specks(eye) for eye in range(2)] if lens.dirt > 0 else []
        panes = [
            Pane(lens.glass, robot.camera, [seed & 0x7FFFFFFF, 0x61A5, eye]) for eye in range(2)
        ]
        self._eyes = [WetLens(pane, robot.camera) for pane in panes]

    def met(self, moment: Moment) -> Met:
        """What the last pair met."""
        cover = (self._eyes[0].cover, self._eyes[1].cover)
        return Met(moment.rain_mm_h, cover, moment.sun_deg, self._gain or 1.0)

    def stand_in(self, rate_mm_h: float, speed_m_s: float, seconds: float) -> None:
        """What rain does to the glass of both eyes in so much time at a speed."""
        for eye in self._eyes:
            eye.pane.advance(rate_mm_h, speed_m_s, seconds)

    def expose(
        self, luminance: Luminance, inverse_depths: Luminance, pose: Pose, moment: Moment,
        frame: int,
    ) -> tuple[Grey, Grey]:  # fmt: skip
        """The pair's grey images.

        Args:
            luminance: (2, height, width), linear.
            inverse_depths: (2, height, width), 1/m.
        """
        if self._lens.covered_from_m <= pose.driven_m < self._lens.covered_to_m:
            luminance = _covered(luminance)
        gain = self._meter(luminance)
        shutter_s = float(np.clip(_SHUTTER_BY_DAY_S * gain, 0.0002, _LONGEST_SHUTTER_S))
        pair = []
        robot = self._robot
        for eye in range(2):
            light = self._blur(luminance[eye], inverse_depths[eye], pose.twist * shutter_s)
            light = _veil(light, gain)
            light = _glare(light, moment, pose, robot.camera)
            if self._dirt:
                light = _smudge(light, self._dirt[eye])
            light = self._rained_on(light, moment, pose, shutter_s, eye)
            noise_seed = (self._seed * 1_000_003 + 2 * frame + eye) & 0xFFFFFFFFFFFF
            # A longer shutter brings light, only what it cannot bring is amplified with its noise.
            amplified = gain * _SHUTTER_BY_DAY_S / shutter_s
            pair.append(
                _town.develop(
                    np.ascontiguousarray(light, dtype=np.float32), gain,
                    robot.shot_noise * max(1.0, amplified),
                    robot.read_noise * max(1.0, amplified) ** 0.75, robot.vignette, noise_seed,
                )
            )  # fmt: skip
        return pair[0], pair[1]

    def _meter(self, luminance: Luminance) -> float:
        """The gain, which hunts: it follows the scene with a lag of some frames, and overshoots."""
        rows = luminance.shape[1]
        metered = luminance[0, rows // 6 :: 4, ::4]
        bright = float(np.quantile(metered, 0.85))
        wanted = min(_TARGET / max(bright, 1e-6), _MOST_GAIN)
        if self._gain is None:
            self._gain = wanted
        else:
            self._pace = 0.6 * self._pace + 0.25 * float(np.log(wanted / self._gain))
            self._gain = min(self._gain * float(np.exp(self._pace)), _MOST_GAIN)
        return self._gain

    def _blur(
        self, light: Luminance, inverse_depths: Luminance, twist: NDArray[np.float64]
    ) -> Luminance:
        camera = self._robot.camera
        # The nearest things, about 3 m away, move by this much at most.
        moved_px = camera.fx * (np.abs(twist[:3]).max() / 3 + np.abs(twist[3:]).max())
        if moved_px < 0.5:
            return light
        blurred: Luminance = _town.smear(
            np.ascontiguousarray(light), np.ascontiguousarray(inverse_depths),
            camera.fx, camera.fy, camera.cx, camera.cy, twist.astype(np.float32),
        )  # fmt: skip
        return blurred

    def _specks(self, eye: int) -> Luminance:
        """How much of each pixel (height, width) the dirt on one lens takes, 0…1."""
        camera = self._robot.camera
        rng = np.random.default_rng([self._seed & 0x7FFFFFFF, 0xD127, eye])
        mask = np.zeros((camera.height, camera.width), dtype=np.float32)
        for _ in range(int(40 * self._lens.dirt) + 1):
            centre = (int(rng.uniform(0, camera.width)), int(rng.uniform(0, camera.height)))
            axes = (int(rng.uniform(4, 22)), int(rng.uniform(4, 14)))
            turned_deg, takes = float(rng.uniform(0, 180)), float(rng.uniform(0.3, 0.9))
            cv2.ellipse(mask, centre, axes, turned_deg, 0, 360, takes, -1)
        return np.asarray(cv2.GaussianBlur(mask, (0, 0), 4.0), dtype=np.float32)

    def _rained_on(
        self, light: Luminance, moment: Moment, pose: Pose, shutter_s: float, eye: int
    ) -> Luminance:
        """With the drops in the air and on the glass, which may have stopped falling."""
        seed = [self._seed & 0x7FFFFFFF, 0xF114, eye]
        if moment.rain_mm_h > 0.1:
            air = [*seed, int(1e3 * pose.driven_m)]
            light = streaks(light, self._robot.camera, moment.rain_mm_h, shutter_s, air)
            light = film(light, moment.rain_mm_h, pose.elapsed_s, seed)
        return self._eyes[eye].through(light)


def _covered(luminance: Luminance) -> Luminance:
    """What comes through a cloth over both lenses: next to nothing, and without any edges."""
    height, width = luminance.shape[1:]
    coarse = [cv2.resize(eye, (4, 3), interpolation=cv2.INTER_AREA) for eye in luminance]
    dim = [cv2.resize(eye, (width, height), interpolation=cv2.INTER_LINEAR) for eye in coarse]
    return np.asarray(dim, dtype=np.float32) * np.float32(_CLOTH)


def _veil(light: Luminance, gain: float) -> Luminance:
    """Light that strays in the lens: a halo round what is far brighter than white."""
    if float(light.max()) * gain < 1.6:
        return light
    small = cv2.resize(light, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    excess = np.clip(small - 1.0 / gain, 0, 30.0 / gain)
    halo = 0.10 * cv2.GaussianBlur(excess, (0, 0), 2.5) + 0.06 * cv2.GaussianBlur(
        excess, (0, 0), 14
    )
    grown = cv2.resize(halo, (light.shape[1], light.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(light + grown, dtype=np.float32)


def _glare(light: Luminance, moment: Moment, pose: Pose, camera: StereoCamera) -> Luminance:
    """With the light of a sun that stands in the picture, strayed over all of it."""
    sun = pose.world_from_cam.rotation.T @ moment.sun_direction
    if moment.sun_power <= 0 or sun[2] < 0.2:
        return light
    height, width = light.shape
    column, row = camera.cx + camera.fx * sun[0] / sun[2], camera.cy + camera.fy * sun[1] / sun[2]
    if not (0 <= column <= width - 1 and 0 <= row <= height - 1):
        return light
    if light[round(row), round(column)] < 0.5 * moment.sun_power:  # something hides it
        return light
    rows, columns = np.ogrid[: height // 4, : width // 4]
    away_deg = np.degrees(
        np.hypot((4 * columns - column) / camera.fx, (4 * rows - row) / camera.fy)
    )
    strayed = np.asarray(_GLARE * moment.sun_power / (1 + (away_deg / 8) ** 2), dtype=np.float32)
    return np.asarray(light + cv2.resize(strayed, (width, height)), dtype=np.float32)


def _smudge(light: Luminance, mask: Luminance) -> Luminance:
    blurred = cv2.GaussianBlur(light, (0, 0), 5.0)
    mean = float(light[::8, ::8].mean())
    smeared = 0.55 * blurred + 0.12 * mean  # dirt swallows a third and scatters
    return np.asarray(light * (1 - mask) + mask * smeared, dtype=np.float32)
