"""Calibrations of every format: what they say, what is refused, and what fisheyes become."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.calibration.calibrated_pair import Cameras, read_yaml, rectified_cameras
from engram.calibration.formats import read_calibration
from engram.calibration.toml import calibration_toml, parse_toml
from engram.errors import CalibrationError, ConfigError
from engram.frontend.frame import StereoPair
from engram.frontend.frontend import Frontend
from engram.geometry.rectification import DistortionModel, RawCamera, RawStereoCalibration
from engram.geometry.se3 import SE3
from engram.sequences.bags.bag_sequence import BagSequence, describe_bag
from engram.sequences.opening import open_drive
from engram.sequences.sequence import OpenOptions
from engram_lab.bench.data import synthetic_drive

from .bag_maker import LEFT, RIGHT, StereoBag, bag, rectified_infos
from .synthetic import LAYOUTS, camera, only_engram_errors, picture, stamp_ns

# A pair with a little of everything: turned against each other, distorted.
TURN = SE3.exp(np.array([0, 0, 0, 0.01, -0.02, 0.015]))
RIGHT_FROM_LEFT = SE3(TURN.rotation, np.array([-0.2, 0.002, 0.001]))
RAW = RawStereoCalibration(
    RawCamera(
        300.0, 301.0, 160.5, 119.5, 320, 240, DistortionModel.RADIAL_TANGENTIAL,
        (-0.28, 0.07, 0.0002, 0.00002),
    ),
    RawCamera(
        302.0, 303.0, 158.5, 121.5, 320, 240, DistortionModel.RADIAL_TANGENTIAL,
        (-0.27, 0.06, -0.0001, 0.0001),
    ),
    RIGHT_FROM_LEFT,
)  # fmt: skip
REFERENCE = rectified_cameras(RAW)

CAMCHAIN = """cam0:
  cam_overlaps: [1]
  camera_model: {model}
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [300.0, 301.0, 160.5, 119.5]
  resolution: [320, 240]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  {rows}
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.27, 0.06, -0.0001, 0.0001]
  distortion_model: {lens}
  intrinsics: [302.0, 303.0, 158.5, 121.5]
  resolution: [320, 240]
  rostopic: /cam1/image_raw
