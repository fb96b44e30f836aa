"""Buildings: fronts with real relief, roofs and walls."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engram_lab.town.mesh import Kind, MeshBuilder, SurfaceFlag
from engram_lab.town.textures import Facade, Opening

Vector = NDArray[np.float64]

RECESS_M = 0.16  # of panes and doors behind the wall
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """The vertical plane of a front.

    Attributes:
        corner: (3,) its lower left corner seen from the street, metres.
        along: (3,) unit vector to the right, level.
        texture: number of the facade's texture.
        stone: number of a generic texture for sills and the like.
        tint: factor on the albedo.
    """

    corner: Vector
    along: Vector
    texture: int
    stone: int
    tint: float

    @property
    def outwards(self) -> Vector:
        """Unit vector (3,) towards the street."""
        return np.array([self.along[1], -self.along[0], 0.0])

    def at(self, u_m: float, z_m: float, out_m: float = 0.0) -> Vector:
        """The point u to the right, z above the ground and so far out of the wall."""
        return self.corner + self.along * u_m + _UP * z_m + self.outwards * out_m

    def rectangle(self, u0: float, u1: float, z0: float, z1: float, out_m: float) -> list[Vector]:
        """Four corners, anticlockwise seen from the street."""
        return [self.at(u, z, out_m) for u, z in ((u0, z0), (u1, z0), (u1, z1), (u0, z1))]


def add_front(builder: MeshBuilder, front: Front, facade: Facade, rng: np.random.Generator) -> None:
    """A wall with holes, panes set back in them, reveals, and relief that stands out."""
    width, height = facade.width_m, facade.height_m

    def uv(u0: float, u1: float, z0: float, z1: float) -> list[tuple[float, float]]:
        low, high = 1 - z0 / height, 1 - z1 / height
        return [(u0 / width, low), (u1 / width, low), (u1 / width, high), (u0 / width, high)]

    def put(u0: float, u1: float, z0: float, z1: float, out_m: float, glow: float) -> None:
        flags = SurfaceFlag.GLASS if out_m < 0 else SurfaceFlag.PLAIN
        builder.quad(
            front.rectangle(u0, u1, z0, z1, out_m),
            uv(u0, u1, z0, z1),
            front.texture,
            Kind.BUILDING,
            flags,
            front.tint,
            glow,
        )

    for u0, u1, z0, z1 in wall_pieces(width, height, facade.openings):
        put(u0, u1, z0, z1, 0.0, 0.0)
    for opening in facade.openings:
        lit = rng.uniform(0.3, 1.0) if rng.random() < (0.6 if opening.is_shop else 0.35) else 0.0
        bounds = (opening.left_m, opening.right_m, opening.bottom_m, opening.top_m)
        put(*bounds, -RECESS_M, lit)
        _add_reveals(builder, front, opening)
        _add_relief(builder, front, opening, rng)
    # Behind the wall, so that a crack between two pieces shows wall and no sky.
    put(0, width, 0, height, -RECESS_M - 0.05, 0.0)
    _add_courses(builder, front, facade, rng)


def wall_pieces(
    width_m: float, height_m: float, openings: tuple[Opening, ...]
) -> list[tuple[float, float, float, float]]:
    """Rectangles (left, right, bottom, top) that cover a wall except its openings."""
    levels = sorted({0.0, height_m, *(o.bottom_m for o in openings), *(o.top_m for o in openings)})
    pieces = []
    for bottom, top in pairwise(levels):
        cuts = sorted(
            (o.left_m, o.right_m) for o in openings if o.bottom_m <= bottom and o.top_m >= top
        )
        left = 0.0
        for start, end in cuts:
            if start > left:
                pieces.append((left, start, bottom, top))
            left = max(left, end)
        if left < width_m:
            pieces.append((left, width_m, bottom, top))
    return pieces


def _add_reveals(builder: MeshBuilder, front: Front, opening: Opening) -> None:
    u0, u1, z0, z1 = opening.left_m, opening.right_m, opening.bottom_m, opening.top_m
    deep = -RECESS_M
    sides = [
        ((u0, z0, 0), (u0, z0, deep), (u0, z1, deep), (u0, z1, 0)),
        ((u1, z0, deep), (u1, z0, 0), (u1, z1, 0), (u1, z1, deep)),
        ((u0, z0, 0), (u1, z0, 0), (u1, z0, deep), (u0, z0, deep)),
        ((u0, z1, deep), (u1, z1, deep), (u1, z1, 0), (u0, z1, 0)),
    ]
    for corners in sides:
        long = max(u1 - u0, z1 - z0) * 0.25
        builder.quad(
            [front.at(*corner) for corner in corners],
            [(0, 0.04), (long, 0.04), (long, 0), (0, 0)]
            if corners[0][2] == corners[1][2]
            else [(0, long), (0.04, long), (0.04, 0), (0, 0)],
            front.stone,
            Kind.BUILDING,
            SurfaceFlag.TWO_SIDED,
        )


def _slab(
    builder: MeshBuilder,
    front: Front,
    bounds: tuple[float, float, float, float],
    out_m: float,
    faces: str = "ewstd",
    tint: float = 1.0,
) -> None:
    """A box on the wall: bounds (left, right, bottom, top), standing out so far."""
    u0, u1, z0, z1 = bounds
    centre = front.at((u0 + u1) / 2, (z0 + z1) / 2, out_m / 2)
    axes = [
        front.along * (u1 - u0) / 2,
        -front.outwards * out_m / 2,
        _UP * (z1 - z0) / 2,
    ]
    builder.box(centre, axes, front.stone, Kind.BUILDING, faces=faces, tint=tint)


def _add_relief(
    builder: MeshBuilder, front: Front, opening: Opening, rng: np.random.Generator
) -> None:
    u0, u1, z0, z1 = opening.left_m, opening.right_m, opening.bottom_m, opening.top_m
    if opening.is_door:
        _slab(builder, front, (u0 - 0.1, u1 + 0.1, 0, 0.12), 0.35, "ewst")
        if rng.random() < 0.4:
            _slab(builder, front, (u0 - 0.3, u1 + 0.3, z1 + 0.15, z1 + 0.25), 0.7)
        return
    if opening.is_shop:
        _slab(builder, front, (u0 - 0.12, u1 + 0.12, 2.6, 2.74), 0.22)
        return
    _slab(builder, front, (u0 - 0.12, u1 + 0.12, z0 - 0.13, z0 - 0.01), 0.2)
    if rng.random() < 0.5:
        _slab(builder, front, (u0 - 0.1, u1 + 0.1, z1 + 0.05, z1 + 0.2), 0.14)
    if z0 > 3.5 and rng.random() < 0.13:
        _add_balcony(builder, front, opening)


def _add_balcony(builder: MeshBuilder, front: Front, opening: Opening) -> None:
    u0, u1, z0 = opening.left_m - 0.35, opening.right_m + 0.35, opening.bottom_m - 0.3
    _slab(builder, front, (u0, u1, z0, z0 + 0.14), 0.85)
    for k in range(6):
        u = u0 + 0.03 + (u1 - u0 - 0.06) * k / 5
        bar = (u - 0.02, u + 0.02, z0 + 0.14, z0 + 1.0)
        centre = front.at(u, (bar[2] + bar[3]) / 2, 0.82)
        axes = [front.along * 0.02, -front.outwards * 0.02, _UP * 0.43]
        builder.box(centre, axes, front.stone, Kind.BUILDING, faces="ews", tint=0.3)
    rail = front.at((u0 + u1) / 2, z0 + 1.02, 0.82)
    axes = [front.along * (u1 - u0) / 2, -front.outwards * 0.03, _UP * 0.03]
    builder.box(rail, axes, front.stone, Kind.BUILDING, faces="ewstd", tint=0.3)


def _add_courses(
    builder: MeshBuilder, front: Front, facade: Facade, rng: np.random.Generator
) -> None:
    width, height = facade.width_m, facade.height_m
    _slab(builder, front, (-0.02, width + 0.02, height - 0.42, height - 0.04), 0.32)
    if rng.random() < 0.7:
        _slab(builder, front, (0, width, 3.46, 3.62), 0.12)
    if rng.random() < 0.6:  # downpipe
        u = 0.25 if rng.random() < 0.5 else width - 0.25
        _slab(builder, front, (u - 0.05, u + 0.05, 0.1, height - 0.42), 0.12, "ews", 0.6)


def add_shell(
    builder: MeshBuilder,
    front: Front,
    width_m: float,
    height_m: float,
    depth_m: float,
    roof: int,
    rng: np.random.Generator,
    slides_m: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Side and back walls, and a roof: flat, or with its ridge along the street.

    `slides_m` moves the left and the right end of the back wall along the front, for houses round
    whose corner the fronts of another street begin.
    """
    out = front.outwards

    def wall(a: Vector, b: Vector, top_m: float) -> None:
        long, tall = float(np.linalg.norm(b - a)) * 0.25, top_m * 0.25
        corners = [a, b, b + _UP * top_m, a + _UP * top_m]
        uv = [(0, tall), (long, tall), (long, 0), (0, 0)]
        builder.quad(corners, uv, front.stone, Kind.BUILDING, tint=front.tint)

    left, right = front.at(0, 0), front.at(width_m, 0)
    back_left = left - out * depth_m + front.along * slides_m[0]
    back_right = right - out * depth_m + front.along * slides_m[1]
    wall(right, back_right, height_m)
    wall(back_right, back_left, height_m)
    wall(back_left, left, height_m)
    eaves = [point + _UP * height_m for point in (left, right, back_right, back_left)]
    if rng.random() < 0.35:
        tiles = [(0, depth_m / 4), (width_m / 4, depth_m / 4), (width_m / 4, 0), (0, 0)]
        builder.quad(eaves, tiles, roof, Kind.BUILDING)
        return
    rise = rng.uniform(1.8, 3.2)
    ridge = [(eaves[0] + eaves[3]) / 2 + _UP * rise, (eaves[1] + eaves[2]) / 2 + _UP * rise]
    slope = float(np.hypot(depth_m / 2, rise)) / 4
    tiles = [(0, slope), (width_m / 4, slope), (width_m / 4, 0), (0, 0)]
    builder.quad([eaves[0], eaves[1], ridge[1], ridge[0]], tiles, roof, Kind.BUILDING)
    builder.quad([eaves[2], eaves[3], ridge[0], ridge[1]], tiles, roof, Kind.BUILDING)
    for a, b, top in ((eaves[1], eaves[2], ridge[1]), (eaves[3], eaves[0], ridge[0])):
        uv = [(0, rise / 4), (depth_m / 4, rise / 4), (depth_m / 8, 0), (depth_m / 8, 0)]
        builder.quad([a, b, top, top], uv, front.stone, Kind.BUILDING, tint=front.tint)
    chimney = (ridge[0] + ridge[1]) / 2 + rng.uniform(-0.3, 0.3) * (ridge[1] - ridge[0])
    axes = [front.along * 0.3, -out * 0.3, _UP * 0.8]
    builder.box(chimney, axes, front.stone, Kind.BUILDING)
