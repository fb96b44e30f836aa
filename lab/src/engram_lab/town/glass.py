"""Rain on the glass before a lens: drops that land, merge, run off and dry, and how they look.

Nothing here changes at random between frames. A pane's drops are a list that lives as long as the
drive; what a picture shows of them follows from the optics: they lie millimetres before a lens that
is focused metres away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.geometry.cameras import StereoCamera

Luminance = NDArray[np.float32]

_LEAST_MM, _MOST_MM = 0.2, 6.0  # diameters of drops in the air
_RUNS_OFF_MM = 4.5  # width on the glass from which a drop is heavier than its hold
_MARGIN_MM = 4.0  # of glass beyond what the picture shows
_DRIES_MM2_S = 0.0015  # diameter × loss of diameter, in the wind of a slow drive
_BREEZE_M_S = 0.5  # blows drops on the glass of a robot that stands
_WIPED = 0.97  # share of the drops that a blade takes
_WIDEST = 1.2  # tangent of the angle to which the edge of a drop refracts, 50°
_FILM_FROM_MM_H, _FILM_WHOLE_MM_H = 10.0, 25.0
_FILM_PX = 4.0  # furthest that a whole film moves a point
_NEAREST_STREAK_M, _FARTHEST_STREAK_M = 0.4, 3.0


@dataclass(frozen=True, slots=True)
class Glass:
    """What rain meets before a lens.

    Attributes:
        distance_mm: from the pupil to the glass.
        pupil_mm: diameter of the entrance pupil: focal length ÷ f-number.
        contact_deg: angle at which water meets the glass.
        hood: opening of a hood ÷ its length; infinite without one.
        wiped_every_s: seconds between two strokes of a blade; infinite without one.
    """

    distance_mm: float = 15.0
    pupil_mm: float = 1.9
    contact_deg: float = 60.0
    hood: float = math.inf
    wiped_every_s: float = math.inf

    @property
    def spread(self) -> float:
        """Width of a drop on the glass ÷ its diameter in the air: a cap of equal volume."""
        cosine, sine = (
            math.cos(math.radians(self.contact_deg)),
            math.sin(math.radians(self.contact_deg)),
        )
        return float((4 * sine**3 / ((1 - cosine) ** 2 * (2 + cosine))) ** (1 / 3))


OPEN_GLASS = Glass()


def fall_m_s(diameter_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Speed at which drops fall (Atlas et al. 1973)."""
    return np.asarray(np.maximum(9.65 - 10.3 * np.exp(-0.6 * diameter_mm), 0.1))


def steepness_per_mm(rate_mm_h: float) -> float:
    """Λ of N(D) = 8000 exp(−Λ D) per m³ and mm (Marshall and Palmer 1948)."""
    return float(4.1 * rate_mm_h**-0.21)


