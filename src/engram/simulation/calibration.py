"""How hard the world is, by the reference matcher: the table of `docs/simulation.md`.

Difficulty was set once, before any evaluation, on a loop of 0.15 km, against facts from outside;
see the page for what each bound comes from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from engram.frontend import StereoPair
from engram.geometry import SE3
from engram.simulation.camera_model import CLEAN, CameraModel
from engram.simulation.conditions import Conditions
from engram.simulation.drive import Pose, driving_line, pose_on
from engram.simulation.reference_matcher import (
    ReferenceFrame,
    reference_frame,
    reference_match,
)
from engram.simulation.rendering import TownRenderer
from engram.simulation.robots import Robot, robot_named
from engram.simulation.streets import loop_of_length
from engram.simulation.textures import Style
from engram.simulation.town import Today, Town

LOOP_M = 150.0
_PLACES_EVERY_M = 5.0


@dataclass(frozen=True, slots=True)
class Visit:
    """One pass through the places: when, in what weather, on which day's parking."""

    name: str
    start: datetime
    weather: str
    day: int


def _at(month: int, day: int, hour: float) -> datetime:
    return datetime(2025, month, day, int(hour), round(60 * (hour % 1)), tzinfo=UTC)


VISITS = {
    visit.name: visit
    for visit in (
        Visit("morning", _at(7, 14, 8.0), "clear", 14),
        Visit("next morning", _at(7, 15, 8.0), "clear", 15),
        Visit("an hour later", _at(7, 15, 9.0), "clear", 15),
        Visit("late afternoon", _at(7, 15, 17.0), "clear", 15),
        Visit("overcast", _at(7, 15, 11.0), "overcast", 15),
        Visit("night", _at(7, 15, 23.0), "fair", 15),
        Visit("snow", datetime(2025, 12, 28, 11, tzinfo=UTC), "snow", 180),
    )
}


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table.

    Attributes:
        letter: of the requirement.
        what: map against live.
        value: measured.
        low, high: bounds.
        unit: of the value.
    """

    letter: str
    what: str
    value: float
    low: float
    high: float
    unit: str

    @property
    def holds(self) -> bool:
        """Whether the value lies within its bounds."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True, slots=True)
class Pairing:
    """One visit as the map against another live.

    Attributes:
        mean_inliers: of poses that are right, 0 elsewhere.
        success_share: of the places.
    """

    mean_inliers: float
    success_share: float


class Places:
    """A loop's places, seen on any visit.

    Args:
        seed: of the town.
        style: of its textures.
        robot: whose camera.
        every_m: way between places.
    """

    def __init__(
        self, seed: int = 1, style: Style | None = None, robot: str = "wildcat",
        every_m: float = _PLACES_EVERY_M,
    ) -> None:  # fmt: skip
        plan, route = loop_of_length(LOOP_M, seed)
        self.robot: Robot = robot_named(robot)
        self._town = Town(plan, route, style or Style())
        self._line = driving_line(plan, route, reverse=False)
        self._starts_m = np.arange(0, self._line.length_m, every_m)

    def __len__(self) -> int:
        return len(self._starts_m)

    def pairs(
        self, visit: Visit, ahead_m: float = 0.0, aside_m: float = 0.0
    ) -> list[tuple[SE3, StereoPair]]:
        """True pose and images at each place, moved so far ahead and to the left."""
        conditions = Conditions(visit.start, visit.weather, visit.day)
        today = Today(visit.day, conditions.hour, conditions.season, 0.45)
        renderer = TownRenderer(self._town, today)
        camera, found = self.robot.camera, []
        for k, start_m in enumerate(self._starts_m):
            world_from_cam = pose_on(self._line, self.robot, start_m + ahead_m, aside_m)
            moment = conditions.at(float(start_m), 0.0)
            luminance, inverse_depths = renderer.render(world_from_cam, camera, moment)
            twist = np.array([0, 0, 5.5, 0, 0, 0])
            pose = Pose(world_from_cam, float(start_m), 0.0, 5.5, twist)
            model = CameraModel(self.robot, 1000 * visit.day + visit.start.hour, CLEAN)
            left, right = model.expose(luminance, inverse_depths, pose, moment.rain, k)
            found.append((world_from_cam, StereoPair(k, left, right, camera)))
        return found

    def frames(
        self, visit: Visit, ahead_m: float = 0.0, aside_m: float = 0.0
    ) -> list[tuple[SE3, ReferenceFrame]]:
        """True pose and reference frame at each place."""
        return [(pose, reference_frame(pair)) for pose, pair in self.pairs(visit, ahead_m, aside_m)]


Frames = list[tuple[SE3, ReferenceFrame]]


def pairing(node_frames: Frames, live_frames: Frames) -> Pairing:
    """Every place of one visit matched against the same place of another."""
    inliers = []
    for (world_from_node, node), (world_from_live, live) in zip(
        node_frames, live_frames, strict=True
    ):
        truth = world_from_live.inverse() @ world_from_node
        inliers.append(reference_match(live, node).right_inliers(truth))
    counts = np.array(inliers)
    return Pairing(float(counts.mean()), float((counts >= 20).mean()))


def appearance_table(
    seed: int = 1, style: Style | None = None, advance: Callable[[str], None] | None = None
) -> list[Row]:
    """Rows (a) to (c), about two minutes on one core.

    Args:
        seed: of the town.
        style: of its textures; None for the calibrated one.
        advance: called with the name of each visit that is done.
    """
    places = Places(seed, style)
    seen: dict[str, Frames] = {}
    for name, visit in VISITS.items():
        # The map at the places, live half a metre from them: 0.35 m ahead and to the left.
        here = {"morning": (0.0, 0.0)}.get(name, (0.35, 0.35))
        seen[name] = places.frames(visit, *here)
        if advance is not None:
            advance(name)
    morning = seen["morning"]
    same = pairing(morning, seen["next morning"])
    corners = float(np.mean([frame.corners for _, frame in morning]))
    later = pairing(morning, seen["an hour later"]).mean_inliers / max(same.mean_inliers, 1)
    rows = [
        Row("a", "corners a frame", corners, 450, 750, ""),
        Row("a", "same hour, next day", same.mean_inliers, 100, np.inf, "inliers"),
        Row("b", "an hour later", 100 * later, 60, 85, "% of (a)"),
    ]
    for other, high, low in (
        ("late afternoon", 20, 0),
        ("night", 10, 0),
        ("snow", 20, 0),
        ("overcast", 50, 20),
    ):
        share = 100 * pairing(morning, seen[other]).success_share
        rows.append(Row("c", f"morning map, {other}", share, low, high, "% succeed"))
    return rows


def falloff(pairs: list[tuple[SE3, StereoPair]], steps: tuple[int, ...]) -> dict[int, float]:
    """Mean inliers between a frame and the one some frames further on, along one drive."""
    frames = [(pose, reference_frame(pair)) for pose, pair in pairs]
    found = {}
    for step in steps:
        counts = [
            reference_match(frames[k + step][1], frames[k][1]).right_inliers(
                frames[k + step][0].inverse() @ frames[k][0]
            )
            for k in range(0, len(frames) - step, 2)
        ]
        found[step] = float(np.mean(counts))
    return found
