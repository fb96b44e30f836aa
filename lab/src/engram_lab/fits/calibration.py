"""How hard the world is, by the reference matcher, on a loop of 0.15 km.

The world's difficulty was set once, before any evaluation, against facts from outside;
`lab/reports/town.md` says where each bound comes from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from engram.config import config_hash
from engram.frontend import StereoPair
from engram.geometry import SE3
from engram.monitor import QUIET, Monitor
from engram_lab.fits.reference_matcher import (
    SUCCESS_INLIERS,
    ReferenceFrame,
    reference_frame,
    reference_match,
)
from engram_lab.town.camera_model import CLEAN, CONSTANTS, CameraModel
from engram_lab.town.campaigns import WORLD_VERSION
from engram_lab.town.conditions import WEATHERS, Conditions
from engram_lab.town.drive import DrivingStyle, Pose, driving_line, pose_on
from engram_lab.town.rendering import TownRenderer
from engram_lab.town.robots import ROBOTS, Robot, robot_named
from engram_lab.town.streets import loop_of_length
from engram_lab.town.textures import Style
from engram_lab.town.town import Today, Town

LOOP_M = 150.0
MAPPED = "morning"
# The towns that the knobs were set on, and two that were looked at only afterwards.
TUNED_TOWNS = (1, 2, 3)
UNSEEN_TOWNS = (4, 5)
# KITTI 06 from frame 0 to 50, with which row (e) compares: the mean way between two frames.
CLIP_FRAMES = 51
CLIP_SPACING_M = 1.197
CLIP_STEPS = (1, 2, 4, 6)
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
        low, high: between which facts from outside put it.
        unit: of the value.
    """

    letter: str
    what: str
    value: float
    low: float
    high: float
    unit: str

    def text(self) -> str:
        """A line for people."""
        bounds = f"{self.low:.3g} to {self.high:g}"
        return f"{self.letter}  {self.what:42} {self.value:8.2f} {self.unit:10} ({bounds})"


def world_hash() -> str:
    """Changes with the world's version, and with what sets its difficulty."""
    return config_hash(
        {
            "version": WORLD_VERSION,
            "style": Style(),
            "weathers": WEATHERS,
            "robots": ROBOTS,
            "driving": DrivingStyle(0),
            "camera": CONSTANTS,
        }
    )


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


def inliers_of(node_frames: Frames, live_frames: Frames) -> NDArray[np.int64]:
    """(P,) inliers of each place of one visit matched against the same place of another.

    0 where the pose is wrong.
    """
    return np.array(
        [
            reference_match(live, node).right_inliers(world_from_live.inverse() @ world_from_node)
            for (world_from_node, node), (world_from_live, live) in zip(
                node_frames, live_frames, strict=True
            )
        ],
        dtype=np.int64,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """How the morning's map serves the other visits of a town.

    Attributes:
        corners: (P,) corners of the morning's frames.
        inliers: by the name of a visit, (P,) each.
    """

    corners: NDArray[np.int64]
    inliers: Mapping[str, NDArray[np.int64]]

    @staticmethod
    def pooled(towns: Sequence[Appearance]) -> Appearance:
        """All places of some towns as those of one."""
        return Appearance(
            np.concatenate([town.corners for town in towns]),
            {
                name: np.concatenate([town.inliers[name] for town in towns])
                for name in towns[0].inliers
            },
        )


def appearance(
    places: Places, visits: Sequence[str] = tuple(VISITS), monitor: Monitor = QUIET
) -> Appearance:
    """Matches the morning at all places against every other visit.

    The map is made at the places, live stands half a metre from them: 0.35 m ahead and as much to
    the left.

    Args:
        places: of a town; about 90 s on one core for 27 of them.
        visits: that are compared; all of them for the table.
        monitor: hears of each visit that is done.
    """
    morning = places.frames(VISITS[MAPPED])
    inliers: dict[str, NDArray[np.int64]] = {}
    for name in visits:
        if name != MAPPED:
            inliers[name] = inliers_of(morning, places.frames(VISITS[name], 0.35, 0.35))
        monitor.advance(name)
    return Appearance(np.array([frame.corners for _, frame in morning]), inliers)


def appearance_table(seen: Appearance) -> list[Row]:
    """Rows (a) to (c)."""
    same = float(seen.inliers["next morning"].mean())
    later = float(seen.inliers["an hour later"].mean())
    rows = [
        Row("a", "corners a frame", float(seen.corners.mean()), 450, 750, ""),
        Row("a", "same hour, next day", same, 100, np.inf, "inliers"),
        Row("b", "an hour later", 100 * later / max(same, 1), 60, 85, "% of (a)"),
    ]
    for other, high, low in (
        ("late afternoon", 20, 0),
        ("night", 10, 0),
        ("snow", 20, 0),
        ("overcast", 50, 20),
    ):
        share = 100 * float((seen.inliers[other] >= SUCCESS_INLIERS).mean())
        rows.append(Row("c", f"{MAPPED} map, {other}", share, low, high, "% succeed"))
    return rows


def falloff(
    pairs: Sequence[tuple[SE3, StereoPair]], steps: Sequence[int], every: int = 2
) -> dict[int, float]:
    """Mean inliers between a frame and the one some frames further on, along one drive.

    Args:
        pairs: true poses and images, in the order of driving.
        steps: how many frames further on.
        every: only every so many frames are taken as the first of two.
    """
    frames = [(pose, reference_frame(pair)) for pose, pair in pairs]
    return {
        step: float(inliers_of(frames[: len(frames) - step : every], frames[step::every]).mean())
        for step in steps
    }


def falloff_table(town: Mapping[int, float], clip: Mapping[int, float]) -> list[Row]:
    """Rows (e): inliers in the town ÷ those on the clip, by the distance ahead.

    Args:
        town: of `falloff`, with KITTI's camera at the clip's spacing.
        clip: the same on frames of KITTI 06.
    """
    return [
        Row("e", f"{step * CLIP_SPACING_M:.1f} m ahead", town[step] / count, 1 / 1.5, 1.5, "× clip")
        for step, count in clip.items()
    ]