class Pane:
    """The drops on one piece of glass.

    Args:
        glass: its kind.
        camera: whose picture it covers.
        seed: of where and when drops land.
    """

    def __init__(self, glass: Glass, camera: StereoCamera, seed: list[int]) -> None:
        self.glass = glass
        self._rng = np.random.default_rng(seed)
        reach = np.array([[0, 0], [camera.width, camera.height]]) - [camera.cx, camera.cy]
        corners = glass.distance_mm * reach / [camera.fx, camera.fy]
        self._low, self._high = corners[0] - _MARGIN_MM, corners[1] + _MARGIN_MM
        self._since_wiped_s = 0.0
        self.drops = np.zeros((0, 3))  # x right, y down in mm from the axis; diameter in the air
        self.changes = 0

    @property
    def widths_mm(self) -> NDArray[np.float64]:
        """(N,) of the drops on the glass."""
        return np.asarray(self.glass.spread * self.drops[:, 2])

    def advance(self, rate_mm_h: float, speed_m_s: float, seconds: float) -> None:
        """What so much rain does in so much time, driven against at a speed."""
        if rate_mm_h > 0:
            for x, y, diameter in self._arrivals(rate_mm_h, speed_m_s, seconds):
                self._land(x, y, diameter)
        elif len(self.drops):
            self._dry(seconds)
        self._since_wiped_s += seconds
        if self._since_wiped_s >= self.glass.wiped_every_s:
            self._since_wiped_s = 0.0
            self._keep(self._rng.random(len(self.drops)) > _WIPED)

    def _arrivals(self, rate_mm_h: float, speed_m_s: float, seconds: float) -> NDArray[np.float64]:
        steep, speed_m_s = steepness_per_mm(rate_mm_h), max(speed_m_s, _BREEZE_M_S)
        most, least = math.exp(-steep * _LEAST_MM), math.exp(-steep * _MOST_MM)
        area_m2 = float(np.prod(self._high - self._low)) * 1e-6
        count = self._rng.poisson(8000 / steep * (most - least) * speed_m_s * area_m2 * seconds)
        places = self._low + (self._high - self._low) * self._rng.random((count, 2))
        diameters = -np.log(most - self._rng.random(count) * (most - least)) / steep
        found = np.column_stack([places, diameters])
        # Drops that fall steeper than a hood is open end on the hood.
        return found[fall_m_s(diameters) / speed_m_s < self.glass.hood]

    def _land(self, x: float, y: float, diameter: float) -> None:
        """A drop takes up all that it touches; too heavy a one runs down and takes its track."""
        drop = np.array([x, y, diameter])
        while True:
            away = np.hypot(self.drops[:, 0] - drop[0], self.drops[:, 1] - drop[1])
            touched = away < 0.5 * self.glass.spread * (self.drops[:, 2] + drop[2])
            if not touched.any():
                break
            both = np.vstack([self.drops[touched], drop])
            volumes = both[:, 2] ** 3
            drop = np.append(volumes @ both[:, :2] / volumes.sum(), np.cbrt(volumes.sum()))
            self._keep(~touched)
        if self.glass.spread * drop[2] > _RUNS_OFF_MM:
            half = 0.5 * self.glass.spread * (self.drops[:, 2] + drop[2])
            aside, below = np.abs(self.drops[:, 0] - drop[0]), self.drops[:, 1] > drop[1]
            self._keep(~((aside < half) & below))
        else:
            self.drops = np.vstack([self.drops, drop])
        self.changes += 1

    def _dry(self, seconds: float) -> None:
        squares = self.drops[:, 2] ** 2 - 2 * _DRIES_MM2_S * seconds
        self.drops[:, 2] = np.sqrt(np.maximum(squares, 0))
        self._keep(self.drops[:, 2] > 0.1)
        self.changes += 1

    def _keep(self, those: NDArray[np.bool_]) -> None:
        if not those.all():
            self.drops = self.drops[those]
            self.changes += 1


