"""One drive of a campaign: stereo pairs in the order of time, with truth."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise

import numpy as np

from engram.errors import ConfigError
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import Clock
from engram.sequences.motion_files import Trajectory
from engram.sequences.sequence import SequenceInfo
from engram_lab.town.camera_model import CameraModel, Met
from engram_lab.town.campaigns import Campaign, SessionPlan
from engram_lab.town.conditions import Conditions
from engram_lab.town.drive import (
    DrivingStyle,
    Line,
    Pose,
    Residual,
    Robot,
    drive,
    driving_line,
    robot_named,
)
from engram_lab.town.mesh import FrameTruth, Mesh
from engram_lab.town.rendering import TownRenderer
from engram_lab.town.streets import Route, StreetPlan, alterations_on
from engram_lab.town.textures import Style
from engram_lab.town.town import Life, Today, Town

_MOST_THREADS = 256  # of the core
_IN_RAIN_BEFORE_S = 120.0  # how long a robot has driven when a session begins


class SimulatedDrive:
    """A session of a campaign, rendered as it is iterated over.

    Iterating twice gives the same images. Poses are cheap and need no rendering. The drives of a
    town share one scene: not for use from several threads at once.

    Args:
        robot: drives in place of the plan's.
    """

    def __init__(
        self, campaign: Campaign, session: int, threads: int = 1, robot: Robot | None = None
    ) -> None:
        if not 1 <= threads <= _MOST_THREADS:
            raise ConfigError(f"threads is {threads}, must be 1 to {_MOST_THREADS}")
        self.campaign = campaign
        self.plan: SessionPlan = campaign.session(session)
        self.robot: Robot = robot or robot_named(self.plan.robot)
        self.conditions = Conditions(
            self.plan.start,
            self.plan.weather,
            self.plan.seed,
            campaign.place,
            self.plan.rain_mm_h,
        )
        self.residual = Residual.of_rig(self.robot.name, campaign.seed)
        self.met: list[Met] = []  # by the frames of the last pass
        self._threads = threads
        self._stage: TownRenderer | None = None
        self._life: Life | None = None
        self._streets, self._route = campaign.plan()
        beside = self._route.beside if self.plan.beside else None
        self._driven = beside or self._route
        self.line: Line = driving_line(self._streets, self._driven, self.plan.reverse)
        count = int(self.line.length_m // campaign.spacing_m)
        style = DrivingStyle(self.plan.seed)
        poses = drive(self.line, self.robot, style, campaign.spacing_m, count)
        self.poses: list[Pose] = [one for one in poses if one.driven_m >= campaign.begins_m]

    @property
    def camera(self) -> StereoCamera:
        """The robot's camera."""
        return self.robot.camera

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoPair]:
        """Pairs `start` to `stop`; the exposure settles again at the first."""
        camera_model = CameraModel(self.robot, self.plan.seed, self.plan.lens)
        self.met = []
        self._drive_through_rain(camera_model, start)
        for k, pose in enumerate(self.poses[start:stop], start):
            moment = self.conditions.at(pose.driven_m, pose.elapsed_s)
            if k > start:
                seconds = pose.elapsed_s - self.poses[k - 1].elapsed_s
                camera_model.stand_in(moment.rain_mm_h, pose.speed_m_s, seconds)
            luminance, inverse_depths = self._renderer().render(
                pose.world_from_cam, self.camera, moment, self._moving(pose)
            )
            left, right = camera_model.expose(luminance, inverse_depths, pose, moment, k)
            self.met.append(camera_model.met(moment))
            yield StereoPair(self.stamp_ns(k), left, right, self.camera)

    def _drive_through_rain(self, camera_model: CameraModel, start: int) -> None:
        """Leaves on the glass what fell before frame `start`, and before the drive."""
        first = self.conditions.at(0.0, 0.0)
        camera_model.stand_in(first.rain_mm_h, self.poses[0].speed_m_s, _IN_RAIN_BEFORE_S)
        for before, pose in pairwise(self.poses[: start + 1]):
            moment = self.conditions.at(pose.driven_m, pose.elapsed_s)
            seconds = pose.elapsed_s - before.elapsed_s
            camera_model.stand_in(moment.rain_mm_h, pose.speed_m_s, seconds)

    def truths(self, start: int = 0, stop: int | None = None) -> Iterator[FrameTruth]:
        """Truth of frames `start` to `stop`."""
        for pose in self.poses[start:stop]:
            depth_m, kinds = self._renderer().depth(
                pose.world_from_cam, self.camera, self._moving(pose)
            )
            yield FrameTruth(pose.world_from_cam, self.camera, depth_m, kinds)

    def stamp_ns(self, frame: int) -> int:
        """UTC of a frame, ns."""
        start_ns = int(self.plan.start.timestamp()) * 1_000_000_000
        return start_ns + round(self.poses[frame].elapsed_s * 1e9)

    def world_from_cams(self) -> list[SE3]:
        """The true pose of each frame."""
        return [pose.world_from_cam for pose in self.poses]

    def today(self) -> Today:
        """What is there on the day of the drive."""
        day = self.plan.start.toordinal()
        rng = np.random.default_rng([self.campaign.seed, day, 0xDA7])
        return Today(
            day,
            self.conditions.hour,
            self.conditions.season,
            float(np.clip(self.campaign.parked_share + rng.normal(0, 0.1), 0, 1)),
            alterations_on(self.campaign.seed, day - self.campaign.first_day),
            self.conditions.leaves,
        )

    def _town(self) -> Town:
        return _town_of(self._streets, self._route, Style())

    def _renderer(self) -> TownRenderer:
        if self._stage is None:
            town = self._town()
            self._stage = TownRenderer(town, self.today(), self._threads, self.residual)
        return self._stage

    def _moving(self, pose: Pose) -> Mesh:
        if self._life is None:
            self._life = Life(
                self._town().cast, self._streets, self._driven, self.line, self.plan.reverse,
                self.campaign.traffic, self.plan.seed,
            )  # fmt: skip
        position = pose.world_from_cam.translation[:2]
        return self._life.around(position, pose.driven_m, pose.elapsed_s)


