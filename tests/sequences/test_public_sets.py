"""Readers of RobotCar, TUM-VI, UTIAS and 4Seasons, on small folders in their documented layouts."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from engram.errors import CalibrationError, SequenceError
from engram.frontend.frame import StereoPair
from engram.graph.clock import hour_of_day
from engram.graph.model import Clock
from engram.sequences.layouts import ImageSequence
from engram.sequences.opening import open_drive
from engram.sequences.sequence import session_of

from .synthetic import HEIGHT, WIDTH, camera, picture, write_image

START_US = 1_400_505_794_000_000  # 2014-05-19 13:23 UTC
PAIRS = 5


def pairs_from(start_ns: int, period_ns: int, sigma_px: float = 0.01) -> list[StereoPair]:
    return [
        StereoPair(
            start_ns + index * period_ns,
            *(cv2.GaussianBlur(picture(index, side), (0, 0), sigma_px) for side in range(2)),
            camera(),
        )
        for index in range(PAIRS)
    ]


def write_robotcar(
    folder: Path, pairs: Sequence[StereoPair] | None = None, shift_px: float = 2.0
) -> Path:
    """A traversal whose tables shift the images by some pixels."""
    path = folder / "2014-05-19-13-20-57"
    for pair in pairs or pairs_from(START_US * 1000, 62_500_000, sigma_px=3):
        for side in ("left", "right"):
            file = path / "stereo" / side / f"{pair.stamp_ns // 1000}.png"
            write_image(file, getattr(pair, side))
    models = folder / "models"
    models.mkdir()
    columns, rows = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    for name in ("stereo_wide_left", "stereo_wide_right"):
        (models / f"{name}.txt").write_text("40.0 40.0 23.5 15.5\n0 0 1 0\n1 0 0 0\n0 1 0 0\n")
        table = np.stack([columns + shift_px, rows])
        (models / f"{name}_distortion_lut.bin").write_bytes(table.astype("<f8").tobytes())
    return path


class TestRobotCar:
    def test_pairs_are_debayered_and_rectified_by_the_tables(self, tmp_path) -> None:
        drive = open_drive(write_robotcar(tmp_path))
        assert isinstance(drive, ImageSequence)
        assert drive.info.format == "robotcar"
        assert len(drive) == PAIRS
        pair = drive.read(1)
        assert pair.stamp_ns == (START_US + 62_500) * 1000
        raw = cv2.GaussianBlur(picture(1, 0), (0, 0), 3)
        grey = cv2.cvtColor(cv2.cvtColor(raw, cv2.COLOR_BayerGBRG2BGR), cv2.COLOR_BGR2GRAY)
        np.testing.assert_array_equal(pair.left[:, :-2], grey[:, 2:])

    def test_the_camera_is_the_wide_pair(self, tmp_path) -> None:
        camera = open_drive(write_robotcar(tmp_path)).camera
        assert (camera.fx, camera.cx, camera.baseline_m) == (40.0, 23.5, 0.24)

    def test_other_tables_are_another_camera(self, tmp_path) -> None:
        (tmp_path / "a").mkdir()
        (tmp_path / "b").mkdir()
        one = open_drive(write_robotcar(tmp_path / "a"))
        other = open_drive(write_robotcar(tmp_path / "b", shift_px=1.0))
        assert one.camera != other.camera

    def test_the_hour_is_that_of_the_sun_at_oxford(self, tmp_path) -> None:
        drive = open_drive(write_robotcar(tmp_path))
        assert drive.info.clock is Clock.UTC
        session = session_of(drive.info, drive.camera, START_US * 1000, "")
        assert hour_of_day(session, START_US * 1000) == pytest.approx(13.303, abs=0.001)

    def test_images_without_a_partner_are_left_out(self, tmp_path) -> None:
        path = write_robotcar(tmp_path)
        (path / "stereo" / "right" / f"{START_US}.png").unlink()
        assert len(open_drive(path)) == PAIRS - 1

    def test_a_missing_side_is_named(self, tmp_path) -> None:
        path = write_robotcar(tmp_path)
        shutil.rmtree(path / "stereo" / "right")
        with pytest.raises(SequenceError, match="right: the image folder is missing"):
            open_drive(path)

    def test_missing_models_say_where_to_get_them(self, tmp_path) -> None:
        path = write_robotcar(tmp_path)
        (tmp_path / "models" / "stereo_wide_left.txt").unlink()
        with pytest.raises(CalibrationError, match=r"models.*software kit"):
            open_drive(path)

    def test_a_table_of_another_size_is_refused(self, tmp_path) -> None:
        path = write_robotcar(tmp_path)
        (tmp_path / "models" / "stereo_wide_right_distortion_lut.bin").write_bytes(bytes(80))
        with pytest.raises(CalibrationError, match=r"80 bytes, must be 16 for each of 48×32"):
            open_drive(path)


CAMCHAIN = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0007, -0.002, 0.0002]
  distortion_model: equidistant
  intrinsics: [19.0, 19.0, 23.5, 15.5]
  resolution: [48, 32]
  T_cam_imu: [[1, 0, 0, 0.05], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0007, -0.002, 0.0002]
  distortion_model: equidistant
  intrinsics: [19.0, 19.0, 23.5, 15.5]
  resolution: [48, 32]
  T_cn_cnm1: [[1, 0, 0, -0.101], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  rostopic: /cam1/image_raw
"""