class WetLens:
    """One eye's view through its pane.

    A drop of width w at distance z before a pupil p takes of each pixel's light the share of the
    pupil's disc that it covers: the mask of all drops, f/z pixels a millimetre, averaged over discs
    of p·f/z pixels. Behind a drop stands what it refracts: the wide view, upside down.

    Args:
        pane: the drops.
        camera: whose picture.
    """

    def __init__(self, pane: Pane, camera: StereoCamera) -> None:
        self.pane, self._camera = pane, camera
        self._px_mm = camera.fx / pane.glass.distance_mm
        disc_px = pane.glass.pupil_mm * self._px_mm
        # A wide disc needs no fine mask.
        self._coarse = 4 if disc_px >= 32 else 2 if disc_px >= 12 else 1
        across = max(1, round(disc_px / self._coarse / 2)) * 2 + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (across, across)).astype(np.float32)
        self._disc, self._pad = disc / disc.sum(), across // 2 + 1
        self._drawn = -1
        self._takes = self._shows = self._column = self._row = np.zeros((0, 0), dtype=np.float32)
        self.cover = 0.0

    def through(self, light: Luminance) -> Luminance:
        """The picture (height, width) as it comes through the pane."""
        self._draw()
        if self.cover == 0:
            return light
        small = cv2.resize(light, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
        wide = cv2.remap(
            cv2.GaussianBlur(small, (0, 0), 1.0), self._column, self._row, cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        refracted = self._spread(self._shows * wide)
        return np.asarray(light * (1 - self._takes) + refracted, dtype=np.float32)

    def mask(self) -> NDArray[np.bool_]:
        """Which pixels' axes (height / n, width / n) meet a drop; n is 1, 2 or 4."""
        labels = self._labels()
        return np.asarray(labels[self._pad : -self._pad, self._pad : -self._pad] > 0)

    def _spread(self, mask: Luminance) -> Luminance:
        """Averaged over the pupil and brought to the picture's size."""
        averaged = cv2.filter2D(mask, -1, self._disc, borderType=cv2.BORDER_CONSTANT)
        inner = averaged[self._pad : -self._pad, self._pad : -self._pad]
        size = (self._camera.width, self._camera.height)
        if self._coarse > 1:
            inner = cv2.resize(inner, size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(inner, dtype=np.float32)

    def _labels(self) -> NDArray[np.float32]:
        """Number of the drop, from 1, that covers each coarse pixel; 0 where none does."""
        camera, n = self._camera, self._coarse
        shape = (-(-camera.height // n) + 2 * self._pad, -(-camera.width // n) + 2 * self._pad)
        labels = np.zeros(shape, dtype=np.float32)
        centres, radii = self._on_mask()
        beyond = (centres < -radii[:, None]) | (centres > radii[:, None] + shape[::-1])
        shown = np.flatnonzero(~beyond.any(axis=1))  # about half: the pane is wider than the view
        drops = np.column_stack([centres, radii])[shown].tolist()
        for k, (x, y, radius) in zip(shown.tolist(), drops, strict=True):
            left, top = max(math.ceil(x - radius), 0), max(math.ceil(y - radius), 0)
            part = labels[top : math.floor(y + radius) + 1, left : math.floor(x + radius) + 1]
            across, down = np.arange(part.shape[1]) + left - x, np.arange(part.shape[0]) + top - y
            part[np.add.outer(down**2, across**2) <= radius**2] = k + 1
        return labels

    def _on_mask(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centres (N, 2) and radii (N,) of the drops in coarse pixels, the border counted."""
        drops, scale = self.pane.drops, self._px_mm / self._coarse
        axis = (np.array([self._camera.cx, self._camera.cy]) + 0.5) / self._coarse - 0.5
        return drops[:, :2] * scale + axis + self._pad, 0.5 * self.pane.widths_mm * scale

    def _draw(self) -> None:
        """What drops take and where they look, if any has changed."""
        if self._drawn == self.pane.changes:
            return
        self._drawn = self.pane.changes
        labels = self._labels()
        self.cover = float((labels[self._pad : -self._pad, self._pad : -self._pad] > 0).mean())
        if self.cover == 0:
            return
        centres, radii = self._on_mask()
        which = np.maximum(labels.astype(np.int32) - 1, 0)
        rows, columns = np.indices(labels.shape, dtype=np.float32)
        right = ((columns - centres[which, 0]) / radii[which]).astype(np.float32)
        down = ((rows - centres[which, 1]) / radii[which]).astype(np.float32)
        outwards = np.sqrt(right**2 + down**2)
        # Total reflection darkens the rim; it only shows where the disc is small.
        rim = 1 - 0.7 * np.clip((outwards - 0.75) / 0.25, 0, 1)
        covered = (labels > 0).astype(np.float32)
        self._takes, self._shows = self._spread(covered), covered * rim
        # Upside down: the upper part of a drop looks at the road. In pixels of an eighth.
        camera, n = self._camera, self._coarse
        column, row = (columns - self._pad + 0.5) * n - 0.5, (rows - self._pad + 0.5) * n - 0.5
        self._column = ((column - _WIDEST * camera.fx * right + 0.5) / 8 - 0.5).astype(np.float32)
        self._row = ((row - _WIDEST * camera.fy * down + 0.5) / 8 - 0.5).astype(np.float32)


def film(light: Luminance, rate_mm_h: float, elapsed_s: float, seed: list[int]) -> Luminance:
    """The picture behind a film of water, which moves its points by some pixels, slowly."""
    whole = (rate_mm_h - _FILM_FROM_MM_H) / (_FILM_WHOLE_MM_H - _FILM_FROM_MM_H)
    if whole <= 0:
        return light
    height, width = light.shape
    rng = np.random.default_rng(seed)
    far_px = _FILM_PX * min(whole, 1.0)
    # Waves of 40 to 120 px that run down the glass.
    row, column = np.arange(height)[:, None], np.arange(width)[None, :]
    shifts = []
    for _ in range(2):
        length_px, turn, phase = rng.uniform([40, -0.6, 0], [120, 0.6, 2 * np.pi])
        down = row - 12 * elapsed_s
        angle = 2 * np.pi * (math.cos(turn) * down + math.sin(turn) * column) / length_px + phase
        across = 2 * np.pi * column / rng.uniform(60, 140) + rng.uniform(0, 2 * np.pi)
        shifts.append(far_px * 0.7 * (np.sin(angle) + 0.4 * np.sin(across)))
    to_column = (column + shifts[0]).astype(np.float32)
    to_row = (row + shifts[1]).astype(np.float32)
    moved = cv2.remap(light, to_column, to_row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, dtype=np.float32)


def streaks(
    light: Luminance, camera: StereoCamera, rate_mm_h: float, shutter_s: float, seed: list[int]
) -> Luminance:
    """The picture with the drops that fall between the lens and what it sees.

    A drop is as long as it falls while the shutter is open, and takes each point of its path for
    the time in which it passes (Garg and Nayar 2007). Those below 1 mm are too faint.
    """
    rng, steep = np.random.default_rng(seed), steepness_per_mm(rate_mm_h)
    near, far = _NEAREST_STREAK_M, _FARTHEST_STREAK_M
    opening = camera.width * camera.height / (camera.fx * camera.fy)
    volume_m3 = opening * (far**3 - near**3) / 3
    count = min(int(rng.poisson(8000 / steep * math.exp(-steep) * volume_m3)), 1500)
    away_m = np.cbrt(near**3 + rng.random(count) * (far**3 - near**3))
    diameters = 1 + rng.exponential(1 / steep, count)
    falls = fall_m_s(diameters)
    long_px = camera.fy * falls * shutter_s / away_m
    wide_px = camera.fx * 1e-3 * diameters / away_m
    passes = np.minimum(1, 1e-3 * diameters / (falls * shutter_s))
    takes = np.minimum(wide_px, 1) * passes
    seen = takes > 0.04
    tall = np.ceil(np.maximum(long_px[seen], 1)).astype(int)
    wide = np.maximum(np.rint(wide_px[seen]), 1).astype(int)
    which = np.repeat(np.arange(len(tall)), tall * wide)
    within = np.arange(len(which)) - np.repeat(np.cumsum(tall * wide) - tall * wide, tall * wide)
    places = rng.uniform(0, [camera.width, camera.height], (count, 2))[seen].astype(int)
    columns = (places[which, 0] + within % wide[which]) % camera.width
    rows = (places[which, 1] + within // wide[which]) % camera.height
    share = np.zeros(light.shape, dtype=np.float32)
    share[rows, columns] = takes[seen][which]
    # Each shows the whole half-space, which is about as bright as the sky is high in it.
    bright = float(np.quantile(light[::8, ::8], 0.75))
    return np.asarray(light + share * (bright - light), dtype=np.float32)
