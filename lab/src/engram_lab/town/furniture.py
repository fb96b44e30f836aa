"""What stands and drives in the street: furniture, trees, vehicles, people, buildings.

Cars, vans, cyclists and pedestrians as small meshes around their own origin. Each stands on z = 0
and faces east (+x); `Mesh.moved` puts it in its place.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from engram_lab import _town
from engram_lab.town.mesh import Kind, Mesh, MeshBuilder, SurfaceFlag
from engram_lab.town.textures import (
    Facade,
    NoiseFields,
    Opening,
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
        foliage: (season, variant) → texture; seasons are 0 summer, 1 autumn, 2 bare.
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


@dataclass(frozen=True, slots=True)
class Foliage:
    """What a tree bears on a day.

    Attributes:
        season: 0 leaves, 1 autumn, 2 bare.
        leaves: share of them that is out.
    """

    season: int
    leaves: float = 1.0


def add_tree(
    wood: MeshBuilder,
    green: MeshBuilder,
    materials: Materials,
    foot: Vector,
    foliage: Foliage,
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
    sprays = int(55 * radius_m)
    for number in range(sprays):
        direction = rng.standard_normal(3)
        direction *= rng.uniform(0.25, 1) ** 0.4 / np.linalg.norm(direction)
        middle = crown + direction * [radius_m, radius_m, tall_m]
        right, up, _ = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        size_m = rng.uniform(0.45, 0.75)
        corners = [
            middle + size_m * (a * right + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        texture = materials.foliage[foliage.season][int(rng.integers(4))]
        square = [(0, 1), (1, 1), (1, 0), (0, 0)]
        tint = float(np.clip(1 + 0.12 * rng.standard_normal(), 0.6, 1.4))
        if number < foliage.leaves * sprays or foliage.season == 2:
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


# Profiles from the front bumper over the roof to the rear: (x, z) in metres, and whether the
# segment that starts there is glass.
_SALOON = (
    (2.15, 0.35, False), (2.2, 0.62, False), (1.15, 0.88, True), (0.35, 1.38, False),
    (-0.95, 1.42, True), (-1.6, 0.98, False), (-2.15, 0.92, False), (-2.2, 0.4, False),
)  # fmt: skip
_HATCH = (
    (1.85, 0.35, False), (1.9, 0.66, False), (1.05, 0.92, True), (0.35, 1.45, False),
    (-1.2, 1.5, True), (-1.75, 0.98, False), (-1.85, 0.9, False), (-1.85, 0.4, False),
)  # fmt: skip
_VAN = (
    (2.4, 0.4, False), (2.45, 0.95, False), (1.9, 1.15, True), (1.35, 1.95, False),
    (-2.3, 2.05, False), (-2.4, 1.0, False), (-2.4, 0.7, False), (-2.4, 0.45, False),
)  # fmt: skip
_SQUARE = [(0, 1), (1, 1), (1, 0), (0, 0)]


def car(materials: Materials, rng: np.random.Generator, kind: Kind = Kind.PARKED) -> Mesh:
    """A saloon, hatchback or van in one of the paints."""
    builder = MeshBuilder()
    profile = (_SALOON, _HATCH, _HATCH, _VAN)[int(rng.integers(4))]
    stretch, rise = rng.uniform(0.92, 1.08), rng.uniform(0.95, 1.08)
    paint = materials.paints[int(rng.integers(len(materials.paints)))]
    tint = float(rng.uniform(0.85, 1.2))
    points = [(x * stretch, z * rise) for x, z, _ in profile]
    waist = max(points[2][1], points[5][1])
    lean = 0.07 if profile is _VAN else 0.22

    def half_width(z: float) -> float:
        return 0.86 - max(0.0, z - waist) * lean  # the cabin leans in

    for k in range(len(points) - 1):
        (x0, z0), (x1, z1) = points[k], points[k + 1]
        a, b = half_width(z0), half_width(z1)
        corners = [(x0, -a, z0), (x0, a, z0), (x1, b, z1), (x1, -b, z1)]
        material, flags = (
            (materials.glass, SurfaceFlag.GLASS) if profile[k][2] else (paint, SurfaceFlag.PLAIN)
        )
        builder.quad(corners, _SQUARE, material, kind, flags, 1.0 if profile[k][2] else tint)
    _add_sides(builder, materials, points, half_width(points[3][1]), paint, tint, kind, waist)
    _add_wheels(builder, materials, points, kind)
    _add_lights(builder, materials, points, kind, rng)
    return builder.build()


def _add_sides(
    builder: MeshBuilder,
    materials: Materials,
    points: list[tuple[float, float]],
    roof_half_m: float,
    paint: int,
    tint: float,
    kind: Kind,
    waist: float,
) -> None:
    front, nose, screen, roof, back, boot, tail, rear = points
    for side in (-1.0, 1.0):

        def put(
            outline: list[tuple[float, float, float]],
            texture: int,
            flags: SurfaceFlag,
            side: float = side,
        ) -> None:
            corners = [(x, side * y, z) for x, y, z in outline]
            order = corners if side < 0 else corners[::-1]
            builder.quad(order, _SQUARE, texture, kind, flags, tint if texture == paint else 1.0)

        low = min(front[1], rear[1])
        body = 0.86
        # From the rear to the front, seen from the right-hand side (y < 0).
        put(
            [
                (rear[0], body, low),
                (front[0], body, low),
                (nose[0], body, nose[1]),
                (tail[0], body, tail[1]),
            ],
            paint,
            SurfaceFlag.PLAIN,
        )
        put(
            [
                (tail[0], body, tail[1]),
                (nose[0], body, nose[1]),
                (screen[0], body, screen[1]),
                (boot[0], body, boot[1]),
            ],
            paint,
            SurfaceFlag.PLAIN,
        )
        cabin = [
            (boot[0], body, boot[1]), (screen[0], body, screen[1]),
            (roof[0], roof_half_m, roof[1]), (back[0], roof_half_m, back[1]),
        ]  # fmt: skip
        put(cabin, paint, SurfaceFlag.PLAIN)
        if back[0] < -2:  # a van: only the door has a window
            put(
                [(0.75, 0.85, waist), (1.55, 0.85, waist), (1.25, 0.74, 1.75), (0.8, 0.74, 1.75)],
                materials.glass,
                SurfaceFlag.GLASS,
            )
            continue
        middle = np.mean(cabin, axis=0)
        for share in (0.0, 1.0):  # two windows, a little outside the paint
            window = [np.asarray(p) * 0.86 + middle * 0.14 for p in cabin]
            half_low = (window[0] + window[1]) / 2
            half_high = (window[2] + window[3]) / 2
            gap = np.array([0.05, 0, 0])
            pane = (
                [window[0], half_low - gap, half_high - gap, window[3]]
                if share == 0
                else [half_low + gap, window[1], window[2], half_high + gap]
            )
            put(
                [(float(p[0]), float(p[1]) + 0.02, float(p[2])) for p in pane],
                materials.glass,
                SurfaceFlag.GLASS,
            )


def _add_wheels(
    builder: MeshBuilder, materials: Materials, points: list[tuple[float, float]], kind: Kind
) -> None:
    low = min(points[0][1], points[7][1])
    # A dark floor keeps the light from shining through below.
    floor = [(points[7][0], 0.8, 0.2), (points[0][0], 0.8, 0.2)]
    floor += [(points[0][0], -0.8, 0.2), (points[7][0], -0.8, 0.2)]
    builder.quad(floor, _SQUARE, materials.rubber, kind, SurfaceFlag.TWO_SIDED)
    for side in (-1.0, 1.0):
        skirt = [(points[7][0], side * 0.8, 0.2), (points[0][0], side * 0.8, 0.2)]
        skirt += [(points[0][0], side * 0.86, low), (points[7][0], side * 0.86, low)]
        order = skirt if side < 0 else skirt[::-1]
        builder.quad(order, _SQUARE, materials.rubber, kind, SurfaceFlag.TWO_SIDED)
    for end in (points[0][0], points[7][0]):
        apron = [(end, -0.8, 0.2), (end, 0.8, 0.2), (end, 0.86, low), (end, -0.86, low)]
        builder.quad(apron, _SQUARE, materials.rubber, kind, SurfaceFlag.TWO_SIDED)
    for x in (points[0][0] * 0.64, points[7][0] * 0.64):
        for side in (-1.0, 1.0):
            add_wheel(builder, materials, (x, side * 0.885, 0.31), 0.31, kind)
            add_wheel(builder, materials, (x, side * 0.89, 0.31), 0.17, kind, materials.metal)


def add_wheel(
    builder: MeshBuilder,
    materials: Materials,
    centre: tuple[float, float, float],
    radius_m: float,
    kind: Kind,
    texture: int | None = None,
) -> None:
    """A disc across y, as three quads of an octagon, seen from both sides."""
    angle = np.pi / 8 + np.arange(8) * np.pi / 4
    rim = np.stack(
        [
            centre[0] + radius_m * np.cos(angle),
            np.full(8, centre[1]),
            centre[2] + radius_m * np.sin(angle),
        ],
        axis=1,
    )
    for a, b, c, d in ((0, 1, 2, 3), (0, 3, 4, 7), (4, 5, 6, 7)):
        builder.quad(
            rim[[a, b, c, d]],
            _SQUARE,
            materials.rubber if texture is None else texture,
            kind,
            SurfaceFlag.TWO_SIDED,
        )


def _add_lights(
    builder: MeshBuilder,
    materials: Materials,
    points: list[tuple[float, float]],
    kind: Kind,
    rng: np.random.Generator,
) -> None:
    on = 1.0 if kind is Kind.MOVING else 0.0
    nose, tail = points[1], points[6]
    for side in (-1.0, 1.0):
        x = nose[0] + 0.015
        light = [(x, side * 0.62 - 0.14, 0.5), (x, side * 0.62 + 0.14, 0.5)]
        light += [(x, side * 0.62 + 0.14, 0.64), (x, side * 0.62 - 0.14, 0.64)]
        builder.quad(light, _SQUARE, materials.light, kind, SurfaceFlag.GLASS, 0.7, 9.0 * on)
        x = tail[0] - 0.06
        light = [(x, side * 0.68 + 0.12, 0.68), (x, side * 0.68 - 0.12, 0.68)]
        light += [(x, side * 0.68 - 0.12, 0.84), (x, side * 0.68 + 0.12, 0.84)]
        builder.quad(light, _SQUARE, materials.light, kind, SurfaceFlag.GLASS, 0.25, 1.2 * on)
    plate_texture = materials.plates[int(rng.integers(len(materials.plates)))]
    for x, turn in ((points[0][0] + 0.06, 1.0), (points[7][0] - 0.06, -1.0)):
        plate = [
            (x, -0.26 * turn, 0.42),
            (x, 0.26 * turn, 0.42),
            (x, 0.26 * turn, 0.53),
            (x, -0.26 * turn, 0.53),
        ]
        builder.quad(plate, _SQUARE, plate_texture, kind)


def pedestrian(materials: Materials, rng: np.random.Generator, stride: float = 0.0) -> Mesh:
    """A person of boxes; stride −1…1 swings legs and arms."""
    builder = MeshBuilder()
    tall = rng.uniform(0.92, 1.08)
    coat = materials.paints[int(rng.integers(len(materials.paints)))]
    legs = materials.paints[int(rng.integers(3))]

    def limb(
        at: tuple[float, float, float],
        half: tuple[float, float, float],
        texture: int,
        lean: float = 0.0,
    ) -> None:
        s, c = np.sin(lean), np.cos(lean)
        axes = np.array(
            [[half[0] * c, 0, -half[0] * s], [0, half[1], 0], [half[2] * s, 0, half[2] * c]]
        )
        builder.box(
            np.array(at) * tall, axes * tall, texture, Kind.MOVING, per_m=0.6, faces="ewnstd"
        )

    for side in (-1.0, 1.0):
        swing = 0.45 * stride * side
        limb((0.4 * np.sin(-swing) * 0.5, side * 0.09, 0.43), (0.075, 0.07, 0.43), legs, -swing)
        limb((0.3 * np.sin(swing) * 0.5, side * 0.25, 1.13), (0.05, 0.05, 0.31), coat, swing)
    limb((0, 0, 1.15), (0.12, 0.19, 0.31), coat)
    limb((0.01, 0, 1.6), (0.1, 0.085, 0.13), materials.stone)
    return builder.build()


def cyclist(materials: Materials, rng: np.random.Generator) -> Mesh:
    """A rider on a bicycle."""
    builder = MeshBuilder()
    for x in (-0.52, 0.52):
        add_wheel(builder, materials, (x, 0.0, 0.34), 0.34, Kind.MOVING)
        add_wheel(builder, materials, (x, 0.012, 0.34), 0.29, Kind.MOVING, materials.metal)
        add_wheel(builder, materials, (x, -0.012, 0.34), 0.29, Kind.MOVING, materials.metal)
    for at, half in (
        ((0, 0, 0.62), (0.42, 0.025, 0.03)),
        ((-0.15, 0, 0.75), (0.02, 0.02, 0.2)),
        ((0.45, 0, 0.8), (0.02, 0.22, 0.25)),
    ):
        builder.box(np.array(at), np.diag(half), materials.metal, Kind.MOVING, faces="ewnst")
    rider = pedestrian(materials, rng, 0.8)
    lifted = rider.moved((-0.1, 0.0, 0.18), 0.0)
    return Mesh.joined([builder.build(), lifted])


RECESS_M = 0.16  # of panes and doors behind the wall
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """The vertical plane of a front.

    Attributes:
        corner: (3,) its lower left corner seen from the street, metres.
        along: (3,) unit vector to the right, level.
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
