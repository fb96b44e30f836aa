"""Rectified images are what a pinhole pair with parallel axes would have seen."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from engram.errors import CalibrationError
from engram.geometry.rectification import (
    DistortionModel,
    RawCamera,
    RawStereoCalibration,
    RemapTable,
    rectify,
)
from engram.geometry.se3 import SE3

BROWN = RawCamera(
    458.7, 457.3, 367.2, 248.4, 752, 480, DistortionModel.RADIAL_TANGENTIAL,
    (-0.283, 0.074, 0.0002, 0.00002),
)  # fmt: skip
FISHEYE = RawCamera(
    380.0, 380.5, 370.0, 242.0, 752, 480, DistortionModel.EQUIDISTANT, (-0.01, 0.03, -0.02, 0.004)
)
PINHOLE = RawCamera(450.0, 451.0, 375.0, 240.0, 752, 480)


def calibration(camera: RawCamera) -> RawStereoCalibration:
    right = replace(camera, fx=camera.fx + 2, cx=camera.cx + 8, cy=camera.cy - 5)
    right_from_left = SE3.exp([-0.12, 0.003, -0.002, 0.004, -0.012, 0.008])
    return RawStereoCalibration(camera, right, right_from_left)


def project_raw(camera: RawCamera, points: np.ndarray) -> np.ndarray:
    """The models written out, independently of the code under test."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    radius = np.hypot(x, y)
    if camera.distortion is DistortionModel.EQUIDISTANT:
        k1, k2, k3, k4 = camera.coefficients
        angle = np.arctan(radius)
        bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
        scale = np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1)
        x, y = x * scale, y * scale
    elif camera.distortion is DistortionModel.RADIAL_TANGENTIAL:
        k1, k2, p1, p2 = camera.coefficients
        square = radius**2
        scale = 1 + k1 * square + k2 * square**2
        x, y = (
            x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )
    return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)


def source(table: RemapTable, pixels: np.ndarray) -> np.ndarray:
    """Where pixels (N, 2) int of the rectified image come from in the raw one."""
    u, v = pixels[:, 0], pixels[:, 1]
    fraction = table.fractions[v, u].astype(int)
    # OpenCV's fixed point: five bits of u below five bits of v.
    sub_pixel = np.stack([fraction % 32, fraction // 32], axis=1) / 32
    return table.pixels[v, u] + sub_pixel


@pytest.mark.parametrize("camera", [BROWN, FISHEYE, PINHOLE], ids=["brown", "fisheye", "pinhole"])
def test_a_point_is_seen_where_the_rectified_camera_says(camera: RawCamera) -> None:
    raw = calibration(camera)
    result = rectify(raw)
    rectified = result.camera
    rng = np.random.default_rng(3)
    pixels = rng.integers([60, 40], [690, 440], (200, 2))
    depths_m = rng.uniform(1, 30, 200)
    points = np.stack(
        [
            (pixels[:, 0] - rectified.cx) / rectified.fx * depths_m,
            (pixels[:, 1] - rectified.cy) / rectified.fy * depths_m,
            depths_m,
        ],
        axis=1,
    )
    points_in_raw_left = result.rectified_from_raw.inverse() @ points
    # The tables have steps of 1/32 px.
    np.testing.assert_allclose(
        source(result.left, pixels), project_raw(raw.left, points_in_raw_left), atol=0.03
    )
    # In the right image the point lies in the same row, by its disparity to the left.
    right_columns = pixels[:, 0] - rectified.focal_baseline / depths_m
    whole = np.floor(right_columns).astype(int)
    seen = (whole >= 0) & (whole + 1 < 752)
    share = (right_columns - whole)[seen, None]
    before, after = (
        source(result.right, np.stack([whole[seen] + step, pixels[seen, 1]], axis=1))
        for step in (0, 1)
    )
    np.testing.assert_allclose(
        (1 - share) * before + share * after,
        project_raw(raw.right, raw.right_from_left @ points_in_raw_left[seen]),
        atol=0.04,
    )


def test_every_rectified_pixel_is_seen() -> None:
    result = rectify(calibration(BROWN))
    white = np.full((480, 752), 255, dtype=np.uint8)
    for table in (result.left, result.right):
        image = cv2.remap(white, table.pixels, table.fractions, cv2.INTER_LINEAR)
        # OpenCV bounds the visible area by nine points on each side, so slivers may remain.
        assert (image == 255).mean() > 0.995


def test_the_camera_remembers_its_raw_calibration() -> None:
    raw = calibration(BROWN)
    again = rectify(calibration(BROWN)).camera
    assert rectify(raw).camera == again
    assert again.rectification == raw.content_hash()
    other = replace(raw, left=replace(raw.left, coefficients=(-0.284, 0.074, 0.0002, 0.00002)))
    assert rectify(other).camera.rectification != again.rectification


def test_the_mounting_is_that_of_the_rectified_camera() -> None:
    mounting = SE3.exp([0.1, 0.2, -0.3, 0.4, 0.5, -0.6])
    result = rectify(replace(calibration(BROWN), left_from_rig=mounting))
    assert result.camera.cam_from_rig is not None
    np.testing.assert_allclose(
        result.camera.cam_from_rig.matrix(),
        (result.rectified_from_raw @ mounting).matrix(),
        atol=1e-9,
    )


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"right_from_left": SE3.exp([0.12, 0, 0, 0, 0, 0])}, "swap the two cameras"),
        ({"right_from_left": SE3.exp([-0.01, -0.12, 0, 0, 0, 0])}, "largest part"),
        ({"right_from_left": SE3.identity()}, "right camera is at"),
        ({"right": replace(BROWN, width=640)}, "equal sizes"),
        ({"right": FISHEYE}, "pairs only with a fisheye"),
    ],
)
def test_what_makes_no_pair_is_refused(change: dict, fact: str) -> None:
    with pytest.raises(CalibrationError, match=fact):
        rectify(replace(calibration(BROWN), **change))


@pytest.mark.parametrize(
    "change",
    [
        {"fx": 0.0},
        {"fy": float("nan")},
        {"cx": 1e9},
        {"width": 0},
        {"height": 10**9},
        {"coefficients": (0.1,)},
        {"coefficients": (0.1, float("inf"), 0, 0)},
        {"distortion": DistortionModel.NONE},
    ],
)
def test_what_is_no_camera_is_refused(change: dict) -> None:
    with pytest.raises(CalibrationError):
        replace(BROWN, **change)


def test_a_lens_that_bends_everything_out_of_sight_is_refused() -> None:
    for coefficients in ((-0.28, 0.07, 1e200, 0.0), (-0.28, 0.07, 0.0, 1e200)):
        raw = calibration(BROWN)
        right = replace(raw.right, coefficients=coefficients)
        with pytest.raises(CalibrationError, match="leaves no usable image"):
            rectify(replace(raw, right=right))
