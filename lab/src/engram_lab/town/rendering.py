"""A drive through a town as stereo pairs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab import _town
from engram_lab.town.camera_model import CLEAN, CameraModel, Lens
from engram_lab.town.conditions import (
    AUREOLE,
    BEAM,
    LAMP_POWER,
    MIRRORS,
    WINDOW,
    Conditions,
    Moment,
)
from engram_lab.town.drive import EXACT, Pose, Residual, Robot, driving_line, pose_on, robot_named
from engram_lab.town.mesh import Mesh
from engram_lab.town.streets import Junction, alterations_on, loop_of_length
from engram_lab.town.textures import Style
from engram_lab.town.town import Tile, Today, Town

_AHEAD_M = 170.0  # how far tiles are kept around the camera
_LAMP_RANGE_M = 22.0


class TownRenderer:
    """Keeps the tiles around the camera in the scene and renders what it sees.

    Args:
        town: what there is.
        today: what is there today.
        threads: of the renderer.
        residual: what calibration leaves of its rig's errors.
    """

    def __init__(
        self, town: Town, today: Today, threads: int = 1, residual: Residual = EXACT
    ) -> None:
        self.town = town
        self._residual = residual
        self._today = today
        self._threads = threads
        self._tiles: dict[Junction, Tile] = {}
        self._lamps_on: bool | None = None

    def render(
        self, world_from_cam: SE3, camera: StereoCamera, moment: Moment, moving: Mesh | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Luminance and inverse depth, each (2, height, width) float32: left, right."""
        self._stand_ready(world_from_cam)
        self._light_lamps(moment)
        self._set_moving(moving)
        luminance, inverse_depths = self.town.scene.render(
            self._camera(camera),
            np.ascontiguousarray(world_from_cam.rotation),
            world_from_cam.translation,
            _light(moment, world_from_cam),
            self._threads,
        )  # fmt: skip
        return luminance, inverse_depths

    def depth(
        self, world_from_cam: SE3, camera: StereoCamera, moving: Mesh | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """What the left camera's pixel centres see.

        Returns:
            depth in metres (height, width) float32, infinite for the sky; `Kind` (height, width)
            int32, −1 for the sky.
        """
        self._stand_ready(world_from_cam)
        self._set_moving(moving)
        depth_m, kinds = self.town.scene.depth(
            self._camera(camera),
            np.ascontiguousarray(world_from_cam.rotation),
            world_from_cam.translation,
        )  # fmt: skip
        return depth_m, kinds

    def _camera(self, camera: StereoCamera) -> _town.RenderCamera:
        """The true camera, a residual off the calibrated one."""
        residual = self._residual
        return _town.RenderCamera(
            camera.fx * residual.focal, camera.fy * residual.focal, camera.cx, camera.cy,
            camera.width, camera.height, camera.baseline_m, residual.turn(camera),
        )  # fmt: skip

    def leave(self) -> None:
        """Takes its tiles out of the town's scene; they come back when it renders again."""
        for tile in self._tiles.values():
            self.town.drop_tile(tile)
        self._tiles.clear()
        self._lamps_on = None

    def _stand_ready(self, world_from_cam: SE3) -> None:
        """Has the tiles around the camera, and no others, in the scene."""
        if self.town.tenant is not self:
            if self.town.tenant is not None:
                self.town.tenant.leave()
            self.town.tenant = self
        position = world_from_cam.translation
        keep = set(self.town.blocks_near(position, 1.4 * _AHEAD_M))
        for block in [b for b in self._tiles if b not in keep]:
            self.town.drop_tile(self._tiles.pop(block))
            self._lamps_on = None
        for block in self.town.blocks_near(position, _AHEAD_M):
            if block not in self._tiles:
                self._tiles[block] = self.town.build_tile(block, self._today)
                self._lamps_on = None

    def _light_lamps(self, moment: Moment) -> None:
        lamps_on = moment.lamps_on
        if lamps_on is self._lamps_on:
            return
        self._lamps_on = lamps_on
        places = [self._tiles[block].lamps for block in sorted(self._tiles)]
        lamps = np.concatenate(places) if places and lamps_on else np.zeros((0, 3))
        rows = np.empty((len(lamps), 5), dtype=np.float32)
        rows[:, :3] = lamps
        rows[:, 3:] = (LAMP_POWER, _LAMP_RANGE_M)
        self.town.scene.set_lamps(rows)

    def _set_moving(self, moving: Mesh | None) -> None:
        mesh = Mesh.joined([]) if moving is None else moving
        self.town.scene.set_moving(
            mesh.vertices, mesh.uv, mesh.textures, mesh.flags, mesh.tint, mesh.glow, mesh.kinds
        )


def _light(moment: Moment, world_from_cam: SE3) -> _town.Light:
    """The core's record of the light, with the robot's own headlights below its camera."""
    rotation, centre = world_from_cam.rotation, world_from_cam.translation
    ahead = np.array([rotation[0, 2], rotation[1, 2], 0.0])
    ahead /= np.linalg.norm(ahead)
    aside = np.array([ahead[1], -ahead[0], 0.0])
    bumper = np.array([centre[0], centre[1], 0.7]) + 1.2 * ahead
    beam = ahead + np.array([0, 0, -0.06])
    vehicle = np.stack([bumper - 0.6 * aside, bumper + 0.6 * aside, beam / np.linalg.norm(beam)])
    return _town.Light.of(
        sun=moment.sun_direction.astype(np.float32),
        vehicle=vehicle.astype(np.float32),
        sun_power=moment.sun_power,
        sky_power=moment.sky_power,
        cloud=moment.cloud,
        cloud_x=moment.cloud_shift[0],
        cloud_y=moment.cloud_shift[1],
        fog_per_m=moment.fog_per_m,
        haze=moment.haze,
        wet=moment.wet,
        snow=moment.snow,
        headlights=BEAM if moment.headlights_on else 0.0,
        windows=WINDOW if moment.lamps_on else 0.0,
        aureole=AUREOLE,
        mirrors=MIRRORS,
    )


LOOP_M = 150.0
_PLACES_EVERY_M = 5.0
_FIRST_DAY = datetime(2025, 7, 1, tzinfo=UTC).toordinal()  # from which a loop changes
_IN_RAIN_S = 120.0  # how long it has rained on the glass when a place is seen


@dataclass(frozen=True, slots=True)
class Visit:
    """One pass through the places: when, in what weather or rain, on which day's parking."""

    name: str
    start: datetime
    weather: str
    day: int
    rain_mm_h: float | None = None


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
        lens: of the robot.
        loop_m: length of the loop.
    """

    def __init__(
        self, seed: int = 1, style: Style | None = None, robot: str = "wildcat",
        every_m: float = _PLACES_EVERY_M, lens: Lens = CLEAN,
        loop_m: float = LOOP_M,
    ) -> None:  # fmt: skip
        self._lens = lens
        plan, route = loop_of_length(loop_m, seed)
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
        conditions = self._conditions(visit)
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
            # Each place's glass is its own.
            seed = 1000 * visit.day + visit.start.hour + 1_000_003 * (k + 1)
            model = CameraModel(self.robot, seed, self._lens)
            model.stand_in(moment.rain_mm_h, pose.speed_m_s, _IN_RAIN_S)
            left, right = model.expose(luminance, inverse_depths, pose, moment, k)
            found.append((world_from_cam, StereoPair(k, left, right, camera)))
        return found

    def depths_m(self, visit: Visit, world_from_cams: Iterable[SE3]) -> list[NDArray[np.float32]]:
        """Depth along the left camera's axis: (h, w) for each pose, infinite for the sky."""
        renderer = self._renderer(visit)
        return [renderer.depth(pose, self.robot.camera)[0] for pose in world_from_cams]

    def _conditions(self, visit: Visit) -> Conditions:
        return Conditions(visit.start, visit.weather, visit.day, rain_mm_h=visit.rain_mm_h)

    def _renderer(self, visit: Visit) -> TownRenderer:
        """Of the visit's day, with what has been built since the year began."""
        conditions = self._conditions(visit)
        built = alterations_on(self._town.plan.seed, visit.start.toordinal() - _FIRST_DAY)
        today = Today(visit.day, conditions.hour, conditions.season, 0.45, built, conditions.leaves)
        return TownRenderer(self._town, today)
