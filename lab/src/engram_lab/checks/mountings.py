"""Cameras mounted otherwise than those that made the map: how much of the route they localise.

    python -m engram_lab.checks.mountings SEED SESSION...     # of `longer_trial_town`

The first drive of the town is mapped. Each named drive is localised there twice: as it is, and
rendered again through a camera that is mounted 0.5 m higher and 0.3 m aside, pitched down by 10°.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.measures import route_not_localised
from engram.robot.mapping import extract_log, map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram_lab.checks.both_directions import localised
from engram_lab.town.campaigns import Campaign
from engram_lab.town.session import SimulatedSequence
from engram_lab.town.simulating import campaign_folder, campaigns_folder, simulate
from engram_lab.trial_towns import longer_trial_town

# The other camera in the frame of the usual one: x to the right, y down, z ahead.
MOUNTED = SE3.exp(np.array([0.3, -0.5, 0, 0, 0, 0])) @ SE3.exp(
    np.array([0, 0, 0, -np.deg2rad(10.0), 0, 0])
)


class MountedSequence(SimulatedSequence):
    """A session of a campaign, seen through a camera that is mounted elsewhere on the robot."""

    def __init__(self, campaign: Campaign, session: int, rig_from_cam: SE3) -> None:
        super().__init__(campaign, session)
        cam_from_rig = rig_from_cam.inverse()
        self._camera = replace(self.drive.camera, cam_from_rig=cam_from_rig)
        self.drive.poses = [
            replace(
                pose,
                world_from_cam=pose.world_from_cam @ rig_from_cam,
                twist=cam_from_rig.adjoint() @ pose.twist,
            )
            for pose in self.drive.poses
        ]

    @property
    def camera(self) -> StereoCamera:
        """The robot's camera, with its mounting."""
        return self._camera

    def __iter__(self) -> Iterator[StereoPair]:
        return (replace(pair, camera=self._camera) for pair in self.drive)


def rendered(campaign: Campaign, session: int) -> tuple[Path, Path]:
    """The frame logs of one session, with the usual camera and with the other."""
    folder = campaigns_folder()
    (usual,) = simulate(campaign, folder, sessions=[session]).files
    other = campaign_folder(folder, campaign) / "mounted" / Path(usual).name
    if not other.exists():
        other.parent.mkdir(exist_ok=True)
        extract_log(MountedSequence(campaign, session, MOUNTED), other, Settings())
    return Path(usual), other


def main() -> None:
    """Prints a line for each drive."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seed", type=int)
    parser.add_argument("sessions", type=int, nargs="+")
    asked = parser.parse_args()
    campaign = longer_trial_town(asked.seed)
    (first,) = simulate(campaign, campaigns_folder(), sessions=[0]).files
    with tempfile.TemporaryDirectory() as folder:
        centre = Path(folder) / "centre.engram"
        map_drive(centre, open_drive(Path(first)), Settings(), RobotOptions())
        for session in asked.sessions:
            shares = [
                1 - route_not_localised([localised(centre, log)])
                for log in rendered(campaign, session)
            ]
            print(f"{campaign.session(session).name}: localised {shares[0]:.2%} of the route as "
                  f"mapped, {shares[1]:.2%} mounted otherwise: {shares[1] / shares[0]:.1%}",
                  flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