def write_tumvi(folder: Path, pairs: Sequence[StereoPair] | None = None) -> Path:
    path = folder / "dataset-room1_512_16"
    pairs = pairs or pairs_from(1_520_530_308_199_447_626, 50_000_000)
    for side, name in enumerate(("left", "right")):
        folder = path / "mav0" / f"cam{side}"
        for pair in pairs:
            image = getattr(pair, name).astype(np.uint16) * 257
            write_image(folder / "data" / f"{pair.stamp_ns}.png", image)
        lines = "\n".join(f"{pair.stamp_ns},{pair.stamp_ns}.png" for pair in pairs)
        (folder / "data.csv").write_text(f"#timestamp [ns],filename\n{lines}\n")
    (path / "dso").mkdir()
    (path / "dso" / "camchain.yaml").write_text(CAMCHAIN)
    return path


class TestTumVi:
    @pytest.fixture
    def path(self, tmp_path: Path) -> Path:
        return write_tumvi(tmp_path)

    def test_it_is_told_from_euroc_and_rectified_to_a_pinhole(self, path: Path) -> None:
        drive = open_drive(path, field_of_view_deg=80.0)
        assert isinstance(drive, ImageSequence)
        assert drive.info.format == "tum-vi"
        assert len(list(drive)) == PAIRS
        view = np.rad2deg(2 * np.arctan(WIDTH / 2 / drive.camera.fx))
        assert view == pytest.approx(80.0, abs=0.01)
        assert drive.camera.baseline_m == pytest.approx(0.101)
        assert drive.camera.cam_from_rig is not None
        assert drive.camera.cam_from_rig.translation[0] == pytest.approx(0.05)


def write_utias(folder: Path, pairs: Sequence[StereoPair] | None = None) -> Path:
    """A run of key frames whose numbers skip one."""
    path = folder / "run_000003"
    lines = []
    for index, pair in enumerate(pairs or pairs_from(START_US * 1000, 400_000_000)):
        number = index + (index > 2)
        for side in ("left", "right"):
            write_image(path / "images" / side / f"{number:06d}.png", getattr(pair, side))
        lines.append(f"{number},{pair.stamp_ns}")
    (path / "timestamps_images.txt").write_text("\n".join(lines) + "\n")
    return path


class TestUtias:
    def test_frames_have_the_stamps_of_their_numbers(self, tmp_path) -> None:
        drive = open_drive(write_utias(tmp_path))
        assert drive.info.format == "utias"
        assert drive.info.clock is Clock.UTC
        pairs = list(drive)
        assert [one.stamp_ns for one in pairs] == [
            START_US * 1000 + 400_000_000 * k for k in range(PAIRS)
        ]
        np.testing.assert_allclose(pairs[4].right, pairs_from(0, 1)[4].right, atol=1)

    def test_the_camera_is_that_of_the_page_at_the_size_of_the_images(self, tmp_path) -> None:
        camera = open_drive(write_utias(tmp_path)).camera
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert camera.fx == pytest.approx(387.777 * WIDTH / 512)
        assert camera.baseline_m == 0.239965

    def test_an_image_without_stamp_and_a_stamp_without_image_are_told(self, tmp_path) -> None:
        path = write_utias(tmp_path)
        (path / "images" / "left" / "000001.png").unlink()
        with pytest.raises(SequenceError, match=r"000001\.png: missing"):
            list(open_drive(path))
        stamps = path / "timestamps_images.txt"
        stamps.write_text("".join(stamps.read_text().splitlines(keepends=True)[2:-1]))
        with pytest.raises(SequenceError, match="extra image"):
            list(open_drive(path))

    @pytest.mark.parametrize("line", ["0;1", "x,1", "1", "0,1.5", "0,1400000000000000000"])
    def test_a_line_that_is_not_frame_and_stamp_is_refused(self, tmp_path, line: str) -> None:
        path = write_utias(tmp_path)
        stamps = path / "timestamps_images.txt"
        stamps.write_text(stamps.read_text() + line + "\n")
        with pytest.raises(SequenceError, match="line 6 is not 'frame,stamp_ns'"):
            open_drive(path)


