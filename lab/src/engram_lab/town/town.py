"""A town to drive in: blocks of houses, parks and squares, made tile by tile from a seed.

A tile is one block with the pavement around it and the streets on its south and west sides. What
is permanent (`build_tile`) is kept apart from what the season changes and from what is only
there today, so that a day's drive rebuilds only what differs.

What moves while one drives: cars ahead and oncoming, cyclists, people on the pavements. Everything
is a function of time and of how far the robot is, so that a frame can be made without those before
it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram_lab import _town
from engram_lab.town.drive import Line, closed_line, driving_line
from engram_lab.town.furniture import (
    Foliage,
    Front,
    Materials,
    add_bench,
    add_fence,
    add_front,
    add_hedge,
    add_lamp,
    add_post,
    add_shell,
    add_sign,
    add_stall,
    add_tree,
    car,
    cyclist,
    pedestrian,
    shared_materials,
)
from engram_lab.town.mesh import Kind, Mesh, MeshBuilder, SurfaceFlag
from engram_lab.town.streets import (
    Alteration,
    AlterationKind,
    Fronts,
    Junction,
    Points,
    Route,
    StreetPlan,
    Unique,
)
from engram_lab.town.textures import Facade, NoiseFields, Style, carriageway, facade, pavement

_SEEN_M = 75.0
_MODELS = 6
_STRIDES = 4
# To the middle of a car that the robot queues behind: it hides half of the lower picture.
_QUEUED_M = 5.2


@dataclass(frozen=True, slots=True, eq=False)
class Cast:
    """The models that a town's traffic is made of."""

    cars: tuple[Mesh, ...]
    cyclists: tuple[Mesh, ...]
    pedestrians: tuple[tuple[Mesh, ...], ...]

    @staticmethod
    def of_seed(materials: Materials, seed: int) -> Cast:
        """Some of each kind."""
        rng = np.random.default_rng([seed, 0xCA57])
        strides = np.linspace(-1, 1, _STRIDES)
        people = []
        for _ in range(_MODELS):
            looks = int(rng.integers(2**32))
            people.append(
                tuple(
                    pedestrian(materials, np.random.default_rng(looks), float(stride))
                    for stride in strides
                )
            )
        return Cast(
            tuple(car(materials, rng, Kind.MOVING) for _ in range(_MODELS)),
            tuple(cyclist(materials, rng) for _ in range(_MODELS)),
            tuple(people),
        )


@dataclass(frozen=True, slots=True)
class _Mover:
    """Something that goes round a line at a steady speed."""

    line: int
    start_m: float
    speed_m_s: float
    aside_m: float
    model: int


