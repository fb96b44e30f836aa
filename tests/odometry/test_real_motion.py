"""Odometry and matching on real images, against truth; bounds are what the project promises."""

from pathlib import Path

import numpy as np
import pytest

from engram.frontend.frame import Frame
from engram.frontend.frontend import Frontend
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.se3 import SE3
from engram.odometry.odometry import Odometry
from engram.sequences.opening import open_drive

pytestmark = pytest.mark.data


def frames_of(folder: Path, **options) -> list[Frame]:
    frontend = Frontend()
    return [frontend.extract(pair) for pair in open_drive(folder, **options)]


def test_drift_on_a_road_stays_below_one_per_cent(data_dir: Path) -> None:
    frames = frames_of(data_dir / "kitti_odometry/sequences/06")
    rows = np.loadtxt(data_dir / "kitti_odometry/poses/06.txt")
    truth = [SE3.from_matrix(row.reshape(3, 4)) for row in rows]
    odometry, end = Odometry(), SE3.identity()
    for frame in frames:
        step = odometry.step(frame)
        if step.prev_from_curr is not None:
            end = end @ step.prev_from_curr
    wrong = truth[-1].inverse() @ truth[0] @ end
    assert wrong.distance_m < 0.01 * 59.9  # the clip's length, m
    assert np.degrees(wrong.angle_rad) < 0.02 * 59.9


def test_a_resting_camera_seems_to_rest(data_dir: Path) -> None:
    odometry, end = Odometry(), SE3.identity()
    for frame in frames_of(data_dir / "euroc/V1_01_easy_at_rest"):
        step = odometry.step(frame)
        if step.prev_from_curr is not None:
            end = end @ step.prev_from_curr
    assert end.distance_m < 0.01


def test_another_rig_finds_its_place_in_the_map_of_the_first(data_dir: Path) -> None:
    drive = data_dir / "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync"
    grey, colour = (frames_of(drive, rig=rig, frames="0:54:6") for rig in ("grey", "colour"))
    errors = []
    for reference, live in zip(grey, colour, strict=True):
        match = match_frames(reference, live, MatcherConfig(), seed=1)
        assert match.inliers >= 20
        assert match.reference_from_live is not None
        between = match.reference_from_live.translation - [-0.0598, 0.0004, -0.0027]
        errors.append(float(np.linalg.norm(between)))
    assert np.median(errors) < 0.02
