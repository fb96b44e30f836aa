"""Procedural textures: albedo, relief as slopes, and a fourth channel for glass or coverage."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]

SIDE = 1024  # texels of a field; far larger than what is cut from it, so that cuts differ


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFields:
    """Tiling fields of mean 0 and variance 1, each (SIDE, SIDE) float32."""

    rough: Field
    soft: Field
    grain: Field

    @staticmethod
    def of_seed(seed: int) -> NoiseFields:
        """The fields of a town."""
        rng = np.random.default_rng([seed, 0x6E6F])
        return NoiseFields(
            rough=_coloured(rng, exponent=1.15, low_pass=0.45),
            soft=_coloured(rng, exponent=1.6, low_pass=0.04),
            grain=_coloured(rng, exponent=0.0, low_pass=0.28),
        )

    def cut(self, field: Field, rng: np.random.Generator, shape: tuple[int, int]) -> Field:
        """A random window (h, w), perhaps mirrored; wraps where it is larger than the field."""
        top, left = rng.integers(0, SIDE, 2)
        rows = (top + np.arange(shape[0])) % SIDE
        columns = (left + np.arange(shape[1])) % SIDE
        window = field[rows[:, None], columns[None, :]]
        if rng.random() < 0.5:
            window = window[:, ::-1]
        return np.ascontiguousarray(window)

    def tile(self) -> NDArray[np.uint8]:
        """A (256, 256) uint8 tile with a level distribution, for clouds, snow and puddles."""
        rng = np.random.default_rng(7)
        field = _coloured(rng, exponent=1.8, low_pass=0.25, side=256)
        ranks = np.empty(field.size, dtype=np.float64)
        ranks[np.argsort(field, axis=None, kind="stable")] = np.linspace(0, 255, field.size)
        return ranks.reshape(field.shape).astype(np.uint8)


def _coloured(
    rng: np.random.Generator, exponent: float, low_pass: float, side: int = SIDE
) -> Field:
    """Noise of spectrum 1/f^exponent in amplitude, cut off smoothly at low_pass cycles a texel."""
    white = np.fft.rfft2(rng.standard_normal((side, side)))
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])
    # Below 3 cycles a field nothing, so that a cut's mean says nothing about its place.
    gain = np.where(frequency > 3 / side, np.maximum(frequency, 1 / side) ** -exponent, 0)
    gain *= np.exp(-((frequency / low_pass) ** 4))
    field = np.fft.irfft2(white * gain, s=(side, side))
    return np.asarray(field / field.std(), dtype=np.float32)


Texels = NDArray[np.uint8]
Relief = NDArray[np.floating]

FACADE_PER_M = 48  # texels; one pixel at 8 m with a focal length of 400 px
GROUND_PER_M = 40
WORDS = (
    "BAKERY", "CAFE", "HOTEL", "BOOKS", "PHARMACY", "BANK", "SHOES", "GARAGE", "MARKET",
    "OPTICIAN", "FLOWERS", "PIZZA", "MUSIC", "TOYS", "RADIO", "LIBRARY", "TAILOR", "WINE",
    "FISH", "TEA", "BARBER", "CYCLES", "FLORIST", "DENTIST", "POST", "ANTIQUES", "GROCER",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Style:
    """How much of what one sees is paint and how much is relief.

    These two set how hard a change of light is; set by protocol R (`lab/reports/town.md`), before
    any evaluation.
    """

    paint_contrast: float = 0.37
    relief: float = 1.7


def pack(
    albedo: Relief, height_m: Relief, special: Relief | float, per_m: float, style: Style
) -> Texels:
    """The (h, w, 4) uint8 texels of albedo 0…1, height in metres and the fourth channel 0…1."""
    mean = float(albedo.mean())
    flat = mean * np.clip(albedo / mean, 0.02, 50) ** style.paint_contrast
    texels = np.empty((*albedo.shape, 4), dtype=np.uint8)
    texels[..., 0] = np.clip(flat, 0.02, 0.95) * 255
    for channel, axis in ((1, 1), (2, 0)):
        slope = (np.roll(height_m, -1, axis) - np.roll(height_m, 1, axis)) * (per_m / 2)
        # A normal leans against the slope; the sheer edges of joints are cut off.
        texels[..., channel] = 128.5 - 100 * np.clip(style.relief * slope, -1.25, 1.25)
    texels[..., 3] = np.clip(special, 0, 1) * 255
    return texels


@dataclass(frozen=True, slots=True)
class Opening:
    """A window, door or shop front of a facade: a rectangle in metres above the ground."""

    left_m: float
    right_m: float
    bottom_m: float
    top_m: float
    is_shop: bool = False
    is_door: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Facade:
    """What makes one front distinct.

    Attributes:
        texels: (h, w, 4) uint8, of the whole front, `FACADE_PER_M` texels a metre.
    """

    width_m: float
    height_m: float
    openings: tuple[Opening, ...]
    texels: Texels


def facade(
    rng: np.random.Generator,
    noise: NoiseFields,
    style: Style,
    width_m: float,
    height_m: float,
    per_m: int = FACADE_PER_M,
) -> Facade:
    """A front of plaster, brick or cladding with windows, door, shop and signs."""
    h, w = int(height_m * per_m), int(width_m * per_m)
    albedo, height = _wall(rng, noise, h, w, per_m)
    glass = np.zeros((h, w), dtype=np.float32)
    canvas = _Canvas(albedo, height, glass, per_m, height_m)
    openings = [*_ground_floor(rng, width_m), *_windows(rng, width_m, height_m)]
    for opening in openings:
        _paint_opening(rng, noise, canvas, opening)
        if opening.is_shop:
            _paint_sign(rng, canvas, opening)
    _paint_plates(rng, noise, canvas, width_m)
    stains = np.clip(noise.cut(noise.soft, rng, (h, w)), 0, 2)
    albedo *= 1 - 0.14 * stains * np.linspace(0.2, 1, h, dtype=np.float32)[:, None]
    return Facade(width_m, height_m, tuple(openings), pack(albedo, height, glass, per_m, style))


@dataclass(frozen=True, slots=True, eq=False)
class _Canvas:
    albedo: Field
    height: Field
    glass: Field
    per_m: int
    height_m: float

    def window(
        self, left_m: float, right_m: float, bottom_m: float, top_m: float, grow_m: float = 0
    ) -> tuple[slice, slice]:
        h, w = self.albedo.shape
        rows = (self.height_m - top_m - grow_m, self.height_m - bottom_m + grow_m)
        top, bottom = (int(np.clip(round(value * self.per_m), 0, h)) for value in rows)
        left, right = (
            int(np.clip(round(value * self.per_m), 0, w))
            for value in (left_m - grow_m, right_m + grow_m)
        )
        return slice(top, bottom), slice(left, right)


def _wall(
    rng: np.random.Generator, noise: NoiseFields, h: int, w: int, per_m: int
) -> tuple[Field, Field]:
    base = rng.uniform(0.22, 0.68)
    rough = noise.cut(noise.rough, rng, (h, w))
    grain = noise.cut(noise.grain, rng, (h, w))
    albedo = np.full((h, w), base, dtype=np.float32)
    height = 0.005 * rough + 0.0012 * grain
    kind = rng.integers(3)
    rows, columns = np.arange(h)[:, None], np.arange(w)[None, :]
    if kind == 0:  # bricks or blocks of stone
        course = max(3, int(rng.choice([0.11, 0.22, 0.45]) * per_m))
        length = course * int(rng.integers(2, 4))
        row = rows // course
        shifted = columns + (row % 2) * (length // 2)
        tone = rng.normal(0, 0.22, (h // course + 1, (w + length) // length + 1))
        tone = tone.astype(np.float32)[row, shifted // length]
        albedo *= 1 + tone
        height += 0.012 * tone
        joint = ((rows % course) < 2) | ((shifted % length) < 2)
        albedo[joint] = base * (1.35 if rng.random() < 0.5 else 0.6)
        height[joint] -= 0.02
    elif kind == 1:  # plaster
        height += 0.005 * noise.cut(noise.soft, rng, (h, w))
        albedo *= 1 + 0.05 * grain
    else:  # cladding
        length = max(4, int(rng.choice([0.2, 0.6, 1.0]) * per_m))
        tone = rng.normal(0, 0.12, w // length + 1).astype(np.float32)
        albedo *= 1 + tone[columns // length]
        joint = np.broadcast_to((columns % length) < 2, (h, w))
        albedo[joint] *= 0.5
        height[joint] -= 0.03
    albedo *= np.exp(0.15 * rough + 0.03 * grain)
    return np.clip(albedo, 0.03, 0.95), height


def _windows(rng: np.random.Generator, width_m: float, height_m: float) -> list[Opening]:
    floor_m, columns = 3.1, int(rng.integers(2, 5))
    window_m = min(rng.uniform(0.8, 1.5), 0.62 * width_m / columns)
    tall_m = rng.uniform(1.3, 1.9)
    found = []
    for storey in range(int((height_m - 3.6) // floor_m)):
        bottom = 3.9 + storey * floor_m
        for column in range(columns):
            middle = width_m * (column + 0.5) / columns
            found.append(
                Opening(middle - window_m / 2, middle + window_m / 2, bottom, bottom + tall_m)
            )
    return found


def _ground_floor(rng: np.random.Generator, width_m: float) -> list[Opening]:
    door = rng.uniform(0.4, width_m - 1.8)
    openings = [Opening(door, door + 1.1, 0.05, 2.25, is_door=True)]
    low, high = (
        (door + 1.6, width_m - 0.5) if width_m - door > width_m / 2 + 0.8 else (0.5, door - 0.5)
    )
    if high - low > 1.2 and rng.random() < 0.6:
        openings.append(Opening(low, high, 0.6, 2.5, is_shop=True))
    elif high - low > 1.2:
        count = max(1, int((high - low) / 2.0))
        for k in range(count):
            middle = low + (high - low) * (k + 0.5) / count
            openings.append(Opening(middle - 0.5, middle + 0.5, 1.0, 2.5))
    return sorted(openings, key=lambda opening: opening.left_m)


def _paint_opening(
    rng: np.random.Generator, noise: NoiseFields, canvas: _Canvas, opening: Opening
) -> None:
    bounds = (opening.left_m, opening.right_m, opening.bottom_m, opening.top_m)
    frame = rng.choice([0.8, 0.12, 0.45])
    surround, inside = canvas.window(*bounds, grow_m=0.1), canvas.window(*bounds)
    canvas.albedo[surround] = frame
    canvas.height[surround] = 0.03
    canvas.height[inside] = 0
    if opening.is_door:
        canvas.albedo[inside] = rng.uniform(0.06, 0.5)
        panel = canvas.window(bounds[0] + 0.2, bounds[1] - 0.2, 1.2, 1.9)
        canvas.albedo[panel] *= 0.5
        canvas.height[panel] = -0.02
        return
    canvas.albedo[inside] = 0.06 + 0.08 * rng.random()
    canvas.glass[inside] = 1
    if opening.is_shop:
        _paint_goods(rng, canvas, opening)
    elif rng.random() < 0.6:  # a curtain or blind
        depth = rng.uniform(0.2, 0.7) * (bounds[3] - bounds[2])
        blind = canvas.window(bounds[0], bounds[1], bounds[3] - depth, bounds[3])
        canvas.albedo[blind] = rng.uniform(0.3, 0.8)
        canvas.albedo[blind] *= np.exp(
            0.08 * noise.cut(noise.rough, rng, canvas.albedo[blind].shape)
        )
        canvas.glass[blind] *= 0.6
    middle = (bounds[0] + bounds[1]) / 2
    cross = bounds[2] + 0.66 * (bounds[3] - bounds[2])
    edge = 0.05
    for bar in (
        (middle - 0.03, middle + 0.03, bounds[2], bounds[3]),
        (bounds[0], bounds[1], cross - 0.03, cross + 0.03),
        (bounds[0], bounds[0] + edge, bounds[2], bounds[3]),
        (bounds[1] - edge, bounds[1], bounds[2], bounds[3]),
        (bounds[0], bounds[1], bounds[3] - edge, bounds[3]),
        (bounds[0], bounds[1], bounds[2], bounds[2] + edge),
    ):
        wood = canvas.window(*bar)
        canvas.albedo[wood] = frame
        canvas.glass[wood] = 0
        canvas.height[wood] = 0.02


def _paint_goods(rng: np.random.Generator, canvas: _Canvas, opening: Opening) -> None:
    for _ in range(14):
        left = rng.uniform(opening.left_m, opening.right_m - 0.3)
        bottom = rng.uniform(opening.bottom_m, opening.top_m - 0.6)
        size = rng.uniform(0.12, 0.5)
        item = canvas.window(
            left,
            min(left + size, opening.right_m),
            bottom,
            min(bottom + rng.uniform(0.1, 0.6), opening.top_m),
        )
        canvas.albedo[item] = rng.random()
        canvas.glass[item] *= rng.uniform(0.3, 1)


def _paint_sign(rng: np.random.Generator, canvas: _Canvas, opening: Opening) -> None:
    board = canvas.window(opening.left_m, opening.right_m, 2.78, 3.36)
    canvas.albedo[board] = letters(rng, canvas.albedo[board].shape)
    canvas.height[board] = 0.04


def letters(rng: np.random.Generator, shape: tuple[int, ...]) -> Field:
    """A word painted on a board of (h, w) texels, albedo 0…1."""
    ground = float(rng.choice([0.1, 0.85, 0.3]))
    board = np.full(shape, int(ground * 255), dtype=np.uint8)
    scale = shape[0] / 34
    cv2.putText(
        board,
        str(rng.choice(WORDS)),
        (max(2, shape[1] // 12), int(shape[0] * 0.74)),
        cv2.FONT_HERSHEY_DUPLEX,
        scale,
        int(255 * (0.95 - ground)),
        max(1, int(2 * scale)),
        cv2.LINE_AA,
    )
    return np.asarray(board.astype(np.float32) / 255, dtype=np.float32)


def _paint_plates(
    rng: np.random.Generator, noise: NoiseFields, canvas: _Canvas, width_m: float
) -> None:
    for _ in range(int(rng.integers(1, 4))):  # posters, plates, meter boxes
        left, bottom = rng.uniform(0.1, width_m - 0.8), rng.uniform(1.0, 2.2)
        plate = canvas.window(left, left + rng.uniform(0.25, 0.6), bottom, bottom + 0.7)
        shape = canvas.albedo[plate].shape
        canvas.albedo[plate] = np.clip(0.5 + 0.3 * noise.cut(noise.rough, rng, shape), 0.03, 0.95)


def plain(
    rng: np.random.Generator,
    noise: NoiseFields,
    style: Style,
    albedo: float,
    contrast: float,
    relief_m: float = 0.0,
    side: int = 256,
    per_m: float = 64,
) -> Texels:
    """A generic material (side, side, 4), for small things: stone, bark, metal, paint."""
    rough = noise.cut(noise.rough, rng, (side, side))
    # Fade towards a mirrored copy at the borders, so that repeats show no seam.
    rough = np.concatenate([rough, rough[:, ::-1]], 1)
    rough = np.concatenate([rough, rough[::-1]], 0)[::2, ::2]
    return pack(albedo * np.exp(contrast * rough), relief_m * rough, 0.0, per_m, style)


def sheet(albedo: float, special: float = 0.0) -> Texels:
    """A (4, 4, 4) texture without features."""
    texels = np.full((4, 4, 4), 128, dtype=np.uint8)
    texels[..., 0] = round(255 * albedo)
    texels[..., 3] = round(255 * special)
    return texels


def carriageway(
    rng: np.random.Generator,
    noise: NoiseFields,
    style: Style,
    width_m: float,
    length_m: float,
    crossing: bool,
    marked: bool = True,
) -> Texels:
    """Tarmac with patches, cracks, manholes and markings; v runs along the street."""
    h, w = int(length_m * GROUND_PER_M), int(width_m * GROUND_PER_M)
    grain = noise.cut(noise.grain, rng, (h, w))
    albedo = 0.15 * np.exp(0.12 * noise.cut(noise.rough, rng, (h, w)) + 0.08 * grain)
    height = 0.0028 * grain + 0.0014 * noise.cut(noise.rough, rng, (h, w))
    per_m2 = width_m * length_m
    for _ in range(int(per_m2 / 14)):  # mended places
        top, left = rng.integers(0, h), rng.integers(0, w)
        rows, columns = rng.integers(20, 160), rng.integers(12, 70)
        albedo[top : top + rows, left : left + columns] *= rng.uniform(0.6, 1.4)
    for _ in range(int(per_m2 / 9)):
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.5, 12))
        steps = 15 * np.column_stack([np.cos(heading), np.sin(heading)])
        crack = np.cumsum(np.vstack([[rng.integers(0, w), rng.integers(0, h)], steps]), 0)
        points = [crack.astype(np.int32)]
        cv2.polylines(albedo, points, False, 0.05, 1)
        cv2.polylines(height, points, False, -0.02, 1)
    for _ in range(int(rng.poisson(per_m2 / 60))):
        _manhole(rng, albedo, height)
    if marked:
        _markings(noise, rng, albedo, width_m, crossing)
    return pack(albedo, height, 0.0, GROUND_PER_M, style)


def _manhole(rng: np.random.Generator, albedo: Relief, height: Relief) -> None:
    h, w = albedo.shape
    centre = (int(rng.integers(16, max(17, w - 16))), int(rng.integers(16, max(17, h - 16))))
    cv2.circle(albedo, centre, 13, 0.08, -1)
    cv2.circle(albedo, centre, 13, 0.22, 1)
    cv2.circle(height, centre, 13, 0.008, 1)
    for k in (-6, 0, 6):
        cv2.line(albedo, (centre[0] - 9, centre[1] + k), (centre[0] + 9, centre[1] + k), 0.2, 1)


def _markings(
    noise: NoiseFields, rng: np.random.Generator, albedo: Relief, width_m: float, crossing: bool
) -> None:
    h, w = albedo.shape
    worn = np.clip(0.62 + 0.12 * noise.cut(noise.rough, rng, (h, w)), 0.2, 0.85)
    paint = np.zeros((h, w), dtype=bool)
    middle = w // 2
    for start in range(0, h, 6 * GROUND_PER_M):
        paint[start : start + 3 * GROUND_PER_M, middle - 3 : middle + 3] = True
    edge = int(0.9 * GROUND_PER_M) if width_m > 8 else int(0.3 * GROUND_PER_M)
    paint[:, edge : edge + 4] = paint[:, w - edge - 4 : w - edge] = True
    if crossing:
        top = h - int(3.4 * GROUND_PER_M)
        paint[top:, :] = False
        for left in range(GROUND_PER_M // 2, w - GROUND_PER_M // 2, GROUND_PER_M):
            paint[top + 8 : h - 12, left : left + GROUND_PER_M // 2] = True
    albedo[paint] = worn[paint]


def pavement(
    rng: np.random.Generator, noise: NoiseFields, style: Style, width_m: float, length_m: float
) -> Texels:
    """Slabs with joints; v runs along the street."""
    h, w = int(length_m * GROUND_PER_M), max(8, int(width_m * GROUND_PER_M))
    slab = int(rng.choice([18, 24, 30]))
    rows, columns = np.arange(h)[:, None], np.arange(w)[None, :]
    tone = rng.normal(0, 0.12, (h // slab + 1, w // slab + 1)).astype(np.float32)
    rough, grain = noise.cut(noise.rough, rng, (h, w)), noise.cut(noise.grain, rng, (h, w))
    albedo = 0.32 * np.exp(0.12 * rough + 0.05 * grain + tone[rows // slab, columns // slab])
    height = 0.002 * rough + 0.0015 * grain
    joint = ((rows % slab) < 1) | ((columns % slab) < 1)
    albedo[joint] = 0.1
    height[joint] = -0.015
    return pack(albedo, height, 0.0, GROUND_PER_M, style)


def grass(rng: np.random.Generator, noise: NoiseFields, style: Style) -> Texels:
    """A lawn that tiles: few features of its own (256, 256, 4)."""
    rough = noise.cut(noise.rough, rng, (256, 256))
    grain = noise.cut(noise.grain, rng, (256, 256))
    return pack(
        0.17 * np.exp(0.10 * rough + 0.12 * grain), 0.006 * grain + 0.004 * rough, 0.0, 40, style
    )


def leaves(rng: np.random.Generator, density: float, tone: float) -> Texels:
    """A spray of leaves and twigs (128, 128, 4); density 0 is bare, 1 full summer."""
    side, scale = 128, 4
    cover = np.zeros((side * scale, side * scale), dtype=np.uint8)
    albedo = np.full((side, side), tone, dtype=np.float32)
    for _ in range(9 if density > 0 else 26):  # twigs from the middle outwards
        angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 0.95) * side * scale / 2
        middle = np.array([side * scale / 2] * 2)
        bends = np.cumsum(rng.normal(0, 2.5 * scale, (5, 2)), axis=0) * [[0], [1], [1], [1], [1]]
        steps = np.linspace(0, 1, 5)[:, None] * reach * [np.cos(angle), np.sin(angle)]
        cv2.polylines(cover, [(middle + steps + bends).astype(np.int32)], False, 255, scale)
    for _ in range(int(density * 150)):
        radius = side * scale * 0.46 * np.sqrt(rng.random())
        angle = rng.uniform(0, 2 * np.pi)
        centre = np.array([side * scale / 2] * 2) + radius * np.array(
            [np.cos(angle), np.sin(angle)]
        )
        axes = (int(rng.uniform(3.5, 6.5) * scale), int(rng.uniform(1.6, 3.2) * scale))
        turn = float(rng.uniform(0, 180))
        where = (int(centre[0]), int(centre[1]))
        cv2.ellipse(cover, where, axes, turn, 0, 360, 255, -1)
        small = (where[0] // scale, where[1] // scale)
        cv2.ellipse(
            albedo,
            small,
            (axes[0] // scale, max(1, axes[1] // scale)),
            turn,
            0,
            360,
            float(tone * rng.uniform(0.55, 1.5)),
            -1,
        )
    coverage = cv2.resize(cover, (side, side), interpolation=cv2.INTER_AREA)
    texels = np.full((side, side, 4), 128, dtype=np.uint8)
    texels[..., 0] = np.clip(albedo, 0.02, 0.9) * 255
    texels[..., 1] = 128 + 90 * rng.uniform(-1, 1, (side // 4, side // 4)).repeat(4, 0).repeat(4, 1)
    texels[..., 2] = 128 + 90 * rng.uniform(-1, 1, (side // 4, side // 4)).repeat(4, 0).repeat(4, 1)
    texels[..., 3] = coverage
    return texels


def railing() -> Texels:
    """Bars with two rails, one metre wide and high (128, 128, 4)."""
    texels = np.full((128, 128, 4), 128, dtype=np.uint8)
    texels[..., 0] = 22
    texels[..., 3] = 0
    for left in range(4, 128, 16):
        texels[8:, left : left + 4, 3] = 255
    texels[14:20, :, 3] = texels[108:116, :, 3] = 255
    return texels