class Life:
    """The moving things of one session.

    Args:
        cast: models.
        plan: streets.
        route: that is driven.
        line: that the robot drives.
        reverse: whether it drives the other way round.
        traffic: how much moves, 0…1.
        seed: of the session.
    """

    def __init__(
        self, cast: Cast, plan: StreetPlan, route: Route, line: Line, reverse: bool,
        traffic: float, seed: int,
    ) -> None:  # fmt: skip
        rng = np.random.default_rng([seed & 0x7FFFFFFF, 0x11FE])
        self._cast = cast
        self._own = line
        self._oncoming = driving_line(plan, route, not reverse)
        self._traffic = traffic
        self._lead_phase = rng.uniform(0, 2 * np.pi, 2)
        self._lead_model = int(rng.integers(_MODELS))
        length = self._oncoming.length_m
        self._cars = [
            _Mover(0, rng.uniform(0, length), rng.uniform(5, 9), rng.uniform(-0.15, 0.15), k)
            for k in range(rng.poisson(traffic * length / 90))
        ]
        self._cyclists = [
            _Mover(0, rng.uniform(0, length), rng.uniform(3.5, 5.5), rng.uniform(0.7, 1.0), k)
            for k in range(rng.poisson(traffic * length / 160))
        ]
        self._walks = _walks(plan, route)
        self._people = [
            _Mover(
                which, rng.uniform(0, walk.length_m), rng.choice([-1, 1]) * rng.uniform(0.9, 1.6),
                rng.uniform(-0.5, 0.5), int(rng.integers(_MODELS)),
            )
            for which, walk in enumerate(self._walks)
            for _ in range(rng.poisson(traffic * walk.length_m / 28))
        ]  # fmt: skip

    def around(self, position: NDArray[np.float64], driven_m: float, elapsed_s: float) -> Mesh:
        """All that moves within sight of a point (2,)."""
        parts = self._lead(driven_m)
        for mover in self._cars:
            model = self._cast.cars[mover.model % _MODELS]
            parts += self._placed(mover, self._oncoming, model, position, elapsed_s, 0.0)
        for mover in self._cyclists:
            model = self._cast.cyclists[mover.model % _MODELS]
            parts += self._placed(mover, self._oncoming, model, position, elapsed_s, 0.0)
        for mover in self._people:
            # A stride of two steps takes about 1.4 m.
            phase = abs(mover.speed_m_s) * elapsed_s / 1.4 + mover.start_m
            stride = round((0.5 - 0.5 * np.cos(2 * np.pi * phase)) * (_STRIDES - 1))
            model = self._cast.pedestrians[mover.model][stride]
            walk = self._walks[mover.line]
            parts += self._placed(mover, walk, model, position, elapsed_s, 0.12)
        return Mesh.joined(parts)

    def _lead(self, driven_m: float) -> list[Mesh]:
        """A car ahead, which falls back and draws away out of sight in turns."""
        waves = np.sin(driven_m / np.array([140.0, 95.0]) + self._lead_phase).sum() / 2
        gap_m = _QUEUED_M + 75.0 * float(np.clip(0.95 - 0.75 * self._traffic + 0.8 * waves, 0, 1.2))
        if gap_m > _SEEN_M:
            return []
        where, heading, _ = self._own.at(driven_m + gap_m)
        return [self._cast.cars[self._lead_model].moved([*where, 0.0], heading)]

    def _placed(
        self, mover: _Mover, line: Line, model: Mesh, position: NDArray[np.float64],
        elapsed_s: float, height_m: float,
    ) -> list[Mesh]:  # fmt: skip
        where, heading, _ = line.at(mover.start_m + mover.speed_m_s * elapsed_s)
        if np.hypot(*(where - position)) > _SEEN_M:
            return []
        heading += np.pi if mover.speed_m_s < 0 else 0.0
        left = np.array([-np.sin(heading), np.cos(heading)])
        return [model.moved([*(where + mover.aside_m * left), height_m], heading)]


def _walks(plan: StreetPlan, route: Route) -> list[Line]:
    """The ways round the blocks on both sides of the route, along the middle of the pavement."""
    blocks = set()
    for (i, j), (k, _) in route.streets():
        blocks |= {(i, j), (i, j - 1)} if k > i else {(i, j), (i - 1, j)}
    return [closed_line(plan.block_outline(block, 1.5), 0.6) for block in sorted(blocks)]


KERB_M = 0.12
_UP = np.array([0.0, 0.0, 1.0])
_COARSE_PER_M = 20  # texels of fronts that are only seen from afar
_POOL = 16  # distinct coarse fronts
_DEPTH_M = 8.5  # of terraced houses
_PAVEMENT_M = 2.6  # where all are alike
_BEHIND = 0.3  # how fast an end wall falls back behind the fronts round the corner, metres a metre
_REBUILDS = 4  # of so many repainted fronts one is rebuilt
_SHARED_STREET_M = 24.0  # after which the tarmac of side streets repeats


@dataclass(frozen=True, slots=True)
class Today:
    """What is there on one day only, and in one season.

    Attributes:
        day: number of the day, seeds what is parked and set up.
        hour: local hour, decides how many are parked and whether the market is on.
        season: 0 leaves, 1 autumn, 2 bare.
        parked_share: of the parking places taken, 0…1.
        alterations: structural changes in force.
        leaves: share of the leaves that are out.
    """

    day: int
    hour: float
    season: int
    parked_share: float
    alterations: frozenset[Alteration] = frozenset()
    leaves: float = 1.0


