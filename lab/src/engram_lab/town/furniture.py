"""What stands in the street: lamps, trees, hedges, signs, fences, benches, stalls."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engram_lab import _town
from engram_lab.town.mesh import Kind, MeshBuilder, SurfaceFlag
from engram_lab.town.noise import NoiseFields
from engram_lab.town.textures import (
    Style,
    Texels,
    grass,
    leaves,
    pack,
    plain,
    railing,
    sheet,
)

Vector = NDArray[np.float64]

_LEAF = SurfaceFlag.CUTOUT | SurfaceFlag.TRANSLUCENT | SurfaceFlag.TWO_SIDED
LAMP_HEIGHT_M = 5.6


@dataclass(frozen=True, slots=True)
class Materials:
    """Numbers of the textures that all of a town shares.

    Attributes:
        stone, bark, metal, roof, grass, cloth, rubber, glass, light: one each.
        paints: car paints from dark to bright.
        foliage: (season, variant) → texture; seasons are 0 summer, 1 autumn, 2 bare.
        hedges: the same for hedges, which stay green.
        railing: bars.
        signs, sign_backs: traffic signs; their bare backs, in the same order.
        plates: number plates.
    """

    stone: int
    bark: int
    metal: int
    roof: int
    grass: int
    cloth: int
    rubber: int
    glass: int
    light: int
    paints: tuple[int, ...]
    foliage: tuple[tuple[int, ...], ...]
    hedges: tuple[int, ...]
    railing: int
    signs: tuple[int, ...]
    sign_backs: tuple[int, ...]
    plates: tuple[int, ...]


def shared_materials(scene: _town.Scene, noise: NoiseFields, style: Style, seed: int) -> Materials:
    """Makes the textures and hands them to the renderer."""
    rng = np.random.default_rng([seed, 0x3A7])

    def solid(albedo: float, contrast: float, relief_m: float = 0.0, per_m: float = 64) -> int:
        return scene.add_texture(plain(rng, noise, style, albedo, contrast, relief_m, per_m=per_m))

    foliage = tuple(
        tuple(scene.add_texture(leaves(rng, density, tone), coverage=True) for _ in range(4))
        for density, tone in ((1.0, 0.16), (0.55, 0.3), (0.0, 0.12))
    )
    return Materials(
        stone=solid(0.42, 0.2, 0.006),
        bark=solid(0.15, 0.3, 0.012),
        metal=solid(0.2, 0.08),
        roof=scene.add_texture(_roof_tiles(rng, noise, style)),
        grass=scene.add_texture(grass(rng, noise, style)),
        cloth=scene.add_texture(_stripes()),
        rubber=scene.add_texture(sheet(0.035)),
        glass=scene.add_texture(sheet(0.05, 0.9)),
        light=scene.add_texture(sheet(0.7, 1.0)),
        paints=tuple(solid(albedo, 0.02) for albedo in (0.05, 0.12, 0.28, 0.5, 0.75)),
        foliage=foliage,
        hedges=tuple(scene.add_texture(leaves(rng, 1.5, 0.11), coverage=True) for _ in range(2)),
        railing=scene.add_texture(railing(), coverage=True),
        signs=tuple(scene.add_texture(_traffic_sign(k), coverage=True) for k in range(6)),
        sign_backs=tuple(
            scene.add_texture(_bare(_traffic_sign(k)), coverage=True) for k in range(6)
        ),
        plates=tuple(scene.add_texture(_number_plate(rng)) for _ in range(8)),
    )


def _roof_tiles(rng: np.random.Generator, noise: NoiseFields, style: Style) -> Texels:
    rows, columns = np.arange(256)[:, None], np.arange(256)[None, :]
    tone = rng.normal(0, 0.2, (17, 17)).astype(np.float32)[rows // 16, (columns // 16)]
    albedo = 0.2 * np.exp(tone + 0.1 * noise.cut(noise.rough, rng, (256, 256)))
    height = 0.02 * ((rows % 16) / 16) * np.ones((1, 256))
    return pack(albedo.astype(np.float32), height.astype(np.float32), 0.0, 64, style)


def _stripes() -> Texels:
    texels = sheet(0.7).repeat(32, 0).repeat(32, 1)
    texels[:, (np.arange(128) // 16) % 2 == 0, 0] = 60
    return texels


def _number_plate(rng: np.random.Generator) -> Texels:
    face = np.full((40, 184), 205, np.uint8)
    text = "".join(chr(65 + int(k)) for k in rng.integers(0, 26, 2)) + f"{rng.integers(10, 80)} "
    text += "".join(chr(65 + int(k)) for k in rng.integers(0, 26, 3))
    cv2.putText(face, text, (6, 31), cv2.FONT_HERSHEY_DUPLEX, 1.05, 20, 3, cv2.LINE_AA)
    texels = np.full((40, 184, 4), 128, dtype=np.uint8)
    texels[..., 0], texels[..., 3] = face, 0
    return texels


def _traffic_sign(kind: int) -> Texels:
    texels = np.full((96, 96, 4), 128, dtype=np.uint8)
    face, cover = np.full((96, 96), 200, np.uint8), np.zeros((96, 96), np.uint8)
    if kind % 3 == 2:
        corners = np.array([[48, 6], [92, 84], [4, 84]], np.int32)
        cv2.fillPoly(cover, [corners], 255)
        cv2.polylines(face, [corners], True, 60, 14)
        cv2.line(face, (48, 34), (48, 62), 15, 8)
        cv2.circle(face, (48, 74), 5, 15, -1)
    else:
        cv2.circle(cover, (48, 48), 45, 255, -1)
        cv2.circle(face, (48, 48), 42, 60, 9)
        text = ("30", "", "20", "50", "P", "")[kind]
        if text:
            cv2.putText(face, text, (16, 62), cv2.FONT_HERSHEY_DUPLEX, 1.5, 15, 4, cv2.LINE_AA)
        else:
            cv2.rectangle(face, (18, 40), (78, 56), 230 if kind else 15, -1)
    texels[..., 0], texels[..., 3] = face, cover
    return texels


def _bare(sign: Texels) -> Texels:
    """The back of a sign: its outline in plain metal."""
    back = sign.copy()
    back[..., 0] = 90
    return back


def _up(z_m: float) -> Vector:
    return np.array([0.0, 0.0, z_m])


def _upright(half_m: float, tall_m: float) -> Vector:
    return np.diag([half_m, half_m, tall_m / 2])


def add_post(
    builder: MeshBuilder,
    foot: Vector,
    tall_m: float,
    half_m: float,
    texture: int,
    kind: Kind = Kind.FURNITURE,
    tint: float = 1.0,
) -> None:
    """A square post on a point (3,)."""
    centre = foot + _up(tall_m / 2)
    flags = SurfaceFlag.SLENDER if half_m <= 0.2 else SurfaceFlag.PLAIN
    builder.box(centre, _upright(half_m, tall_m), texture, kind, flags=flags, tint=tint)


def add_lamp(builder: MeshBuilder, materials: Materials, foot: Vector, arm: Vector) -> Vector:
    """A street lamp; arm (3,) points level to the road. Returns where its light is."""
    add_post(builder, foot, LAMP_HEIGHT_M + 0.1, 0.06, materials.metal)
    side = np.array([-arm[1], arm[0], 0.0])
    head = foot + arm * 1.3 + _up(LAMP_HEIGHT_M + 0.1)
    middle = foot + arm * 0.65 + _up(LAMP_HEIGHT_M + 0.06)
    axes = np.array([arm * 0.65, side * 0.035, [0, 0, 0.035]])
    slender = SurfaceFlag.SLENDER
    builder.box(middle, axes, materials.metal, Kind.FURNITURE, flags=slender, faces="ewnstd")
    axes = np.array([arm * 0.32, side * 0.11, [0, 0, 0.05]])
    builder.box(head, axes, materials.metal, Kind.FURNITURE, flags=slender, faces="ewnst")
    light = head - _up(0.055)
    corners = [light - axes[0] + axes[1], light + axes[0] + axes[1]]
    corners += [light + axes[0] - axes[1], light - axes[0] - axes[1]]
    square = [(0, 1), (1, 1), (1, 0), (0, 0)]
    builder.quad(corners, square, materials.light, Kind.FURNITURE, SurfaceFlag.NO_SHADOW, glow=6.0)
    return light - _up(0.12)


def add_tree(
    wood: MeshBuilder,
    green: MeshBuilder,
    materials: Materials,
    foot: Vector,
    season: int,
    rng: np.random.Generator,
) -> None:
    """A trunk with limbs in `wood`, a crown of sprays in `green`."""
    trunk_m, radius_m = rng.uniform(2.4, 3.4), rng.uniform(1.4, 2.3)
    tall_m = rng.uniform(1.0, 1.4) * radius_m
    thick_m = rng.uniform(0.11, 0.2)
    crown = foot + _up(trunk_m + 0.75 * tall_m)
    add_post(wood, foot, trunk_m, thick_m, materials.bark, Kind.VEGETATION)
    _add_limb(wood, materials, foot + _up(trunk_m - 0.05), crown + _up(0.7 * tall_m), 0.6 * thick_m)
    for _ in range(7):
        lean = rng.normal(0, 1, 3) * [1, 1, 0.3] + _up(0.9)
        lean /= np.linalg.norm(lean)
        start = foot + _up(trunk_m * rng.uniform(0.75, 1.1))
        end = start + lean * rng.uniform(0.7, 1.1) * radius_m
        _add_limb(wood, materials, start, end, 0.045)
        for _ in range(3):
            fork = start + (end - start) * rng.uniform(0.4, 0.95)
            tip = fork + (lean + rng.normal(0, 0.7, 3)) * 0.35 * radius_m
            _add_limb(wood, materials, fork, tip, 0.022)
    for _ in range(int(55 * radius_m)):
        direction = rng.standard_normal(3)
        direction *= rng.uniform(0.25, 1) ** 0.4 / np.linalg.norm(direction)
        middle = crown + direction * [radius_m, radius_m, tall_m]
        right, up, _ = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        size_m = rng.uniform(0.45, 0.75)
        corners = [
            middle + size_m * (a * right + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        texture = materials.foliage[season][int(rng.integers(4))]
        square = [(0, 1), (1, 1), (1, 0), (0, 0)]
        tint = float(np.clip(1 + 0.12 * rng.standard_normal(), 0.6, 1.4))
        green.quad(corners, square, texture, Kind.VEGETATION, _LEAF, tint)


def _add_limb(
    wood: MeshBuilder, materials: Materials, start: Vector, end: Vector, half_m: float
) -> None:
    """A branch from point to point (3,), square across."""
    along = end - start
    across = np.cross(along, [0.31, 0.92, 0.13])
    across *= half_m / np.linalg.norm(across)
    other = np.cross(along, across) / np.linalg.norm(along)
    axes = [across, other, along / 2]
    slender = SurfaceFlag.SLENDER
    wood.box((start + end) / 2, axes, materials.bark, Kind.VEGETATION, flags=slender, faces="ewns")


def add_hedge(
    green: MeshBuilder,
    materials: Materials,
    start: Vector,
    end: Vector,
    tall_m: float,
    rng: np.random.Generator,
) -> None:
    """A row of sprays between two points (3,) on a dark core."""
    along = end - start
    long_m = float(np.linalg.norm(along))
    along = along / long_m
    side = np.array([along[1], -along[0], 0.0])
    axes = [along * long_m / 2, -side * 0.22, np.array([0, 0, (tall_m - 0.15) / 2])]
    middle = (start + end) / 2 + _up((tall_m - 0.15) / 2)
    green.box(middle, axes, materials.bark, Kind.VEGETATION, tint=0.5)
    for _ in range(int(long_m * tall_m * 5)):
        at = start + along * rng.uniform(0, long_m) + _up(rng.uniform(0.25, tall_m))
        at = at + side * rng.choice([-1, 1]) * rng.uniform(0.2, 0.34)
        right, up, _ = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        size_m = rng.uniform(0.25, 0.42)
        corners = [
            at + size_m * (a * right + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        texture = materials.hedges[int(rng.integers(2))]
        square = [(0, 1), (1, 1), (1, 0), (0, 0)]
        green.quad(corners, square, texture, Kind.VEGETATION, _LEAF)


def add_fence(builder: MeshBuilder, materials: Materials, start: Vector, end: Vector) -> None:
    """Railings between two points (3,), one metre high, with posts."""
    long_m = float(np.linalg.norm(end - start))
    top = np.array([0, 0, 1.05])
    uv = [(0, 1), (long_m, 1), (long_m, 0), (0, 0)]
    flags = SurfaceFlag.CUTOUT | SurfaceFlag.TWO_SIDED
    builder.quad([start, end, end + top, start + top], uv, materials.railing, Kind.FURNITURE, flags)
    for k in range(int(long_m // 2.5) + 1):
        foot = start + (end - start) * min(1.0, 2.5 * k / long_m)
        add_post(builder, foot, 1.15, 0.05, materials.metal, tint=0.4)


def add_sign(
    builder: MeshBuilder,
    materials: Materials,
    foot: Vector,
    facing: Vector,
    rng: np.random.Generator,
) -> None:
    """A traffic sign on a post; facing (3,) is the level direction that it is read from."""
    add_post(builder, foot, 2.7, 0.035, materials.metal)
    right = np.array([-facing[1], facing[0], 0.0])
    middle, half = foot + facing * 0.05 + [0, 0, 2.35], 0.33
    up = np.array([0, 0, half])
    corners = [middle - half * right - up, middle + half * right - up]
    corners += [middle + half * right + up, middle - half * right + up]
    square = [(0, 1), (1, 1), (1, 0), (0, 0)]
    which = int(rng.integers(len(materials.signs)))
    builder.quad(corners, square, materials.signs[which], Kind.FURNITURE, SurfaceFlag.CUTOUT)
    back = [corners[1], corners[0], corners[3], corners[2]]
    builder.quad(back, square, materials.sign_backs[which], Kind.FURNITURE, SurfaceFlag.CUTOUT)


def add_bench(builder: MeshBuilder, materials: Materials, at: Vector, along: Vector) -> None:
    """A bench on a point (3,), its long side along a level unit vector (3,)."""
    side = np.array([along[1], -along[0], 0.0])
    up = np.array([0.0, 0.0, 1.0])
    for shift, half_side, low, high in ((0.0, 0.22, 0.42, 0.47), (-0.22, 0.03, 0.5, 0.85)):
        centre = at + side * shift + up * (low + high) / 2
        axes = [along * 0.8, -side * half_side, up * (high - low) / 2]
        builder.box(centre, axes, materials.bark, Kind.FURNITURE, faces="ewnstd", tint=1.6)
    for shift in (-0.65, 0.65):
        centre = at + along * shift + up * 0.21
        axes = [along * 0.04, -side * 0.2, up * 0.21]
        builder.box(centre, axes, materials.metal, Kind.FURNITURE, tint=0.5)


def add_stall(
    builder: MeshBuilder,
    materials: Materials,
    at: Vector,
    along: Vector,
    rng: np.random.Generator,
) -> None:
    """A market stall: table, crates, and a striped roof on four posts."""
    side, up = np.array([along[1], -along[0], 0.0]), np.array([0.0, 0.0, 1.0])
    axes = [along * 1.3, -side * 0.5, up * 0.42]
    builder.box(at + up * 0.42, axes, materials.cloth, Kind.TEMPORARY, per_m=0.8)
    for _ in range(6):
        crate = at + along * rng.uniform(-1.1, 1.1) + side * rng.uniform(-0.3, 0.3) + up * 0.94
        axes = [along * 0.18, -side * 0.14, up * 0.1]
        tint = float(rng.uniform(0.4, 1.6))
        builder.box(crate, axes, materials.stone, Kind.TEMPORARY, tint=tint)
    for a in (-1.3, 1.3):
        for b in (-0.7, 0.7):
            foot = at + along * a + side * b
            add_post(builder, foot, 2.2, 0.03, materials.metal, Kind.TEMPORARY)
    eaves = [at + along * a + side * b + up * 2.15 for a, b in ((-1.5, 0.9), (1.5, 0.9))]
    ridge = [at + along * a + up * 2.6 for a in (1.5, -1.5)]
    far = [at + along * a - side * 0.9 + up * 2.15 for a in (1.5, -1.5)]
    uv = [(0, 1), (2.5, 1), (2.5, 0), (0, 0)]
    builder.quad(
        [eaves[0], eaves[1], ridge[0], ridge[1]],
        uv,
        materials.cloth,
        Kind.TEMPORARY,
        SurfaceFlag.TWO_SIDED,
    )
    builder.quad(
        [far[0], far[1], ridge[1], ridge[0]],
        uv,
        materials.cloth,
        Kind.TEMPORARY,
        SurfaceFlag.TWO_SIDED,
    )