"""


def camchain(model: str = "pinhole", lens: str = "radtan") -> str:
    rows = "\n  ".join(f"- [{', '.join(map(repr, row))}]" for row in rows_of(RIGHT_FROM_LEFT))
    return CAMCHAIN.format(model=model, lens=lens, rows=rows)


def rows_of(transform: SE3) -> list[list[float]]:
    return transform.matrix().tolist()


def ros_infos(raw: RawStereoCalibration = RAW) -> tuple[dict, dict]:
    """What `camera_calibration` computes of a pair: rotations and projections by OpenCV."""
    left, right = raw.left, raw.right
    r0, r1, p0, p1, *_ = cv2.stereoRectify(
        left.matrix, np.array(left.coefficients), right.matrix, np.array(right.coefficients),
        (left.width, left.height), raw.right_from_left.rotation,
        raw.right_from_left.translation.reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0,
    )  # fmt: skip
    size = {"width": left.width, "height": left.height}
    return (
        {**size, "d": [*left.coefficients, 0.0], "k": left.matrix, "r": r0, "p": p0},
        {**size, "d": [*right.coefficients, 0.0], "k": right.matrix, "r": r1, "p": p1},
    )


def ros_yaml(info: dict, side: str) -> str:
    def table(name: str, values, rows: int) -> str:
        flat = np.ravel(values).tolist()
        return f"{name}:\n  rows: {rows}\n  cols: {len(flat) // rows}\n  data: {flat}\n"

    return (
        f"image_width: {info['width']}\nimage_height: {info['height']}\ncamera_name: {side}\n"
        + table("camera_matrix", info["k"], 3)
        + "distortion_model: plumb_bob\n"
        + table("distortion_coefficients", info["d"], 1)
        + table("rectification_matrix", info["r"], 3)
        + table("projection_matrix", info["p"], 3)
    )


def write_ros(folder: Path) -> Path:
    for side, info in zip(("left", "right"), ros_infos(), strict=True):
        (folder / f"{side}.yaml").write_text(ros_yaml(info, side))
    return folder / "left.yaml"


def write_opencv(folder: Path, *, apart: bool = False) -> Path:
    intrinsics, extrinsics = folder / "intrinsics.yml", folder / "extrinsics.yml"
    matrices = {
        "M1": RAW.left.matrix, "D1": np.array([RAW.left.coefficients]),
        "M2": RAW.right.matrix, "D2": np.array([RAW.right.coefficients]),
    }  # fmt: skip
    pose = {"R": RIGHT_FROM_LEFT.rotation, "T": RIGHT_FROM_LEFT.translation.reshape(3, 1)}
    parts = (matrices, pose) if apart else ({**matrices, **pose}, {})
    for path, part in zip((intrinsics, extrinsics), parts, strict=True):
        if part:
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
            for name, value in part.items():
                storage.write(name, value)
            storage.release()
    return intrinsics


def assert_same(found: Cameras, wanted: Cameras = REFERENCE, atol: float = 1e-6) -> None:
    for name in ("fx", "fy", "cx", "cy", "baseline_m"):
        assert getattr(found.camera, name) == pytest.approx(getattr(wanted.camera, name), abs=atol)
    assert (found.camera.width, found.camera.height) == (320, 240)


class TestFormats:
    def test_kalibr(self, tmp_path) -> None:
        path = tmp_path / "camchain.yaml"
        path.write_text(camchain())
        found = read_calibration(path)
        assert_same(found)
        assert found.topics == ("/cam0/image_raw", "/cam1/image_raw")

    @pytest.mark.parametrize(
        ("change", "fact"),
        [
            ({"model": "omni"}, "only 'pinhole' is supported; calibrate again"),
            ({"model": "eucm"}, "only 'pinhole' is supported"),
            ({"lens": "fov"}, "distortion_model is 'fov'; known"),
        ],
    )
    def test_kalibrs_other_models_are_refused(self, tmp_path, change, fact) -> None:
        path = tmp_path / "camchain.yaml"
        path.write_text(camchain(**change))
        with pytest.raises(CalibrationError, match=fact):
            read_calibration(path)

    def test_ros(self, tmp_path) -> None:
        # P has 4 digits fewer than the poses it is computed from; so has the baseline.
        assert_same(read_calibration(write_ros(tmp_path)), atol=1e-4)
        rectified = read_calibration(write_ros(tmp_path), rectified=True)
        assert rectified.rectification is None
        assert_same(rectified, atol=1e-4)

    def test_ros_needs_both_files(self, tmp_path) -> None:
        path = write_ros(tmp_path)
        (tmp_path / "right.yaml").unlink()
        with pytest.raises(CalibrationError, match=r"left\.yaml and right\.yaml"):
            read_calibration(path)

    @pytest.mark.parametrize("apart", [False, True])
    def test_opencv(self, tmp_path, apart) -> None:
        path = write_opencv(tmp_path, apart=apart)
        assert_same(read_calibration(path, size=lambda: (320, 240)))
        with pytest.raises(CalibrationError, match="states no image size"):
            read_calibration(path)

    def test_toml_comes_back_equal(self) -> None:
        found = parse_toml(calibration_toml(REFERENCE))
        assert found.camera == REFERENCE.camera
        plain = Cameras(camera())
        assert parse_toml(calibration_toml(plain)).camera == plain.camera

    def test_something_else_lists_what_is_known(self, tmp_path) -> None:
        path = tmp_path / "notes.yaml"
        path.write_text("weather: sunny\n")
        with pytest.raises(CalibrationError, match=r"(?s)known are.*Kalibr.*ROS.*OpenCV"):
            read_calibration(path)

    def test_millimetres_are_noticed(self, tmp_path) -> None:
        path = tmp_path / "camchain.yaml"
        path.write_text(camchain().replace("-0.2,", "-200.0,").replace("-0.2]", "-200.0]"))
        with pytest.raises(CalibrationError, match="millimetres"):
            read_calibration(path)

    @pytest.mark.parametrize(
        "text",
        ["", "[" * 50_000, "- " * 40_000, "a: &a [x]\n" + "b: [*a, *a]\n" * 100, "x" * 500_000],
    )
    def test_malicious_yaml_is_refused_soon(self, tmp_path, text) -> None:
        path = tmp_path / "a.yaml"
        path.write_text(text)
        with pytest.raises(CalibrationError):
            read_calibration(path)

    @given(st.text(max_size=200))
    def test_any_text_is_a_table_or_our_error(self, text) -> None:
        error = only_engram_errors(lambda: read_yaml(text))
        assert error is None or isinstance(error, CalibrationError)


def rays(lens: RawCamera, points: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of (N, 3) points in the raw camera, by OpenCV."""
    if lens.distortion is DistortionModel.EQUIDISTANT:
        pixels, _ = cv2.fisheye.projectPoints(
            points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), lens.matrix,
            np.array(lens.coefficients),
        )  # fmt: skip
    else:
        pixels, _ = cv2.projectPoints(
            points, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.coefficients)
        )
    return pixels.reshape(-1, 2)


