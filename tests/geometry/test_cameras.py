"""What is a camera, and what is not."""

import dataclasses

import numpy as np
import pytest

from engram.errors import CalibrationError
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3

CAMERA = StereoCamera(707.0, 707.0, 601.9, 183.1, 0.537, 1226, 370)


def test_equal_cameras_have_equal_ids_and_a_recalibration_is_another_camera() -> None:
    assert dataclasses.replace(CAMERA).id == CAMERA.id
    for change in ({"fx": 707.0001}, {"baseline_m": 0.538}, {"cam_from_rig": SE3.identity()}):
        assert dataclasses.replace(CAMERA, **change).id != CAMERA.id


def test_depth_is_focal_length_times_baseline_by_disparity() -> None:
    points = CAMERA.triangulate(
        np.array([[601.9, 183.1], [701.9, 133.1]], np.float32), np.array([37.9659, 5.0], np.float32)
    )
    np.testing.assert_allclose(points[0], [0, 0, 10.0], atol=1e-4)
    depth = 707.0 * 0.537 / 5.0
    np.testing.assert_allclose(points[1], [depth * 100 / 707, -depth * 50 / 707, depth], rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": 0.0}, "fx"),
        ({"fy": np.nan}, "fy"),
        ({"baseline_m": -0.5}, "baseline_m"),
        ({"baseline_m": 537.0}, "millimetres"),
        ({"cx": 1300.0}, "cx"),
        ({"cy": -1.0}, "cy"),
        ({"cx": np.inf}, "cx"),
        ({"width": 600, "height": 200}, "outside the image"),
        ({"width": 70_000}, "width"),
    ],
)
def test_what_is_no_camera_is_refused(change: dict[str, float], says: str) -> None:
    with pytest.raises(CalibrationError, match=says):
        dataclasses.replace(CAMERA, **change)
