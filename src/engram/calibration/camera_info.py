"""ROS `CameraInfo`: in messages, and in the YAML files of the `camera_calibration` package.

Source: sensor_msgs/CameraInfo. Raw images: x = K·distort(X); `R` rotates the camera to its
rectified one; `P` = [K' | −fx'·baseline] projects the rectified pair, as seen from the left camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.calibration.cameras import Cameras, rectified_cameras
from engram.calibration.entries import coefficients, distortion_model, numbers, pixels
from engram.errors import CalibrationError
from engram.geometry import SE3, StereoCamera
from engram.geometry.rectification import DistortionModel, RawCamera, RawStereoCalibration

# The two projections of a rectified pair share focal length and rows, px.
_SAME_PX = 1e-3
# K and P of an ideal, rectified camera agree to the digits that drivers print.
_IDEAL_PX = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfo:
    """Calibration of one camera as ROS states it.

    Attributes:
        width, height: image size, px.
        model: model of the lens.
        d: its coefficients.
        k: (3, 3) float64, intrinsics of the raw image, px.
        r: (3, 3) float64, rotation of the raw camera to the rectified one.
        p: (3, 4) float64, projection of the rectified image, px and px·m.
        frame: name of the camera's frame.
    """

    width: int
    height: int
    model: DistortionModel
    d: tuple[float, ...]
    k: NDArray[np.float64]
    r: NDArray[np.float64]
    p: NDArray[np.float64]
    frame: str = ""

    @property
    def is_ideal(self) -> bool:
        """Whether its raw images are rectified already: no distortion, no rotation, K as in P."""
        same = np.abs(self.k - self.p[:, :3]).max() < _IDEAL_PX
        return not any(self.d) and bool(same) and bool(np.abs(self.r - np.eye(3)).max() < 1e-6)

    @property
    def lens(self) -> RawCamera:
        """The raw camera.

        Raises:
            CalibrationError: it is not calibrated.
        """
        model, d = self.model, self.d
        if model is DistortionModel.RADIAL_TANGENTIAL and not any(d):
            model, d = DistortionModel.NONE, ()
        k = self.k
        return RawCamera(
            float(k[0, 0]),
            float(k[1, 1]),
            float(k[0, 2]),
            float(k[1, 2]),
            self.width,
            self.height,
            model,
            d,
        )


def parse_camera_info(entries: dict[str, Any]) -> CameraInfo:
    """The YAML of `camera_calibration`.

    Raises:
        CalibrationError: an entry is missing or malformed.
    """
    model, d = coefficients(
        distortion_model(entries.get("distortion_model", "plumb_bob")),
        lambda counts: numbers(entries, "distortion_coefficients", counts),
    )
    return CameraInfo(
        pixels(entries, "image_width"),
        pixels(entries, "image_height"),
        model,
        d,
        np.array(numbers(entries, "camera_matrix", {9})).reshape(3, 3),
        np.array(numbers(entries, "rectification_matrix", {9})).reshape(3, 3),
        np.array(numbers(entries, "projection_matrix", {12})).reshape(3, 4),
        str(entries.get("camera_name", "")),
    )


def is_camera_info(entries: dict[str, Any]) -> bool:
    """Whether the file is one camera's `camera_info` YAML."""
    return {"camera_matrix", "image_width"} <= entries.keys()


def cameras_of_infos(
    left: CameraInfo,
    right: CameraInfo,
    *,
    rectified: bool,
    right_from_left: SE3 | None = None,
    left_from_rig: SE3 | None = None,
    field_of_view_deg: float | None = None,
) -> Cameras:
    """The stereo pair of two `CameraInfo`.

    Args:
        left, right: the two cameras.
        rectified: whether the images are the rectified ones (`image_rect`).
        right_from_left: relative pose of the raw cameras, metres, if known from elsewhere; used if
            `P` states no baseline.
        left_from_rig: mounting of the left camera, if known.
        field_of_view_deg: of the rectified images, if raw ones are rectified here.

    Raises:
        CalibrationError: it is not a calibrated stereo pair.
    """
    for side, info in (("left", left), ("right", right)):
        if not (info.k[0, 0] > 0 or info.p[0, 0] > 0):
            raise CalibrationError(
                f"the {side} camera is not calibrated: its camera matrix holds only zeros"
            )
    if rectified or (left.is_ideal and right.is_ideal):
        return _rectified(left, right, right_from_left, left_from_rig)
    if right_from_left is None or right.p[0, 3] != 0:
        right_from_left = _relative_pose(left, right)
    raw = RawStereoCalibration(left.lens, right.lens, right_from_left, left_from_rig)
    return rectified_cameras(raw, field_of_view_deg)


def _rectified(
    left: CameraInfo, right: CameraInfo, right_from_left: SE3 | None, mounting: SE3 | None
) -> Cameras:
    apart_px = np.abs(left.p[:2, :3] - right.p[:2, :3]).max()
    if apart_px > _SAME_PX:
        raise CalibrationError(
            f"the projections of the rectified images differ by {apart_px:.4g} px: they are not a "
            "rectified pair"
        )
    fx = float(left.p[0, 0])
    baseline_m = round(float(left.p[0, 3] - right.p[0, 3]) / fx, 9)
    if baseline_m == 0 and right_from_left is not None:
        baseline_m = round(right_from_left.distance_m, 9)
    if baseline_m <= 0:
        raise _no_baseline(baseline_m)
    return Cameras(
        StereoCamera(
            fx,
            float(left.p[1, 1]),
            float(left.p[0, 2]),
            float(left.p[1, 2]),
            baseline_m,
            left.width,
            left.height,
            mounting,
        )
    )


def _relative_pose(left: CameraInfo, right: CameraInfo) -> SE3:
    """right_from_left of the raw cameras, from their rotations and the baseline in P."""
    fx = float(right.p[0, 0])
    baseline_m = float(left.p[0, 3] - right.p[0, 3]) / fx if fx > 0 else 0.0
    if baseline_m <= 0:
        raise _no_baseline(baseline_m)
    shift = np.array([-baseline_m, 0.0, 0.0])
    return SE3(right.r.T @ left.r, right.r.T @ shift)


def _no_baseline(baseline_m: float) -> CalibrationError:
    if baseline_m < 0:
        return CalibrationError(
            f"the projections give a baseline of {baseline_m:.6g} m, must be > 0: are left and "
            "right swapped?"
        )
    return CalibrationError(
        "the right camera's projection P states no baseline: each camera was calibrated alone; "
        "give the pair's calibration with --calibration FILE"
    )