class TestFisheye:
    FISHEYE = RawStereoCalibration(
        *(
            RawCamera(
                190.0, 190.0, 255.0, 256.0, 512, 512, DistortionModel.EQUIDISTANT,
                (0.0035, 0.0007, -0.002, 0.0002),
            )
            for _ in range(2)
        ),
        RIGHT_FROM_LEFT,
    )  # fmt: skip

    @pytest.mark.parametrize(("asked", "wanted"), [(None, 100.0), (80.0, 80.0), (120.0, 120.0)])
    def test_it_becomes_a_pinhole_of_the_chosen_view(self, asked, wanted) -> None:
        found = rectified_cameras(self.FISHEYE, asked).camera
        view = np.rad2deg(2 * np.arctan(found.width / 2 / found.fx))
        assert view == pytest.approx(wanted, abs=0.01)

    @pytest.mark.parametrize("raw", [RAW, FISHEYE])
    def test_tables_lead_from_the_rectified_pixel_to_the_raw_one(self, raw) -> None:
        cameras = rectified_cameras(raw, 70.0)
        camera, rectification = cameras.camera, cameras.rectification
        assert rectification is not None
        rng = np.random.default_rng(0)
        rectified = rng.uniform([-1, -0.7, 4], [1, 0.7, 9], (50, 3))
        left = rectified @ rectification.rectified_from_raw.rotation
        right = left @ RIGHT_FROM_LEFT.rotation.T + RIGHT_FROM_LEFT.translation
        pixels = rectified[:, :2] / rectified[:, 2:] * [camera.fx, camera.fy] + [
            camera.cx, camera.cy,
        ]  # fmt: skip
        disparity = camera.focal_baseline / rectified[:, 2]
        for table, points, lens, shift in (
            (rectification.left, left, raw.left, 0.0),
            (rectification.right, right, raw.right, disparity),
        ):
            columns = np.rint(pixels[:, 0] - shift).astype(int)
            rows = np.rint(pixels[:, 1]).astype(int)
            found = table.pixels[rows, columns]
            # Rounding to whole pixels on both sides.
            np.testing.assert_allclose(found, rays(lens, points), atol=1.6)

    def test_another_view_is_another_camera(self) -> None:
        ids = {rectified_cameras(self.FISHEYE, view).camera.id for view in (None, 80.0, 120.0)}
        assert len(ids) == 3

    def test_no_pinhole_is_that_wide(self) -> None:
        with pytest.raises(CalibrationError, match="10° to 170°"):
            rectified_cameras(self.FISHEYE, 180.0)


class TestDrives:
    @pytest.mark.parametrize("name", ["euroc", "folder", "kitti", "kitti-raw"])
    def test_a_given_calibration_replaces_the_own(self, tmp_path, name) -> None:
        path = LAYOUTS[name].write(tmp_path)
        given = tmp_path / "given.toml"
        text = calibration_toml(Cameras(camera())).replace("baseline_m = 0.1", "baseline_m = 0.7")
        given.write_text(text)
        assert open_drive(path, calibration=given).camera.baseline_m == 0.7
        LAYOUTS[name].calibration(path).unlink()
        assert open_drive(path, calibration=given).camera.baseline_m == 0.7

    def test_a_view_is_for_raw_images(self, tmp_path) -> None:
        with pytest.raises(CalibrationError, match="rectified already"):
            open_drive(LAYOUTS["kitti"].write(tmp_path), field_of_view_deg=80.0)

    def test_a_kalibr_chain_names_the_topics_of_a_bag(self, tmp_path) -> None:
        topics = ("/cam0/image_raw", "/cam1/image_raw")
        with bag(tmp_path / "b", "mcap") as maker:
            for topic in (*topics, LEFT, RIGHT):  # two pairs: the chain decides
                maker.image(topic, stamp_ns(0), np.full((240, 320), 90, np.uint8))
        (tmp_path / "chain.yaml").write_text(camchain())
        drive = open_drive(tmp_path / "b", calibration=tmp_path / "chain.yaml")
        assert isinstance(drive, BagSequence)
        assert (drive.topics.left, drive.topics.right) == topics
        assert_same(drive.cameras)


