"""Rectified stereo cameras, identified by a hash of their calibration (method §2.6)."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from numbers import Real
from typing import NewType

import numpy as np
from numpy.typing import NDArray

from engram.errors import CalibrationError
from engram.geometry.se3 import SE3

CameraId = NewType("CameraId", str)

# Longest baseline, metres; a baseline given in millimetres exceeds it.
LONGEST_BASELINE_M = 20.0

# Landmarks store pixels in 16 bits.
_MAX_SIDE_PX = 65535


@dataclass(frozen=True, slots=True, eq=False)
class StereoCamera:
    """A rectified pinhole stereo pair; its frame is the left camera's.

    Pixel centres are at integers. A recalibration gives another camera: `id` is a hash of the other
    fields.

    Attributes:
        fx, fy, cx, cy: intrinsics of both rectified images, px.
        baseline_m: distance of the right camera to the right of the left one, metres, > 0.
        width, height: image size, px.
        cam_from_rig: mounting of the left camera on the robot, if known.
        rectification: hash of the raw calibration of the images; "" for images that come
            rectified.
        id: 32 hexadecimal digits, equal for equal cameras.

    Raises:
        CalibrationError: a value is not finite or not positive, the principal point lies outside
            the image, or the baseline is longer than any robot.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float
    width: int
    height: int
    cam_from_rig: SE3 | None = None
    rectification: str = ""
    id: CameraId = field(init=False)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            number = isinstance(value, int | float | np.number)
            if not number or value % 1 != 0 or not 1 <= value <= _MAX_SIDE_PX:
                raise CalibrationError(
                    f"camera: {name} is {value!r}, must be a whole number, 1 to {_MAX_SIDE_PX} px"
                )
        for name in ("fx", "fy", "cx", "cy", "baseline_m"):
            if not isinstance(getattr(self, name), Real):
                raise CalibrationError(f"camera: {name} is {getattr(self, name)!r}, not a number")
        for name in ("fx", "fy", "baseline_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise CalibrationError(f"camera: {name} is {value}, must be finite and > 0")
        for name, size in (("cx", self.width), ("cy", self.height)):
            value = getattr(self, name)
            if not 0 <= value <= size:
                raise CalibrationError(
                    f"camera: {name} is {value}, outside the image of {self.width}×{self.height} "
                    "px: is this the calibration of these images?"
                )
        if self.baseline_m > LONGEST_BASELINE_M:
            raise CalibrationError(
                f"camera: baseline_m is {self.baseline_m}, must be at most {LONGEST_BASELINE_M} m: "
                "is it in millimetres? divide it by 1000"
            )
        object.__setattr__(self, "id", _content_hash(self))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StereoCamera) and self.id == other.id

    def __hash__(self) -> int:
        return hash(self.id)

    @property
    def focal_baseline(self) -> float:
        """fx·b in px·m: depth (m) is this divided by disparity (px)."""
        return self.fx * self.baseline_m

    def triangulate(
        self, pixels: NDArray[np.float32], disparity_px: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Points (N, 3) in the camera frame, m, from left pixels (N, 2) and disparities (N,), px.

        Source: method §2.3, ``z = fx·b/d``.
        """
        depth_m = self.focal_baseline / disparity_px.astype(np.float64)
        points = np.empty((len(pixels), 3), dtype=np.float32)
        points[:, 0] = (pixels[:, 0] - self.cx) / self.fx * depth_m
        points[:, 1] = (pixels[:, 1] - self.cy) / self.fy * depth_m
        points[:, 2] = depth_m
        return points


def _content_hash(camera: StereoCamera) -> CameraId:
    content = [
        *(float(getattr(camera, name)).hex() for name in ("fx", "fy", "cx", "cy", "baseline_m")),
        int(camera.width),
        int(camera.height),
        None
        if camera.cam_from_rig is None
        else [float(value).hex() for value in camera.cam_from_rig.matrix()[:3].ravel()],
        camera.rectification,
    ]
    return CameraId(hashlib.sha256(json.dumps(content).encode()).hexdigest()[:32])
