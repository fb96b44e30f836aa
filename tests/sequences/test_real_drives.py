"""The readers on real drives, against facts stated beside the data."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from engram.frontend.frontend import Frontend
from engram.graph.model import Clock
from engram.odometry.odometry import Odometry
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FrameLogWriter
from engram.sequences.opening import open_drive
from engram.sequences.sequence import LoggedFrame, first_pair_hash, session_of

from .bag_maker import StereoBag, kalibr_chain, rectified_infos

pytestmark = pytest.mark.data

RAW_DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync"


def test_kitti_odometry_06(data_dir: Path) -> None:
    drive = open_drive(data_dir / "kitti_odometry/sequences/06")
    pairs = list(drive)
    assert len(drive) == len(pairs) == 51
    assert all(pair.left.shape == pair.right.shape == (370, 1226) for pair in pairs)
    assert drive.info.clock is Clock.RELATIVE
    assert drive.camera.fx == 707.0912
    assert drive.camera.baseline_m == pytest.approx(379.8145 / 707.0912, abs=1e-9)
    assert pairs[1].stamp_ns == 104_498_900
    assert drive.skipped == 0


def test_kitti_raw_has_two_rigs_that_stand_apart_as_stated(data_dir: Path) -> None:
    grey = open_drive(data_dir / RAW_DRIVE)
    colour = open_drive(data_dir / RAW_DRIVE, rig="colour")
    assert len(grey) == len(colour) == 54
    assert grey.camera.baseline_m == pytest.approx(0.5372, abs=1e-4)
    assert colour.camera.baseline_m == pytest.approx(0.5327, abs=1e-4)
    assert grey.camera.cam_from_rig is not None
    assert colour.camera.cam_from_rig is not None
    cam0_from_cam2 = grey.camera.cam_from_rig @ colour.camera.cam_from_rig.inverse()
    np.testing.assert_allclose(
        cam0_from_cam2.translation, [-0.0598, 0.0004, -0.0027], atol=1e-4
    )  # the data's description gives four digits
    assert grey.info.clock is Clock.UTC
    assert grey.stamps_ns[0] == 1_317_042_145_967_790_592  # 2011-09-26 13:02:25.967790592
    assert np.abs(grey.stamps_ns - colour.stamps_ns).max() < 9_000_000


def test_one_colour_channel_looks_unlike_grey(data_dir: Path) -> None:
    images = {
        channel: open_drive(data_dir / RAW_DRIVE, rig="colour", channel=channel).read(0).left
        for channel in ("grey", "red", "green", "blue")
    }
    grey = images["grey"].astype(float)
    mix = 0.299 * images["red"] + 0.587 * images["green"] + 0.114 * images["blue"]
    np.testing.assert_allclose(grey, mix, atol=0.51)  # rounded to whole grey levels
    assert np.abs(images["blue"] - grey).mean() > 2


def test_euroc_rectifies_to_the_reference(data_dir: Path) -> None:
    folder = data_dir / "euroc/V1_01_easy_sparse"
    drive = open_drive(folder)
    reference = json.loads((folder / "rectified_calibration_for_reference.json").read_text())
    assert drive.rectification is not None
    np.testing.assert_allclose(
        drive.rectification.rectified_from_raw.rotation, reference["R0"], atol=1e-7
    )
    for name in ("fx", "fy", "cx", "cy", "baseline_m"):
        assert getattr(drive.camera, name) == pytest.approx(reference[name], abs=1e-6)
    assert (drive.camera.width, drive.camera.height) == (752, 480)
    assert len(drive) == 63
    with (folder / "revisit_pairs.csv").open() as file:
        named = {int(row["earlier_ns"]) for row in csv.DictReader(file)}
    assert named <= set(drive.stamps_ns.tolist())


def test_rectified_rows_agree(data_dir: Path) -> None:
    drive = open_drive(data_dir / "euroc/V1_01_easy_sparse", frames="::6")
    orb = cv2.ORB_create(1000)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    row_offsets = []
    for pair in drive:
        left_points, left_codes = orb.detectAndCompute(pair.left, None)
        right_points, right_codes = orb.detectAndCompute(pair.right, None)
        for match in matcher.match(left_codes, right_codes):
            left, right = left_points[match.queryIdx].pt, right_points[match.trainIdx].pt
            if match.distance < 30 and -1 < left[0] - right[0] < 80:
                row_offsets.append(left[1] - right[1])
    assert len(row_offsets) > 500
    # ORB's corners scatter by about a pixel on its coarser levels; the median does not.
    assert abs(np.median(row_offsets)) < 0.5


def test_at_rest_the_pictures_stay(data_dir: Path) -> None:
    pairs = list(open_drive(data_dir / "euroc/V1_01_easy_at_rest"))
    assert len(pairs) == 10
    first = pairs[0].left.astype(np.float32)
    for pair in pairs:
        (right_px, down_px), _ = cv2.phaseCorrelate(first, pair.left.astype(np.float32))
        # The exposure drifts, so grey levels differ; 2 px is a quarter of a degree.
        assert np.hypot(right_px, down_px) < 2.0


def test_a_log_stands_for_its_drive(data_dir: Path, tmp_path: Path) -> None:
    drive = open_drive(data_dir / "kitti_odometry/sequences/06", frames=":5")
    frontend, odometry = Frontend(), Odometry()
    path = tmp_path / "06.framelog"
    wanted, writer = [], None
    for pair in drive:
        frame = frontend.extract(pair)
        writer = writer or FrameLogWriter(
            path, FrameLogHeader(drive.info, drive.camera, frame.descriptor, frame.frontend)
        )
        wanted.append(LoggedFrame(frame, odometry.step(frame)))
        writer.append(wanted[-1], first_pair_hash(pair))
    writer.close(complete=True)
    log = open_drive(path)
    for found, made in zip(log, wanted, strict=True):
        for name in type(made.frame.landmarks).__slots__:
            np.testing.assert_array_equal(
                getattr(found.frame.landmarks, name), getattr(made.frame.landmarks, name)
            )
        assert found.odometry.status is made.odometry.status
    # A few tens of kilobytes a frame, where the two images have 800 kB decoded and 450 stored.
    assert path.stat().st_size / len(wanted) < 60_000
    first = drive.read(0)
    assert session_of(
        log.info, log.camera, int(log.stamps_ns[0]), log.first_pair_hash
    ) == session_of(drive.info, drive.camera, first.stamp_ns, first_pair_hash(first))


@pytest.mark.parametrize("frames", [None, "10:30:3"])
def test_the_same_drive_has_the_same_first_pair(data_dir: Path, frames: str | None) -> None:
    path = data_dir / "kitti_odometry/sequences/06"
    once, again = (next(iter(open_drive(path, frames=frames))) for _ in range(2))
    assert first_pair_hash(once) == first_pair_hash(again)
    other = open_drive(path).read(7)
    assert first_pair_hash(other) != first_pair_hash(once)


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
@pytest.mark.parametrize("png", [False, True])
def test_a_bag_of_kitti_06_holds_the_folders_frames(data_dir, tmp_path, kind, png) -> None:
    drive = open_drive(data_dir / "kitti_odometry/sequences/06", frames="::10")
    pairs = [(pair.stamp_ns, pair.left, pair.right) for pair in drive]
    made = StereoBag(pairs, rectified_infos(drive.camera), png=png).write(tmp_path / "b", kind)
    bag = open_drive(made)
    assert bag.camera.fx == drive.camera.fx
    assert bag.camera.baseline_m == drive.camera.baseline_m
    for found, (stamp_ns, left, right) in zip(bag, pairs, strict=True):
        assert found.stamp_ns == stamp_ns
        np.testing.assert_array_equal(found.left, left)
        np.testing.assert_array_equal(found.right, right)


def test_a_raw_bag_of_euroc_with_a_kalibr_chain_is_rectified_as_the_folder(
    data_dir: Path, tmp_path: Path
) -> None:
    folder = data_dir / "euroc/V1_01_easy_sparse"
    drive = open_drive(folder, frames="::9")
    raw = drive.cameras.raw
    topics = ("/cam0/image_raw", "/cam1/image_raw")
    wanted = list(drive)
    pairs = [
        (
            pair.stamp_ns,
            *(
                cv2.imread(str(folder / f"mav0/cam{side}/data/{pair.stamp_ns}.jpg"), 0)
                for side in range(2)
            ),
        )
        for pair in wanted
    ]
    made = StereoBag(pairs, None, topics=topics).write(tmp_path / "b", "ros1")
    chain = tmp_path / "camchain.yaml"
    chain.write_text(kalibr_chain(raw, topics))
    bag = open_drive(made, calibration=chain)
    assert bag.camera.fx == pytest.approx(drive.camera.fx, abs=1e-6)
    assert bag.camera.cam_from_rig is not None
    for found, pair in zip(bag, wanted, strict=True):
        for one, other in ((found.left, pair.left), (found.right, pair.right)):
            np.testing.assert_array_equal(one, other)