@lru_cache(maxsize=2)
def _town_of(streets: StreetPlan, route: Route, style: Style) -> Town:
    """Towns are costly to begin; the sessions of a campaign share one."""
    return Town(streets, route, style)


class SimulatedSequence:
    """Renders as it is read: a `StereoSequence`."""

    def __init__(self, campaign: Campaign, session: int, threads: int = 1) -> None:
        self._drive = SimulatedDrive(campaign, session, threads)

    @property
    def drive(self) -> SimulatedDrive:
        """The drive itself, with its truth."""
        return self._drive

    @property
    def info(self) -> SequenceInfo:
        """Facts about the drive as a whole; see `Campaign.town_in_names`."""
        campaign, plan = self._drive.campaign, self._drive.plan
        town = f"@{campaign.home}-{campaign.seed}" if campaign.town_in_names else ""
        return SequenceInfo(
            name=plan.name,
            format="simulated",
            clock=Clock.UTC,
            robot=f"{plan.robot}{town}",
            longitude_deg=campaign.place.longitude_deg,
        )

    @property
    def camera(self) -> StereoCamera:
        """The robot's camera."""
        return self._drive.camera

    @property
    def skipped(self) -> int:
        """None are ever left out."""
        return 0

    def __len__(self) -> int:
        return len(self._drive)

    def __iter__(self) -> Iterator[StereoPair]:
        return iter(self._drive)

    def truth(self) -> Trajectory:
        """The true pose of every frame, in the town's axes."""
        stamps = [self._drive.stamp_ns(k) for k in range(len(self._drive))]
        return Trajectory(np.array(stamps, dtype=np.int64), self._drive.world_from_cams())
