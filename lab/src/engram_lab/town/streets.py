"""The plan of a town: streets, routes, and how the town changes slowly.

Junctions stand near the points of a square grid; each street between two of them bends a little.
What lies between the streets are blocks. Everything follows from the seed and the grid indices
alone, so that any part of a town of any size can be made without the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, StrEnum

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError

Points = NDArray[np.float64]
Junction = tuple[int, int]
Street = tuple[Junction, Junction]  # the smaller first

_BENDS = 2  # points of a street between its junctions
_BLOCK_M = 75.0  # longest block of a town whose fronts repeat
_STRAIGHT_HALF_WIDTH_M = 4.6


class Unique(StrEnum):
    """What differs from street to street where the fronts do not."""

    ROAD = "road"
    THINGS = "things"
    CARS = "cars"

    @classmethod
    def named(cls, text: str) -> frozenset[Unique]:
        """Several, joined by commas."""
        names = [name for name in text.split(",") if name]
        for name in names:
            if name not in list(cls):
                raise ConfigError(f"unique part {name!r} is unknown; known: {', '.join(cls)}")
        return frozenset(map(cls, names))


@dataclass(frozen=True, slots=True)
class Fronts:
    """Fronts that repeat along straight streets, as in an estate.

    Attributes:
        period_m: way after which they do, metres.
        equal: share of the houses that are copies; the others are each unique.
        unique: what else is unique: tarmac and pavement, with its width; trees, signs and benches;
            parked cars. The rest is the same around each block.
    """

    period_m: float = 37.5
    equal: float = 1.0
    unique: frozenset[Unique] = frozenset(Unique)

    def __post_init__(self) -> None:
        if not 10 <= self.period_m <= _BLOCK_M:
            raise ConfigError(f"period is {self.period_m} m, must be 10 to {_BLOCK_M:g} m")
        if not 0 <= self.equal <= 1:
            raise ConfigError(f"share of equal fronts is {self.equal}, must be 0 to 1")

    @property
    def name(self) -> str:
        """Such as ``37.5m-1-cars+road+things``."""
        return f"{self.period_m:g}m-{self.equal:g}-{'+'.join(sorted(self.unique)) or 'nothing'}"

    @property
    def spacing_m(self) -> float:
        """Distance between junctions: as many whole periods as a block of 75 m has."""
        return self.period_m * int(_BLOCK_M / self.period_m)


@dataclass(frozen=True, slots=True)
class StreetPlan:
    """Where streets run.

    Attributes:
        fronts: how the fronts repeat, along straight streets of one width; None where each is
            unique.
    """

    seed: int
    spacing_m: float
    fronts: Fronts | None = None

    def junction(self, at: Junction) -> Points:
        """Position (2,) of a junction, metres."""
        if self.fronts is not None:
            return np.array(at) * self.spacing_m
        rng = self.rng("junction", at)
        jitter = min(7.0, 0.09 * self.spacing_m)
        return np.array(at) * self.spacing_m + rng.uniform(-jitter, jitter, 2)

    def centreline(self, start: Junction, end: Junction) -> Points:
        """Points (4, 2) along the middle of a street, from one junction to the next."""
        if start > end:
            return self.centreline(end, start)[::-1]
        rng = self.rng("street", start, end)
        a, b = self.junction(start), self.junction(end)
        along = b - a
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        bend_m = rng.uniform(-0.05, 0.05, _BENDS) * self.spacing_m
        if self.fronts is not None:
            bend_m = np.zeros(_BENDS)
        inner = [a + along * (k + 1) / (_BENDS + 1) + across * bend_m[k] for k in range(_BENDS)]
        return np.array([a, *inner, b])

    def half_width_m(self, start: Junction, end: Junction) -> float:
        """Half the width of a street between its kerbs."""
        if self.fronts is not None:
            return _STRAIGHT_HALF_WIDTH_M
        first, last = min(start, end), max(start, end)
        widths = (3.6, 4.6, 5.0) if self.spacing_m > 45 else (3.6, 4.6)
        return float(self.rng("width", first, last).choice(widths))

    def rng(self, subject: str, *where: Junction) -> np.random.Generator:
        """The generator for one subject at one place."""
        numbers = [self.seed, *subject.encode()[:8]]
        numbers += [value + 100_000 for place in where for value in place]
        return np.random.default_rng(numbers)

    def block_outline(self, block: Junction, inset_m: float) -> Points:
        """The outline (12, 2) of a block, anticlockwise, at a distance from its kerbs.

        Block (i, j) lies between junctions (i, j) and (i + 1, j + 1). Its sides come in the order
        south, east, north, west, three points each, the first at a junction's corner.
        """
        i, j = block
        corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        points, offsets = [], []
        for k in range(4):
            start, end = corners[k], corners[(k + 1) % 4]
            points.append(self.centreline(start, end)[:-1])
            offsets += [self.half_width_m(start, end) + inset_m] * (_BENDS + 1)
        return _inset(np.concatenate(points), np.array(offsets))


def _inset(outline: Points, offsets_m: Points) -> Points:
    """An anticlockwise outline (N, 2) moved inwards, segment i by offsets_m[i]."""
    along = np.roll(outline, -1, axis=0) - outline
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    inwards = np.stack([-along[:, 1], along[:, 0]], axis=1)
    moved = np.empty_like(outline)
    for k in range(len(outline)):
        # The corner lies on the moved lines of the segments before and after it.
        normals = np.stack([inwards[k - 1], inwards[k]])
        reach = np.array([offsets_m[k - 1], offsets_m[k]])
        if abs(np.linalg.det(normals)) < 0.02:  # nearly straight: either line will do
            moved[k] = outline[k] + inwards[k] * reach[1]
        else:
            moved[k] = outline[k] + np.linalg.solve(normals, reach)
    return moved


@dataclass(frozen=True, slots=True)
class Route:
    """A closed drive."""

    junctions: tuple[Junction, ...]
    beside: Route | None = None

    def streets(self) -> Iterator[Street]:
        """The streets it uses, each with its smaller junction first, then the next ring's."""
        for k, start in enumerate(self.junctions):
            end = self.junctions[(k + 1) % len(self.junctions)]
            yield (min(start, end), max(start, end))
        if self.beside is not None:
            yield from self.beside.streets()

    def all_junctions(self) -> tuple[Junction, ...]:
        """Its own junctions, and those of the ring next to it."""
        return self.junctions + (() if self.beside is None else self.beside.all_junctions())


