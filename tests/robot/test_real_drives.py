"""Real drives, end to end: map with one rig, localise with another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.maps.map import open_map
from engram.maps.map_files import check_file
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import localise_drive, summarise
from engram.sequences.motion_files import read_kitti_poses
from engram.sequences.opening import open_drive
from engram.viewing.trajectory import chain_trajectory

pytestmark = pytest.mark.data

DRIVE_0001 = Path("kitti_raw/2011_09_26/2011_09_26_drive_0001_sync")
KITTI_06 = Path("kitti_odometry/sequences/06")
# Where camera 2 of KITTI's rig stands in camera 0, from its calibration.
CAM0_FROM_CAM2_M = np.array([-0.0598, 0.0004, -0.0027])


@pytest.fixture(scope="module")
def grey_map(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "grey.engram"
    map_drive(path, open_drive(data_dir / DRIVE_0001), Settings(), RobotOptions())
    return path


@pytest.mark.parametrize(("channel", "share"), [("grey", 0.95), ("blue", 0.8)])
def test_another_camera_is_localised_in_the_map_of_the_grey_rig(
    data_dir: Path, grey_map: Path, channel: str, share: float
) -> None:
    sequence = open_drive(data_dir / DRIVE_0001, rig="colour", channel=channel)
    with open_map(grey_map) as opened:
        results = localise_drive(opened, sequence)
    assert summarise(results)["share_localised"] >= share
    errors = []
    for found in results:
        # The rigs trigger within 6 ms of each other; frames come every 100 ms.
        same = found.node_stamp_ns and abs(found.node_stamp_ns - found.stamp_ns) < 40_000_000
        if same and found.node_from_live is not None:
            errors.append(np.linalg.norm(found.node_from_live.translation - CAM0_FROM_CAM2_M))
    assert len(errors) > 40
    assert np.median(errors) <= 0.02


def test_odd_frames_are_localised_in_the_even_ones(data_dir: Path, tmp_path: Path) -> None:
    path = tmp_path / "even.engram"
    map_drive(path, open_drive(data_dir / KITTI_06, frames="::2"), Settings(), RobotOptions())
    whole = open_drive(data_dir / KITTI_06)
    truth = read_kitti_poses(data_dir / "kitti_odometry/poses/06.txt", whole.stamps_ns)
    odd = open_drive(data_dir / KITTI_06, frames="1::2")
    with open_map(path) as opened:
        results = localise_drive(opened, odd)
    assert summarise(results)["share_localised"] == 1.0
    errors = []
    for found in results:
        node_from_live = truth.at(found.node_stamp_ns).inverse() @ truth.at(found.stamp_ns)
        difference = node_from_live.translation - found.node_from_live.translation
        errors.append(np.linalg.norm(difference))
    assert np.median(errors) <= 0.03


@pytest.mark.parametrize(
    ("focal", "baseline", "codes"),
    [
        (1.0, 1.0, set()),
        (1.1, 1.0, {"focal_length_off"}),
        (0.9, 1.0, {"focal_length_off"}),
        (1.0, 1.1, {"baseline_off"}),
        (1.0, 0.85, {"baseline_off"}),
    ],
)
def test_another_rig_is_told_by_the_map_how_wrong_its_calibration_is(
    data_dir: Path, grey_map: Path, focal: float, baseline: float, codes: set[str]
) -> None:
    colour = open_drive(data_dir / DRIVE_0001, rig="colour")
    camera = replace(
        colour.camera,
        fx=colour.camera.fx * focal,
        fy=colour.camera.fy * focal,
        baseline_m=colour.camera.baseline_m * baseline,
    )
    with open_map(grey_map) as opened, opened.robot(camera) as robot:
        for pair in colour:
            assert isinstance(pair, StereoPair)
            robot.step(replace(pair, camera=camera))
        found = [one for one in robot.diagnosis.findings if one.code.endswith("_off")]
    assert {one.code for one in found} == codes
    for one in found:
        assert one.value == pytest.approx(abs(focal * baseline - 1), abs=0.02)


def test_the_chained_trajectory_follows_the_truth(data_dir: Path, tmp_path: Path) -> None:
    path = tmp_path / "kitti.engram"
    sequence = open_drive(data_dir / KITTI_06)
    map_drive(path, sequence, Settings(), RobotOptions())
    truth = read_kitti_poses(data_dir / "kitti_odometry/poses/06.txt", sequence.stamps_ns)
    with open_map(path) as opened:
        results = localise_drive(opened, sequence)
        trajectory = chain_trajectory(opened.graph, results)
    (first_ns, _), (last_ns, first_from_last) = trajectory[0], trajectory[-1]
    true_motion: SE3 = truth.at(first_ns).inverse() @ truth.at(last_ns)
    # Drift of odometry over the 60 m between, at most 1 %.
    error_m = np.linalg.norm(true_motion.translation - first_from_last.translation)
    assert error_m <= 0.01 * true_motion.distance_m + 0.05


def test_a_room_walked_again_and_again_makes_a_sound_map(data_dir: Path, tmp_path: Path) -> None:
    path = tmp_path / "room.engram"
    sparse = open_drive(data_dir / "euroc/V1_01_easy_sparse")
    map_drive(path, sparse, Settings(), RobotOptions())
    assert check_file(path).sound
    # The robot at rest stands in that room, before the first frame of the other drive.
    rest = map_drive(
        path, open_drive(data_dir / "euroc/V1_01_easy_at_rest"), Settings(), RobotOptions()
    )
    assert summarise(rest.results)["share_localised"] == 1.0
    assert rest.saved == 0


def test_a_robot_that_mapped_live_is_localised_when_it_comes_again(
    data_dir: Path, tmp_path: Path
) -> None:
    path, pairs = tmp_path / "live.engram", open_drive(data_dir / KITTI_06)
    with open_map(path, create=True) as town:
        with town.robot(pairs.camera, name="r1", maps=True) as robot:
            saved = [robot.step(pair).saved for pair in pairs]
        assert robot.saving.nodes == sum(node is not None for node in saved) > 20
    assert check_file(path).sound
    with open_map(path) as town, town.robot(pairs.camera, name="r1", maps=True) as robot:
        again = [
            robot.step(replace(pair, stamp_ns=pair.stamp_ns + 3_600_000_000_000)) for pair in pairs
        ]
    assert np.mean([one.localised for one in again]) >= 0.95