class TestBags:
    PAIR = ((stamp_ns(0), np.full((240, 320), 90, np.uint8), np.full((240, 320), 90, np.uint8)),)

    def test_raw_images_are_rectified_by_camera_info(self, tmp_path) -> None:
        path = StereoBag(list(self.PAIR), ros_infos()).write(tmp_path / "b", "ros1")
        drive = open_drive(path)
        assert isinstance(drive, BagSequence)
        assert drive.cameras.rectification is not None
        assert_same(drive.cameras, atol=1e-4)

    def test_the_mounting_comes_from_static_transforms(self, tmp_path) -> None:
        base_from_left = SE3.exp(np.array([0.3, 0.1, 0.5, 1.2, -1.2, 1.2]))
        base_from_mast = SE3.exp(np.array([0.1, 0.0, 0.2, 0.0, 0.0, 0.3]))
        with bag(tmp_path / "b", "sqlite") as maker:
            parts = (
                ("base_link", "mast", base_from_mast),
                ("mast", "left", base_from_mast.inverse() @ base_from_left),
            )
            for parts_ in parts:
                maker.transform(stamp_ns(0), *parts_)
            for side, topic in enumerate((LEFT, RIGHT)):
                maker.image(topic, stamp_ns(0), picture(0, side))
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, stamp_ns(0), rectified_infos(camera())[side], "left")
        found = open_drive(tmp_path / "b").camera.cam_from_rig
        assert found is not None
        np.testing.assert_allclose(found.matrix(), base_from_left.inverse().matrix(), atol=1e-9)

    def test_a_calibration_without_mounting_takes_that_of_the_bag(self, tmp_path) -> None:
        base_from_left = SE3.exp(np.array([0.3, 0.1, 0.5, 1.2, -1.2, 1.2]))
        with bag(tmp_path / "b", "mcap") as maker:
            maker.transform(stamp_ns(0), "base_link", "left", base_from_left)
            for side, topic in enumerate((LEFT, RIGHT)):
                maker.image(topic, *self.PAIR[0][:2])
                name = topic.replace("image_raw", "camera_info")
                maker.info(name, stamp_ns(0), ros_infos()[side], "left")
        (tmp_path / "chain.yaml").write_text(camchain())
        found = open_drive(tmp_path / "b", calibration=tmp_path / "chain.yaml")
        assert isinstance(found, BagSequence)
        alone = open_drive(tmp_path / "b")
        assert isinstance(alone, BagSequence)
        assert found.camera.cam_from_rig is not None
        assert alone.camera.cam_from_rig is not None
        np.testing.assert_allclose(
            found.camera.cam_from_rig.matrix(), alone.camera.cam_from_rig.matrix(), atol=1e-4
        )
        assert found.cameras.raw is not None
        assert found.cameras.raw.left_from_rig is not None
        facts = describe_bag(tmp_path / "b", OpenOptions(calibration=tmp_path / "chain.yaml"))
        assert facts.mounting == "base_link"

    def test_two_cameras_calibrated_alone_are_joined_by_static_transforms(self, tmp_path) -> None:
        infos = [{**info, "r": np.eye(3)} for info in ros_infos()]
        for info in infos:
            info["p"] = np.c_[np.array(info["k"]), np.zeros(3)]
        with bag(tmp_path / "b", "mcap") as maker:
            maker.transform(stamp_ns(0), "left", "right", RIGHT_FROM_LEFT.inverse())
            for side, topic in enumerate((LEFT, RIGHT)):
                maker.image(topic, stamp_ns(0), self.PAIR[0][1])
                name = topic.replace("image_raw", "camera_info")
                maker.info(name, stamp_ns(0), infos[side], ("left", "right")[side])
        drive = open_drive(tmp_path / "b")
        assert isinstance(drive, BagSequence)
        assert_same(drive.cameras)


class TestMask:
    def test_no_landmark_lies_on_the_robot(self) -> None:
        pair = synthetic_drive(frames=1)[0]
        mask = np.ones(pair.left.shape, np.bool_)
        mask[pair.left.shape[0] // 2 :] = False
        masked = StereoPair(pair.stamp_ns, pair.left, pair.right, pair.camera, mask)
        frontend = Frontend()
        everywhere, above = frontend.extract(pair).landmarks, frontend.extract(masked).landmarks
        rows = above.pixels[:, 1]
        assert len(above) > 100
        assert rows.max() < pair.left.shape[0] // 2 - 5
        # The cells on the robot leave their share of landmarks to the others.
        free = (everywhere.pixels[:, 1] < pair.left.shape[0] // 2).sum()
        assert len(above) > 1.1 * free

    def test_it_is_drawn_on_the_drives_own_images(self, tmp_path) -> None:
        path = LAYOUTS["folder"].write(tmp_path)
        mask = np.full((camera().height, camera().width), 255, np.uint8)
        mask[20:] = 0
        cv2.imwrite(str(tmp_path / "mask.png"), mask)
        pair = next(iter(open_drive(path, mask=tmp_path / "mask.png")))
        np.testing.assert_array_equal(pair.mask, mask > 0)

    @pytest.mark.parametrize(
        ("image", "fact"),
        [(np.full((8, 8), 255, np.uint8), "8×8"), (np.zeros((32, 48), np.uint8), "black")],
    )
    def test_a_useless_one_is_refused(self, tmp_path, image, fact) -> None:
        path = LAYOUTS["folder"].write(tmp_path)
        cv2.imwrite(str(tmp_path / "mask.png"), image)
        with pytest.raises(ConfigError, match=fact):
            open_drive(path, mask=tmp_path / "mask.png")
