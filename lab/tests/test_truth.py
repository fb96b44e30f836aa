"""Ground truth: other people's files are read as they mean them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.sequences.synthetic import only_engram_errors, write_log

from engram.errors import SequenceError
from engram.geometry.se3 import SE3
from engram.sequences.motion_files import Trajectory, write_tum
from engram.sequences.opening import open_drive
from engram_lab.truth import (
    read_euroc_truth,
    read_ins_truth,
    read_kitti_poses,
    read_matrix_truth,
    read_mocap_truth,
    read_truth,
    truth_path,
)

START_US = 1_400_505_794_000_000  # 2014-05-19 13:23 UTC
INS = (
    "timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,"
    "velocity_north,velocity_east,velocity_down,roll,pitch,yaw\n"
)


@given(content=st.one_of(st.binary(max_size=80), st.text(max_size=60).map(str.encode)))
def test_any_bytes_give_our_errors_or_a_trajectory(tmp_path_factory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("any") / "a.txt"
    path.write_bytes(content)
    only_engram_errors(lambda: read_matrix_truth(path))
    only_engram_errors(lambda: read_euroc_truth(path, SE3.identity()))
    only_engram_errors(lambda: read_kitti_poses(path, [0, 1]))
    only_engram_errors(lambda: read_ins_truth(path))


def test_euroc_truth_is_that_of_the_camera(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text(
        "#timestamp, p_RS_R_x [m], ...\n"
        "1403715273262142976,1,2,3,0.7071067811865476,0,0,0.7071067811865476,9,9,9\n"
    )
    body_from_cam = SE3.exp([0.5, 0, 0, 0, 0, 0])
    trajectory = read_euroc_truth(path, body_from_cam)
    # The body is turned by 90° about z, so its x axis is the world's y.
    np.testing.assert_allclose(trajectory.world_from_cam[0].translation, [1, 2.5, 3], atol=1e-12)


def test_the_truth_of_a_log_stands_beside_it(tmp_path: Path) -> None:
    log = write_log(tmp_path / "monday.framelog")
    assert read_truth(log) is None
    stamps_ns = np.arange(5) * 10**9
    write_tum(truth_path(log), Trajectory(stamps_ns, [SE3.identity()] * 5))
    assert (tmp_path / "monday.truth.txt").exists()
    found = read_truth(log)
    assert found is not None
    assert len(found) == 5


@pytest.mark.data
def test_kitti_poses_belong_to_the_frames(data_dir: Path) -> None:
    drive = open_drive(data_dir / "kitti_odometry/sequences/06")
    truth = read_kitti_poses(data_dir / "kitti_odometry/poses/06.txt", drive.stamps_ns)
    np.testing.assert_allclose(truth.world_from_cam[0].matrix(), np.eye(4), atol=1e-6)
    steps = [
        (one.inverse() @ other).distance_m
        for one, other in zip(truth.world_from_cam, truth.world_from_cam[1:], strict=False)
    ]
    assert sum(steps) == pytest.approx(59.9, abs=0.05)  # as stated beside the data


@pytest.mark.data
def test_euroc_truth_has_a_pose_for_every_pair(data_dir: Path) -> None:
    folder = data_dir / "euroc/V1_01_easy_sparse"
    truth = read_matrix_truth(folder / "poses_world_from_rectified_cam0.txt")
    stamps_ns = open_drive(folder).stamps_ns
    assert truth.stamps_ns.tolist() == stamps_ns.tolist()


def test_truth_from_the_ins(tmp_path: Path) -> None:
    path = tmp_path / "ins.csv"
    rows = [
        f"{START_US + 20_000 * k},INS_SOLUTION_GOOD,51.76,-1.26,110,"
        f"{5735000 + 2 * k},{620000 + k},-110,30U,0,0,0,0,0,{0.1 * k}"
        for k in range(3)
    ]
    path.write_text(INS + "\n".join(rows) + "\n")
    truth = read_ins_truth(path)
    np.testing.assert_allclose(truth.world_from_cam[2].translation, [4, 2, 0], atol=1e-9)
    yaw = np.arctan2(*truth.world_from_cam[2].rotation[[1, 0], 0])
    assert yaw == pytest.approx(0.2)
    assert truth.stamps_ns[1] - truth.stamps_ns[0] == 20_000_000


def test_rtk_has_other_columns_and_a_missing_one_is_named(tmp_path: Path) -> None:
    path = tmp_path / "rtk.csv"
    path.write_text("timestamp,northing,easting,down,roll,pitch\n1,2,3,4,5,6\n")
    with pytest.raises(SequenceError, match="no column yaw"):
        read_ins_truth(path)


def test_truth_from_motion_capture(tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    file.write_text("#timestamp [ns],px,py,pz,qw,qx,qy,qz\n5,1,2,3,1,0,0,0\n9,1,2,4,1,0,0,0\n")
    truth = read_mocap_truth(file)
    np.testing.assert_allclose(truth.world_from_cam[1].translation, [1, 2, 4])
