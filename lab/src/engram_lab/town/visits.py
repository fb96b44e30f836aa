"""Places of a small loop, seen again and again under other lights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from engram.frontend import StereoPair
from engram.geometry import SE3
from engram_lab.town.camera_model import CLEAN, CameraModel
from engram_lab.town.conditions import Conditions
from engram_lab.town.drive import Pose, driving_line, pose_on
from engram_lab.town.rendering import TownRenderer
from engram_lab.town.robots import Robot, robot_named
from engram_lab.town.streets import loop_of_length
from engram_lab.town.textures import Style
from engram_lab.town.town import Today, Town

LOOP_M = 150.0
_PLACES_EVERY_M = 5.0


@dataclass(frozen=True, slots=True)
class Visit:
    """One pass through the places: when, in what weather, on which day's parking."""

    name: str
    start: datetime
    weather: str
    day: int


def at(month: int, day: int, hour: float) -> datetime:
    """A time of 2025, UTC; hours of 24 and more wrap round to the same day's early hours."""
    hour %= 24
    return datetime(2025, month, day, int(hour), round(60 * (hour % 1)), tzinfo=UTC)


VISITS = {
    visit.name: visit
    for visit in (
        Visit("morning", at(7, 14, 8.0), "clear", 14),
        Visit("next morning", at(7, 15, 8.0), "clear", 15),
        Visit("an hour later", at(7, 15, 9.0), "clear", 15),
        Visit("late afternoon", at(7, 15, 17.0), "clear", 15),
        Visit("overcast", at(7, 15, 11.0), "overcast", 15),
        Visit("night", at(7, 15, 23.0), "fair", 15),
        Visit("snow", datetime(2025, 12, 28, 11, tzinfo=UTC), "snow", 180),
    )
}


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
        self,
        visit: Visit,
        ahead_m: float | NDArray[np.float64] = 0.0,
        aside_m: float | NDArray[np.float64] = 0.0,
    ) -> list[tuple[SE3, StereoPair]]:
        """True pose and images at each place, moved so far ahead and to the left.

        Args:
            visit: when.
            ahead_m, aside_m: of all places, or (P,) of each.
        """
        conditions = Conditions(visit.start, visit.weather, visit.day)
        renderer = self._renderer(visit)
        camera, found = self.robot.camera, []
        starts_m = self._starts_m + ahead_m
        asides_m = np.broadcast_to(aside_m, starts_m.shape)
        for k, start_m in enumerate(self._starts_m):
            moved_m, left_m = float(starts_m[k]), float(asides_m[k])
            world_from_cam = pose_on(self._line, self.robot, moved_m, left_m)
            moment = conditions.at(float(start_m), 0.0)
            luminance, inverse_depths = renderer.render(world_from_cam, camera, moment)
            twist = np.array([0, 0, 5.5, 0, 0, 0])
            pose = Pose(world_from_cam, float(start_m), 0.0, 5.5, twist)
            model = CameraModel(self.robot, 1000 * visit.day + visit.start.hour, CLEAN)
            left, right = model.expose(luminance, inverse_depths, pose, moment.rain, k)
            found.append((world_from_cam, StereoPair(k, left, right, camera)))
        return found

    def depths_m(self, visit: Visit, world_from_cams: Iterable[SE3]) -> list[NDArray[np.float32]]:
        """Depth along the left camera's axis: (h, w) for each pose, infinite for the sky."""
        renderer = self._renderer(visit)
        return [renderer.depth(pose, self.robot.camera)[0] for pose in world_from_cams]

    def _renderer(self, visit: Visit) -> TownRenderer:
        conditions = Conditions(visit.start, visit.weather, visit.day)
        today = Today(visit.day, conditions.hour, conditions.season, 0.45)
        return TownRenderer(self._town, today)
