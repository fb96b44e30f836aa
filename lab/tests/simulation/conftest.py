"""A small drive that several tests look at."""

from dataclasses import replace

import pytest

from engram.geometry.cameras import StereoCamera
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.session import SimulatedDrive


def small(drive: SimulatedDrive) -> SimulatedDrive:
    """The same drive with a camera of a quarter of the pixels each way."""
    camera = StereoCamera(100.5, 100.5, 63.5, 47.5, drive.camera.baseline_m, 128, 96)
    drive.robot = replace(drive.robot, camera=camera)
    return drive


@pytest.fixture(scope="session")
def hamlet() -> Campaign:
    return campaign_named("hamlet", seed=3)


@pytest.fixture(scope="session")
def drive(hamlet: Campaign) -> SimulatedDrive:
    return small(SimulatedDrive(hamlet, 0))
