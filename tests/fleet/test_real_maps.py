"""Real drives of several robots, merged: two rigs on one street, a road and a room in halves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.merging import merge as merge_maps
from engram.fleet.merge.report import MergeReport
from engram.graph.model import NodeId, Omission
from engram.maps.map import Map, open_map
from engram.maps.map_files import check_file
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import localise_drive, summarise
from engram.sequences.motion_files import Trajectory, read_kitti_poses
from engram.sequences.opening import open_drive
from engram_lab.truth import read_matrix_truth

pytestmark = pytest.mark.data

DRIVE_0001 = Path("kitti_raw/2011_09_26/2011_09_26_drive_0001_sync")
KITTI_06 = Path("kitti_odometry/sequences/06")
ROOM = Path("euroc/V1_01_easy_sparse")
# Where camera 2 of KITTI's rig stands in camera 0, from its calibration.
CAM0_FROM_CAM2_M = np.array([-0.0598, 0.0004, -0.0027])


def robot_map(folder: Path, robot: str, drive: Path, **how: str) -> Path:
    path = folder / f"{robot}.engram"
    map_drive(path, open_drive(drive, robot=robot, **how), Settings(), RobotOptions())
    return path


def merge(centre: Path, *robots: Path) -> list[MergeReport]:
    return merge_maps(centre, list(robots))


def stamps_of(*maps: Path) -> dict[NodeId, int]:
    """When each node of some maps was saved, nanoseconds."""
    found: dict[NodeId, int] = {}
    for path in maps:
        with Map.open(path) as store:
            found |= {node.id: node.stamp_ns for node in store.load().nodes}
    return found


def omissions_of(centre: Path) -> list[Omission]:
    with Map.open(centre) as store:
        return list(store.omissions.values())


def errors_m(centre: Path, robot: Path, truth: Trajectory) -> list[float]:
    """How far from the truth each node of a robot's map was placed that the centre left out."""
    stamps_ns = stamps_of(centre, robot)
    found = []
    for one in omissions_of(centre):
        world_from_node = truth.at(stamps_ns[one.node])
        true = world_from_node.inverse() @ truth.at(stamps_ns[one.omitted])
        found.append(float(np.linalg.norm(true.translation - one.node_from_omitted.translation)))
    return found


@pytest.fixture(scope="module")
def street(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One street seen by two rigs at once; the blue channel stands for another appearance."""
    folder, drive = tmp_path_factory.mktemp("street"), data_dir / DRIVE_0001
    return {
        "grey": robot_map(folder, "grey", drive),
        "colour": robot_map(folder, "colour", drive, rig="colour"),
        "blue": robot_map(folder, "blue", drive, rig="colour", channel="blue"),
    }


def test_what_another_rig_saw_of_the_same_street_is_omitted(street, tmp_path):
    centre = tmp_path / "centre.engram"
    _, colour, blue = merge(centre, *street.values())
    assert colour.taken <= 0.05 * len(stamps_of(street["colour"]))
    assert blue.taken <= 0.2 * len(stamps_of(street["blue"]))
    assert blue.components == 1
    assert check_file(centre).sound
    stamps_ns = stamps_of(centre, *street.values())
    # The rigs trigger within 6 ms of each other; frames come every 100 ms.
    apart = [
        float(np.linalg.norm(one.node_from_omitted.translation - CAM0_FROM_CAM2_M))
        for one in omissions_of(centre)
        if abs(stamps_ns[one.node] - stamps_ns[one.omitted]) < 40_000_000
    ]
    assert len(apart) > 60
    assert np.median(apart) <= 0.02
    assert not any(report.changed for report in merge(centre, *street.values()))


def test_a_robot_works_from_a_download_of_real_maps(street, data_dir, tmp_path):
    centre, part = tmp_path / "centre.engram", tmp_path / "part.engram"
    merge(centre, street["grey"], street["colour"])
    download(centre, part, DownloadOptions("copy"))
    red = open_drive(data_dir / DRIVE_0001, rig="colour", channel="red", robot="red")
    with open_map(part) as opened:
        results = localise_drive(opened, red)
    assert summarise(results)["share_localised"] >= 0.8
    map_drive(part, red, Settings(), RobotOptions())
    (report,) = merge(centre, part)
    assert (report.sessions, report.known) == (1, len(stamps_of(street["grey"])))
    assert check_file(centre).sound


def test_two_robots_that_share_a_road_agree_with_the_truth(data_dir, tmp_path):
    drive, centre = data_dir / KITTI_06, tmp_path / "road.engram"
    even = robot_map(tmp_path, "even", drive, frames="::2")
    odd = robot_map(tmp_path, "odd", drive, frames="1::2")
    _, report = merge(centre, even, odd)
    assert (report.taken, report.components) == (0, 1)
    stamps_ns = open_drive(drive).stamps_ns
    truth = read_kitti_poses(data_dir / "kitti_odometry/poses/06.txt", stamps_ns)
    errors = errors_m(centre, odd, truth)
    assert len(errors) == report.omitted
    assert np.median(errors) <= 0.03
    assert max(errors) <= 0.15


def test_halves_of_a_room_are_joined_where_they_overlap(data_dir, tmp_path):
    drive, centre = data_dir / ROOM, tmp_path / "room.engram"
    first = robot_map(tmp_path, "first", drive, frames=":32")
    second = robot_map(tmp_path, "second", drive, frames="32:")
    _, report = merge(centre, first, second)
    assert report.omitted >= 3
    assert report.components == 1
    assert check_file(centre).sound
    truth = read_matrix_truth(drive / "poses_world_from_rectified_cam0.txt")
    assert max(errors_m(centre, second, truth)) <= 0.25


def test_another_town_is_taken_and_stays_apart(street, data_dir, tmp_path):
    centre = tmp_path / "centre.engram"
    road = robot_map(tmp_path, "road", data_dir / KITTI_06)
    _, report = merge(centre, street["grey"], road)
    assert (report.omitted, report.components) == (0, 2)
    assert report.taken == len(stamps_of(road))