def loop_of_length(length_m: float, seed: int) -> tuple[StreetPlan, Route]:
    """A plan and a loop in it of about a length."""
    if not 100 <= length_m <= 8000:
        raise ConfigError(f"route length is {length_m} m, must be 100 to 8000 m")
    # Streets of 37 to 75 m, and an even number of them, since a loop on a grid has one.
    count = max(4, 2 * round(length_m / 70 / 2))
    plan = StreetPlan(seed, length_m / count)
    return plan, Route(_ring(count, np.random.default_rng([seed, 0x10F])))


def equal_rings(fronts: Fronts, seed: int) -> tuple[StreetPlan, Route]:
    """A plan whose fronts repeat, a ring round two blocks, and another one next to it.

    The two share no street; one block lies between them.
    """
    ring = ((0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1))
    other = tuple((i, j + 2) for i, j in ring)
    return StreetPlan(seed, fronts.spacing_m, fronts), Route(ring, Route(other))


def crossing_loops(length_m: float, seed: int) -> tuple[StreetPlan, Route]:
    """A plan and a drive of several loops that meet: it passes some streets more than once."""
    if not 600 <= length_m <= 8000:
        raise ConfigError(f"route length is {length_m} m, must be 600 to 8000 m")
    loops = max(1, round(length_m / 700))
    stops: list[Junction] = []
    for k in range(loops):  # round a block, then on along the street that this began with
        i = 3 * k
        stops += [(i, 0), (i + 1, 0), (i + 1, 1), (i, 1), (i, 0), (i + 3, 0)]
    stops += [(3 * loops, -1), (0, -1), (0, 0)]
    walk = [stops[0]]
    for stop in stops[1:]:
        walk += _steps(walk[-1], stop)
    walk.pop()
    return StreetPlan(seed, length_m / len(walk)), Route(tuple(walk))


