"""A session of a simulated campaign as a drive like any other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from engram.frontend import StereoPair
from engram.geometry import StereoCamera
from engram.graph.model import Clock
from engram.sequences.sequence import SequenceInfo
from engram.sequences.trajectories import Trajectory
from engram_lab.town import Campaign, SimulatedDrive


class SimulatedSequence:
    """Renders as it is read: a `StereoSequence`.

    Args:
        campaign: the campaign.
        session: which of its drives.
        threads: of the renderer.

    Raises:
        ConfigError: the campaign has no such session.
    """

    def __init__(self, campaign: Campaign, session: int, threads: int = 1) -> None:
        self._drive = SimulatedDrive(campaign, session, threads)

    @property
    def drive(self) -> SimulatedDrive:
        """The drive itself, with its truth."""
        return self._drive

    @property
    def info(self) -> SequenceInfo:
        """Facts about the drive as a whole; campaign and seed are part of the robot's name.

        They stand for the robot's identity (method §2.7): wildcats of two towns are two robots.
        """
        campaign, plan = self._drive.campaign, self._drive.plan
        return SequenceInfo(
            name=plan.name,
            format="simulated",
            clock=Clock.UTC,
            robot=f"{plan.robot}@{campaign.home}-{campaign.seed}",
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