@dataclass(slots=True, eq=False)
class Tile:
    """What the renderer holds of a block."""

    block: Junction
    lamps: NDArray[np.float32]
    meshes: list[int] = field(default_factory=list)
    textures: list[int] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One of the twelve straight stretches around a block."""

    start: Junction
    end: Junction
    kerb: tuple[Points, Points]
    front: tuple[Points, Points]

    @property
    def along(self) -> Points:
        step = self.front[1] - self.front[0]
        return np.asarray(step / np.linalg.norm(step))

    @property
    def outwards(self) -> Points:
        return np.array([self.along[1], -self.along[0]])

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(self.front[1] - self.front[0]))


def _slide_m(side: _Side, other: _Side, depth_m: float) -> float:
    """How far along the front the back corner of a side's end house moves.

    So that its end wall stays behind the other side's fronts, which begin at the same corner of
    the block; else that wall would hide their windows and their balconies stick out of it.
    """
    across = float(side.along @ other.outwards)
    over = _BEHIND - float(side.outwards @ other.outwards)
    return -depth_m * over / across if abs(across) > 0.3 and over > 0 else 0.0


def _row_widths(rng: np.random.Generator, period_m: float) -> list[float]:
    """Widths of houses side by side that fill a period, metres."""
    shares = rng.uniform(6.2, 10.0, max(1, round(period_m / 8.0)))
    return [float(width) for width in shares * period_m / shares.sum()]


def _level(point: Points, height_m: float = KERB_M) -> Points:
    return np.array([point[0], point[1], height_m])


def _hand_over(scene: _town.Scene, mesh: Mesh) -> int:
    return scene.add_mesh(
        mesh.vertices, mesh.uv, mesh.textures, mesh.flags, mesh.tint, mesh.glow, mesh.kinds
    )


class Tenant(Protocol):
    """Who has tiles in the scene; there is one at a time, since two days do not mix."""

    def leave(self) -> None:
        """Takes them out."""
        ...


class Town:
    """Makes tiles and keeps them in a renderer's scene.

    Args:
        plan: where streets run.
        route: what will be driven; fronts along it are fine and each one unique.
        style: of the textures.
    """

    def __init__(self, plan: StreetPlan, route: Route, style: Style) -> None:
        self.plan = plan
        self.route = route
        self.style = style
        self.noise = NoiseFields.of_seed(plan.seed)
        self.scene = _town.Scene(self.noise.tile())
        self.tenant: Tenant | None = None  # whose tiles the scene holds
        self.materials: Materials = shared_materials(self.scene, self.noise, style, plan.seed)
        self.cast = Cast.of_seed(self.materials, plan.seed)
        self._driven = set(route.streets())
        near = {
            (a + i, b + j)
            for a, b in route.all_junctions()
            for i in range(-3, 3)
            for j in range(-3, 3)
        }
        self._blocks = np.array(sorted(near))  # that are built at all
        self._pool = [
            facade(
                np.random.default_rng([plan.seed, 0xF00, k]), self.noise, style,
                7.0 + 0.25 * k, 7.6 + 3.1 * (k % 3), _COARSE_PER_M,
            )
            for k in range(_POOL)
        ]  # fmt: skip
        self._pool_textures = [self.scene.add_texture(front.texels) for front in self._pool]
        rng = np.random.default_rng([plan.seed, 0x57])
        self._tarmac = self.scene.add_texture(
            carriageway(rng, self.noise, style, 10.0, _SHARED_STREET_M, crossing=False)
        )
        self._slabs = self.scene.add_texture(pavement(rng, self.noise, style, 3.0, 9.0))
        self._add_country()

    def _add_country(self) -> None:
        """Meadows to the horizon, below everything else."""
        builder = MeshBuilder()
        middle = np.mean([self.plan.junction(at) for at in self.route.all_junctions()], axis=0)
        corners = [middle + 3000.0 * np.array(c) for c in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        uv = [tuple(c / 40) for c in corners]
        flat = [_level(c, -0.06) for c in corners]
        builder.quad(flat, uv, self.materials.grass, Kind.GROUND, SurfaceFlag.NO_SHADOW)
        _hand_over(self.scene, builder.build())

    def blocks_near(self, position: Points, reach_m: float) -> list[Junction]:
        """Blocks whose middle is within reach of a point (2,), nearest first."""
        spacing = self.plan.spacing_m
        away_m = np.hypot(*((self._blocks + 0.5) * spacing - np.asarray(position)[:2]).T)
        nearest = np.lexsort((self._blocks[:, 1], self._blocks[:, 0], away_m))
        near = nearest[away_m[nearest] < reach_m + 0.7 * spacing]
        return [(int(i), int(j)) for i, j in self._blocks[near]]

    def build_tile(self, block: Junction, today: Today) -> Tile:
        """Builds a block as it is today and hands it to the scene."""
        return _TileBuilder(self, block, today).build()

    def drop_tile(self, tile: Tile) -> None:
        """Takes a block out of the scene."""
        for mesh in tile.meshes:
            self.scene.remove_mesh(mesh)
        for texture in tile.textures:
            self.scene.remove_texture(texture)

    def is_driven(self, start: Junction, end: Junction) -> bool:
        """Whether the route runs along a street."""
        return (min(start, end), max(start, end)) in self._driven


class _TileBuilder:
    """Collects one block's surfaces."""

    def __init__(self, town: Town, block: Junction, today: Today) -> None:
        self.town, self.block, self.today = town, block, today
        self.plan, self.materials = town.plan, town.materials
        self.rng = town.plan.rng("block", block)
        self.daily = np.random.default_rng(
            [
                town.plan.seed,
                today.day,
                int(today.hour // 3),
                block[0] + 100_000,
                block[1] + 100_000,
            ]
        )
        self._foliage = Foliage(today.season, today.leaves)
        self.solid, self.green = MeshBuilder(), MeshBuilder()
        self.parts: list[Mesh] = []
        self.lamps: list[tuple[float, ...]] = []
        self.textures: list[int] = []

    def build(self) -> Tile:
        """All parts, in a fixed order so that the same seed gives the same block."""
        pavement_m = 2.4 if self.plan.spacing_m < 45 else float(self.rng.choice([2.6, 3.2]))
        if self.plan.fronts is not None and Unique.ROAD not in self.plan.fronts.unique:
            pavement_m = _PAVEMENT_M
        kerb = self.plan.block_outline(self.block, 0.0)
        front = self.plan.block_outline(self.block, pavement_m)
        sides = self._sides(kerb, front)
        if self.plan.fronts is not None:
            return self._build_estate(self.plan.fronts, kerb, front, pavement_m)
        self._add_carriageways()
        self._add_pavement(sides, pavement_m)
        character = self.plan.rng("use", self.block).random()
        if character < 0.68:
            self._add_terrace(sides, front)
        elif character < 0.82:
            self._add_villas(sides, front)
        elif character < 0.92:
            self._add_park(sides, front)
        else:
            self._add_square(front)
        self._add_street_things(sides)
        self._park_cars(sides)
        return self._hand_over()

    def _build_estate(self, fronts: Fronts, kerb: Points, front: Points, pavement_m: float) -> Tile:
        """A block of an estate: each subject draws from a generator of its own."""
        sides = self._sides(kerb, front)
        self.rng = self._drawing(fronts, Unique.ROAD)
        self._add_carriageways()
        self._add_pavement(sides, pavement_m)
        self._add_rows(fronts, kerb, front)
        self.rng = self._drawing(fronts, Unique.THINGS)
        self._add_street_things(sides)
        self.rng = self._drawing(fronts, Unique.CARS)
        self._park_cars(sides)
        return self._hand_over()

    def _drawing(self, fronts: Fronts, subject: Unique) -> np.random.Generator:
        """What draws a subject: the block's own generator where it is unique."""
        return self.plan.rng(subject, *([self.block] if subject in fronts.unique else []))

    def _add_rows(self, fronts: Fronts, kerb: Points, front: Points) -> None:
        """Fronts along all four sides, the same after each period."""
        self._add_lawn(front, self.materials.grass, 0.2)
        corners = [(kerb[k], front[k]) for k in (0, 3, 6, 9)]
        junctions = [side.start for side in self._sides(kerb, front)[::3]]
        own = self.plan.rng("fronts", self.block)
        widths = _row_widths(self.plan.rng("widths"), fronts.period_m)
        for k in range(4):
            (kerb_a, a), (kerb_b, b) = corners[k], corners[(k + 1) % 4]
            side = _Side(junctions[k], junctions[(k + 1) % 4], (kerb_a, kerb_b), (a, b))
            at, number = 0.0, 0
            while side.length_m - at > 4.0:
                kind = number % len(widths)
                width = min(widths[kind], side.length_m - at)
                copied = own.random() < fronts.equal
                self.rng = self.plan.rng("row", (kind, 0)) if copied else own
                self._add_house(side, at, width, 0.0, _DEPTH_M)
                at, number = at + width, number + 1

    def _hand_over(self) -> Tile:
        scene = self.town.scene
        tile = Tile(self.block, np.array(self.lamps, dtype=np.float32).reshape(-1, 3))
        for mesh in (self.solid.build(), self.green.build(), Mesh.joined(self.parts)):
            if len(mesh):
                tile.meshes.append(_hand_over(scene, mesh))
        tile.textures = self.textures
        return tile

    def _sides(self, kerb: Points, front: Points) -> list[_Side]:
        i, j = self.block
        corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        return [
            _Side(
                corners[k // 3], corners[(k // 3 + 1) % 4],
                (kerb[k], kerb[(k + 1) % 12]), (front[k], front[(k + 1) % 12]),
            )
            for k in range(12)
        ]  # fmt: skip

    def _texture(self, texels: NDArray[np.uint8]) -> int:
        self.textures.append(self.town.scene.add_texture(texels))
        return self.textures[-1]

    # The ground.

    def _add_carriageways(self) -> None:
        i, j = self.block
        self._add_street((i, j), (i + 1, j), below=(i, j - 1), first_side=0)
        self._add_street((i, j), (i, j + 1), below=(i - 1, j), first_side=9)
        self._add_junction()

    def _add_street(self, start: Junction, end: Junction, below: Junction, first_side: int) -> None:
        """Tarmac between this block's kerb and that of the block across the street."""
        here = self.plan.block_outline(self.block, 0.0)
        across = self.plan.block_outline(below, 0.0)
        width = 2 * self.plan.half_width_m(start, end)
        centre = self.plan.centreline(start, end)
        if first_side == 0:  # south side: left of the drive eastwards
            left, right = [here[k] for k in (0, 1, 2, 3)], [across[k] for k in (9, 8, 7, 6)]
        else:  # west side: right of the drive northwards
            left, right = [across[k] for k in (3, 4, 5, 6)], [here[k % 12] for k in (12, 11, 10, 9)]
        length = float(np.linalg.norm(np.diff(centre, axis=0), axis=1).sum())
        if self.town.is_driven(start, end):
            crossing = self.rng.random() < 0.5
            texture = self._texture(
                carriageway(self.rng, self.town.noise, self.town.style, width, length, crossing)
            )
            size = np.array([width, length])
        else:
            texture, size = self.town._tarmac, np.array([width, _SHARED_STREET_M])
        driven_m = 0.0
        for k in range(3):
            along = centre[k + 1] - centre[k]
            step_m = float(np.linalg.norm(along))
            along = along / step_m
            aside = np.array([along[1], -along[0]])
            corners = [right[k], right[k + 1], left[k + 1], left[k]]
            uv = [
                (0.5 + (c - centre[k]) @ aside / size[0],
                 1 - (driven_m + (c - centre[k]) @ along) / size[1])
                for c in corners
            ]  # fmt: skip
            self.solid.quad(
                [_level(c, 0.0) for c in corners], uv, texture, Kind.GROUND, SurfaceFlag.ROAD
            )
            driven_m += step_m

    def _add_junction(self) -> None:
        """The crossing at this block's south-west corner."""
        i, j = self.block
        around = [((i - 1, j - 1), 6), ((i, j - 1), 9), ((i, j), 0), ((i - 1, j), 3)]
        corners = [self.plan.block_outline(block, 0.0)[k] for block, k in around]
        if any((i, j) in street for street in self.town.route.streets()):
            texels = carriageway(
                self.rng, self.town.noise, self.town.style, 14.0, 14.0, crossing=False, marked=False
            )
            texture, size = self._texture(texels), 14.0
        else:
            texture, size = self.town._tarmac, 40.0
        origin = self.plan.junction((i, j))
        uv = [tuple((c - origin) / size + 0.5) for c in corners]
        flat = [_level(c, 0.0) for c in corners]
        self.solid.quad(flat, uv, texture, Kind.GROUND, SurfaceFlag.CROSSROAD)

    def _add_pavement(self, sides: list[_Side], width_m: float) -> None:
        noise, style = self.town.noise, self.town.style
        for k, side in enumerate(sides):
            if k % 3 == 0:
                driven = self.town.is_driven(side.start, side.end)
                length = sum(s.length_m for s in sides[k : k + 3]) + 2 * width_m
                size = (width_m, length if driven else 9.0)
                texture = self.town._slabs
                if driven:
                    texture = self._texture(pavement(self.rng, noise, style, *size))
                walked_m = 0.0
            (a, b), (c, d) = side.kerb, side.front
            along = (b - a) / np.linalg.norm(b - a)
            inwards = np.array([-along[1], along[0]])
            corners = [a, b, d, c]
            uv = [
                ((p - a) @ inwards / size[0], (walked_m + (p - a) @ along) / size[1])
                for p in corners
            ]
            self.solid.quad([_level(p) for p in corners], uv, texture, Kind.GROUND)
            step_m = float(np.linalg.norm(b - a))
            walked_m += step_m
            top = [(0.0, 0.03), (step_m / 4, 0.03), (step_m / 4, 0.0), (0.0, 0.0)]
            face = [_level(a, 0.0), _level(b, 0.0), _level(b), _level(a)]
            self.solid.quad(face, top, self.materials.stone, Kind.GROUND)

    def _add_lawn(self, outline: Points, texture: int, per_m: float) -> None:
        """The inside of a block, from its middle out."""
        middle = outline.mean(axis=0)
        for k in range(12):
            corners = [outline[k], outline[(k + 1) % 12], middle, middle]
            uv = [tuple(c * per_m) for c in corners]
            self.solid.quad([_level(c) for c in corners], uv, texture, Kind.GROUND)

    # Buildings.

    def _add_terrace(self, sides: list[_Side], front: Points) -> None:
        self._add_lawn(front, self.materials.grass, 0.2)
        for number, side in enumerate(sides):
            before = _slide_m(side, sides[number - 1], _DEPTH_M)
            after = _slide_m(side, sides[(number + 1) % len(sides)], _DEPTH_M)
            at = 0.0
            while side.length_m - at > 4.0:
                width = min(float(self.rng.uniform(6.2, 10.0)), side.length_m - at)
                if side.length_m - at - width < 4.0:
                    width = side.length_m - at
                setback = float(self.rng.choice([0, 0, 0.2, 0.45]))
                first, last = at == 0, side.length_m - at - width < 2.3
                slides = (before if first else 0.0, max(after, 0.5 - width) if last else 0.0)
                if any(slides):
                    setback = 0.0  # or the house round the corner would stand before this one
                self._add_house(side, at, width, setback, _DEPTH_M, slides)
                gap = float(self.rng.choice([0, 0, 0, 0, 2.2]))
                at += width + gap

    def _add_villas(self, sides: list[_Side], front: Points) -> None:
        self._add_lawn(front, self.materials.grass, 0.2)
        for side in sides:
            if side.length_m > 10:
                width = float(self.rng.uniform(7.0, min(9.5, side.length_m - 2)))
                self._add_house(side, (side.length_m - width) / 2, width, 4.5, 7.5)
            self._edge_garden(side)

    def _edge_garden(self, side: _Side) -> None:
        a, b = (_level(p) for p in side.front)
        inwards = np.array([-side.outwards[0], -side.outwards[1], 0.0])
        if not self.town.is_driven(side.start, side.end):
            return
        if self.rng.random() < 0.5:
            tall = float(self.rng.uniform(0.8, 1.6))
            add_hedge(
                self.green, self.materials, a + 0.4 * inwards, b + 0.4 * inwards, tall, self.rng
            )
        else:
            add_fence(self.solid, self.materials, a + 0.1 * inwards, b + 0.1 * inwards)
        for share in (0.15, 0.85):
            if self.rng.random() < 0.5:
                foot = a + (b - a) * share + 2.3 * inwards
                add_tree(self.solid, self.green, self.materials, foot, self._foliage, self.rng)

    def _add_house(
        self, side: _Side, at_m: float, width_m: float, setback_m: float, depth_m: float,
        slides_m: tuple[float, float] = (0.0, 0.0),
    ) -> None:  # fmt: skip
        corner = side.front[0] + side.along * at_m - side.outwards * setback_m
        roof = self.materials.roof
        if not self.town.is_driven(side.start, side.end):
            k = int(self.rng.integers(_POOL))
            self._add_coarse_house(side, corner, width_m, depth_m, k, slides_m)
            return
        storeys = int(self.rng.integers(1, 4))
        height = 3.6 + 3.1 * storeys + float(self.rng.uniform(0.6, 1.2))
        texels = facade(self.rng, self.town.noise, self.town.style, width_m, height)
        house = (self.block, len(self.textures))
        if self._rebuilt(house):  # from a generator of its own: the next houses stay as they are
            own = np.random.default_rng([self.plan.seed, 0x8E8, house[1], *np.abs(self.block)])
            texels = facade(own, self.town.noise, self.town.style, width_m, height)
        tint = self._repainted(house)
        plane = Front(
            _level(corner), np.array([*side.along, 0.0]), self._texture(texels.texels),
            self.materials.stone, tint,
        )  # fmt: skip
        add_front(self.solid, plane, texels, self.rng)
        add_shell(self.solid, plane, width_m, height, depth_m, roof, self.rng, slides_m)
        if self._altered(house, AlterationKind.SCAFFOLD):
            self._add_scaffold(plane, texels)

    def _add_coarse_house(
        self, side: _Side, corner: Points, width_m: float, depth_m: float, k: int,
        slides_m: tuple[float, float],
    ) -> None:  # fmt: skip
        front = self.town._pool[k]
        plane = Front(
            _level(corner), np.array([*side.along, 0.0]), self.town._pool_textures[k],
            self.materials.stone, float(self.rng.uniform(0.8, 1.2)),
        )  # fmt: skip
        uv = [(0, 1), (1, 1), (1, 0), (0, 0)]
        self.solid.quad(
            plane.rectangle(0, width_m, 0, front.height_m, 0.0), uv, plane.texture, Kind.BUILDING,
            SurfaceFlag.GLASS, plane.tint,
        )  # fmt: skip
        add_shell(
            self.solid, plane, width_m, front.height_m, depth_m, self.materials.roof, self.rng,
            slides_m,
        )  # fmt: skip

    def _altered(self, house: tuple[Junction, int], kind: AlterationKind) -> bool:
        return any(a.kind is kind and a.chooses(*house) for a in self.today.alterations)

    def _rebuilt(self, house: tuple[Junction, int]) -> bool:
        """Whether works have changed a front."""
        return any(
            a.kind is AlterationKind.REPAINT and a.number % _REBUILDS == 0 and a.chooses(*house)
            for a in self.today.alterations
        )

    def _repainted(self, house: tuple[Junction, int]) -> float:
        tint = float(self.rng.uniform(0.85, 1.15))
        for alteration in sorted(self.today.alterations, key=lambda a: a.number):
            if alteration.kind is AlterationKind.REPAINT and alteration.chooses(*house):
                tint *= 0.55 if alteration.number % 2 else 1.6
        return tint

    def _add_scaffold(self, plane: Front, front: Facade) -> None:
        posts = max(2, int(front.width_m / 2.2))
        builder = MeshBuilder()
        for k in range(posts + 1):
            u = front.width_m * k / posts
            for out_m in (0.35, 1.25):
                foot = plane.at(u, 0, out_m)
                add_post(builder, foot, front.height_m, 0.03, self.materials.metal, Kind.TEMPORARY)
        for storey in range(int(front.height_m // 2.1)):
            centre = plane.at(front.width_m / 2, 2.1 * (storey + 1), 0.8)
            axes = [plane.along * front.width_m / 2, -plane.outwards * 0.5, _UP * 0.025]
            builder.box(centre, axes, self.materials.bark, Kind.TEMPORARY, faces="ewnstd", tint=1.5)
        self.parts.append(builder.build())

    # Open places.

    def _add_park(self, sides: list[_Side], front: Points) -> None:
        self._add_lawn(front, self.materials.grass, 0.2)
        middle = front.mean(axis=0)
        for side in sides:
            a, b = (_level(p) for p in side.front)
            add_fence(self.solid, self.materials, a, b)
        for _ in range(int(self.plan.spacing_m / 4)):
            target = front[int(self.rng.integers(12))]
            foot = _level(middle + (target - middle) * self.rng.uniform(0.2, 0.88))
            add_tree(self.solid, self.green, self.materials, foot, self._foliage, self.rng)

    def _add_square(self, front: Points) -> None:
        self._add_lawn(front, self.town._slabs, 1 / 3)
        middle = front.mean(axis=0)
        market = 8 <= self.today.hour <= 15 and self.today.day % 7 in {2, 5}
        for k in range(12):
            at = _level(middle + (front[k] - middle) * 0.8)
            along = front[(k + 1) % 12] - front[k]
            direction = np.array([*(along / np.linalg.norm(along)), 0.0])
            has_bench = self.rng.random() < 0.4  # drawn on market days too: the rest must not shift
            if market and self.daily.random() < 0.7:
                builder = MeshBuilder()
                add_stall(builder, self.materials, at, direction, self.daily)
                self.parts.append(builder.build())
            elif has_bench:
                add_bench(self.solid, self.materials, at, direction)

    # Along the kerb.

    def _add_street_things(self, sides: list[_Side]) -> None:
        for number, side in enumerate(sides):
            towards_road = np.array([*side.outwards, 0.0])
            detailed = self.town.is_driven(side.start, side.end)
            a, b = (_level(p) for p in side.kerb)
            length = float(np.linalg.norm(b - a))
            if length > 7 and (number + number // 3) % 2 == 0:
                foot = a + (b - a) * 0.5 - 0.45 * towards_road
                self.lamps.append(tuple(add_lamp(self.solid, self.materials, foot, towards_road)))
            if not detailed:
                continue
            for share in np.arange(0.12, 0.95, 6.5 / max(length, 6.5)):
                self._add_one_thing(a + (b - a) * share - 0.75 * towards_road, side)

    def _add_one_thing(self, foot: Points, side: _Side) -> None:
        lot = self.rng.random()
        along = np.array([*side.along, 0.0])
        felled = any(
            a.kind is AlterationKind.FELLED and a.chooses(self.block, int(lot * 1000))
            for a in self.today.alterations
        )
        fresh = any(
            a.kind is AlterationKind.NEW_SIGN and a.chooses(self.block, int(lot * 1000))
            for a in self.today.alterations
        )
        # Each thing draws from its own generator: one that is gone changes none of the others.
        rng = np.random.default_rng(self.rng.integers(2**32))
        if lot < 0.3 and not felled:
            add_tree(self.solid, self.green, self.materials, foot, self._foliage, rng)
        elif 0.3 <= lot < 0.42 or fresh:
            add_sign(self.solid, self.materials, foot, along * rng.choice([-1, 1]), rng)
        elif 0.42 <= lot < 0.54:
            for k in range(3):
                add_post(
                    self.solid, foot + along * (1.2 * k - 1.2), 0.95, 0.07, self.materials.metal
                )
        elif 0.54 <= lot < 0.62:
            add_post(
                self.solid, foot, 0.95, 0.22, self.materials.metal, tint=float(rng.uniform(0.4, 2))
            )
        elif 0.62 <= lot < 0.68:
            add_bench(self.solid, self.materials, foot, along)

    def _park_cars(self, sides: list[_Side]) -> None:
        for side in sides:
            half_width = self.plan.half_width_m(side.start, side.end)
            if half_width < 4.4:  # no room
                continue
            a, b = side.kerb
            length = float(np.linalg.norm(b - a))
            outwards = np.array([side.along[1], -side.along[0]])
            for k in range(int((length - 3) // 5.6)):
                rng = self._who_parks()
                if rng is None:
                    continue
                at = a + side.along * (3.6 + 5.6 * k + rng.uniform(-0.4, 0.4))
                at = at + outwards * (1.0 + rng.uniform(-0.08, 0.15))
                turned = np.pi if rng.random() < 0.2 else 0.0
                heading = float(np.arctan2(side.along[1], side.along[0])) + turned
                heading += float(rng.normal(0, 0.02))
                self.parts.append(car(self.materials, rng).moved(_level(at, 0.0), heading))

    def _who_parks(self) -> np.random.Generator | None:
        """What draws the car in the next bay; None while it is free.

        Most bays have a neighbour's car, always the same, on four days of five; the others, and
        those that the neighbour left, are sometimes taken by anyone. About `parked_share` of all
        are taken.
        """
        home = np.random.default_rng(self.rng.integers(2**32))
        guest = np.random.default_rng(self.daily.integers(2**32))
        if home.random() < self.today.parked_share and guest.random() < 0.8:
            return home
        return guest if guest.random() < 0.5 * self.today.parked_share else None
