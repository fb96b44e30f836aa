"""Cars, vans, cyclists and pedestrians as small meshes around their own origin.

Each stands on z = 0 and faces east (+x); `Mesh.moved` puts it in its place.
"""

from __future__ import annotations

import numpy as np

from engram_lab.town.furniture import Materials
from engram_lab.town.mesh import Kind, Mesh, MeshBuilder, SurfaceFlag

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