def write_fourseasons(
    folder: Path, pairs: Sequence[StereoPair] | None = None, baseline_m: float = -0.1
) -> Path:
    """A recording, with its calibration one folder up; both signs of the baseline are met."""
    path = folder / "recording_2020-10-07_14-47-51"
    for pair in pairs or pairs_from(START_US * 1000, 33_333_333):
        for side, name in (("left", "cam0"), ("right", "cam1")):
            file = path / "undistorted_images" / name / f"{pair.stamp_ns}.png"
            write_image(file, getattr(pair, side))
    calibration = folder / "calibration"
    calibration.mkdir()
    text = (
        f"Pinhole 40.0 40.0 23.5 15.5 0.0 0.0 0.0 0.0\n{WIDTH} {HEIGHT}\ncrop\n{WIDTH} {HEIGHT}\n"
    )
    for number in (0, 1):
        (calibration / f"undistorted_calib_{number}.txt").write_text(text)
    pose = np.eye(4)
    pose[0, 3] = baseline_m
    np.savetxt(calibration / "undistorted_calib_stereo.txt", pose)
    return path


class TestFourSeasons:
    @pytest.mark.parametrize("baseline_m", [-0.1, 0.1])
    def test_pairs_and_camera(self, tmp_path, baseline_m: float) -> None:
        drive = open_drive(write_fourseasons(tmp_path, baseline_m=baseline_m))
        assert drive.info.format == "4seasons"
        assert (drive.camera.fx, drive.camera.cx, drive.camera.baseline_m) == (40.0, 23.5, 0.1)
        pairs = list(drive)
        assert [one.stamp_ns for one in pairs] == [
            START_US * 1000 + 33_333_333 * k for k in range(PAIRS)
        ]
        np.testing.assert_allclose(pairs[2].left, pairs_from(0, 1)[2].left, atol=1)

    def test_a_missing_calibration_is_named(self, tmp_path) -> None:
        path = write_fourseasons(tmp_path)
        shutil.rmtree(tmp_path / "calibration")
        with pytest.raises(CalibrationError, match="it is a separate file of the data set"):
            open_drive(path)

    @pytest.mark.parametrize(
        ("name", "text", "said"),
        [
            ("undistorted_calib_0.txt", "Pinhole 40 40 23.5", "must be 'Pinhole fx fy cx cy'"),
            ("undistorted_calib_0.txt", "EquiDistant 40 40 23 15\n48 32", "must be 'Pinhole"),
            ("undistorted_calib_1.txt", "Pinhole 40 40 23 15 0.1\n48 32", "without distortion"),
            (
                "undistorted_calib_1.txt",
                "Pinhole 41 41 23 15\n48 32",
                "differ: they are not a pair",
            ),
            ("undistorted_calib_stereo.txt", "1 0 0", "must hold 16 finite numbers, not 3"),
            ("undistorted_calib_stereo.txt", "1 0 0 x", "could not convert"),
            (
                "undistorted_calib_stereo.txt",
                "1 0 0 .3  0 1 0 .1  0 0 1 0  0 0 0 1",
                "a shift along x only",
            ),
        ],
    )
    def test_a_wrong_calibration_is_refused(self, tmp_path, name, text, said) -> None:
        path = write_fourseasons(tmp_path)
        (tmp_path / "calibration" / name).write_text(text)
        with pytest.raises(CalibrationError, match=said):
            open_drive(path)