def _steps(start: Junction, end: Junction) -> list[Junction]:
    """Grid steps from one junction to another, first along x."""
    steps, (i, j) = [], start
    while i != end[0]:
        i += 1 if end[0] > i else -1
        steps.append((i, j))
    while j != end[1]:
        j += 1 if end[1] > j else -1
        steps.append((i, j))
    return steps


def _ring(count: int, rng: np.random.Generator) -> tuple[Junction, ...]:
    """A simple closed walk of `count` grid steps: the outline of a growing set of blocks."""
    cells = {(0, 0)}
    while True:
        outline = _outline(cells)
        if len(outline) >= count:
            return outline
        options = sorted(
            (i + di, j + dj)
            for i, j in cells
            for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1))
            if (i + di, j + dj) not in cells
        )
        rng.shuffle(options)
        for option in options:
            if _is_simple(cells | {option}) and len(_outline(cells | {option})) <= count:
                cells = cells | {option}
                break


def _is_simple(cells: set[Junction]) -> bool:
    """Whether the outline is one walk that touches no junction twice."""
    edges = _boundary_edges(cells)
    starts = [start for start, _ in edges]
    return len(set(starts)) == len(starts) and len(_outline(cells)) == len(edges)


def _boundary_edges(cells: set[Junction]) -> list[tuple[Junction, Junction]]:
    """Directed edges with their block on the left."""
    edges = []
    for i, j in cells:
        corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        beside = [(i, j - 1), (i + 1, j), (i, j + 1), (i - 1, j)]
        edges += [(corners[k], corners[(k + 1) % 4]) for k in range(4) if beside[k] not in cells]
    return edges


def _outline(cells: set[Junction]) -> tuple[Junction, ...]:
    following = dict(_boundary_edges(cells))
    walk = [min(following)]
    while (ahead := following[walk[-1]]) != walk[0]:
        walk.append(ahead)
        if len(walk) > len(following):
            break
    return tuple(walk)


class AlterationKind(Enum):
    """What happens."""

    REPAINT = 0  # a front is repainted, permanently
    SCAFFOLD = 1  # stands for weeks
    FELLED = 2  # trees are felled, permanently
    NEW_SIGN = 3  # permanently


# Mean days from one alteration to the next, town-wide. One meets one thing in forty: in a year a
# third of the fronts is repainted and a tenth of the trees felled; scaffolds hide one front in
# twenty at any time.
_DAYS_BETWEEN = {
    AlterationKind.REPAINT: 20.0,
    AlterationKind.SCAFFOLD: 15.0,
    AlterationKind.FELLED: 80.0,
    AlterationKind.NEW_SIGN: 20.0,
}


@dataclass(frozen=True, slots=True)
class Alteration:
    """One change; which houses or trees it meets follows from its number."""

    kind: AlterationKind
    number: int
    seed: int

    def chooses(self, block: Junction, item: int) -> bool:
        """Whether it meets one thing of a block: about one in forty."""
        numbers = [self.seed, self.number, self.kind.value, block[0] + 100_000, block[1] + 100_000]
        return bool(np.random.default_rng([*numbers, item]).random() < 1 / 40)


def alterations_on(seed: int, day: int) -> frozenset[Alteration]:
    """What has changed by a day, counted from the day the town was first seen."""
    found = set()
    for kind in AlterationKind:
        rng = np.random.default_rng([seed, 0xA17, kind.value])
        start, number = 0.0, 0
        while (start := start + rng.exponential(_DAYS_BETWEEN[kind])) <= day:
            lasts = rng.uniform(14, 45) if kind is AlterationKind.SCAFFOLD else np.inf
            if day < start + lasts:
                found.add(Alteration(kind, number, seed))
            number += 1
    return frozenset(found)
