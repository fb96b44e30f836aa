"""What moves while one drives: cars ahead and oncoming, cyclists, people on the pavements.

Everything is a function of time and of how far the robot is, so that a frame can be made without
those before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram_lab.town.drive import Line, closed_line, driving_line
from engram_lab.town.furniture import Materials
from engram_lab.town.mesh import Kind, Mesh
from engram_lab.town.streets import Route, StreetPlan
from engram_lab.town.vehicles import car, cyclist, pedestrian

_SEEN_M = 75.0
_MODELS = 6
_STRIDES = 4


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
        """A car ahead, which falls back to 11 m and draws away out of sight in turns."""
        waves = np.sin(driven_m / np.array([140.0, 95.0]) + self._lead_phase).sum() / 2
        gap_m = 11.0 + 75.0 * float(np.clip(0.95 - 0.75 * self._traffic + 0.8 * waves, 0, 1.2))
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
