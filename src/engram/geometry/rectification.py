"""Raw stereo calibration → rectified `StereoCamera` and the tables that rectify its images.

Only tables are computed here; readers apply them (`cv2.remap`).
Source: Bouguet's rectification as in OpenCV's ``stereoRectify``: each camera turns by half of the
rotation between them, then both together until their rows are parallel to the baseline.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from engram.errors import CalibrationError
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3

# Names the method in the hash of a rectification. Change it whenever `rectify` computes other
# values: landmarks from old tables do not fit the new intrinsics.
_METHOD = "bouguet-1"

# Fisheye lenses see up to 190°. A pinhole image of the same size loses its centre to the borders,
# so without a choice it ends here, horizontally.
_WIDEST_FISHEYE_DEG = 100.0

# Cameras closer than this stand at one place, metres.
_SAME_PLACE_M = 1e-4

# Larger images are refused: the four tables of a pair take 12 bytes a pixel.
_MAX_SIDE_PX = 16_384
_MAX_PIXELS = 64_000_000


class DistortionModel(StrEnum):
    """How a lens bends rays.

    `RADIAL_TANGENTIAL` is Brown's polynomial with coefficients k1, k2, p1, p2 [, k3 [, k4, k5,
    k6]] in OpenCV's order; `EQUIDISTANT` the fisheye of Kannala and Brandt with k1, k2, k3, k4.
    """

    NONE = "none"
    RADIAL_TANGENTIAL = "radial-tangential"
    EQUIDISTANT = "equidistant"


_COEFFICIENT_COUNTS = {
    DistortionModel.NONE: {0},
    DistortionModel.RADIAL_TANGENTIAL: {4, 5, 8},
    DistortionModel.EQUIDISTANT: {4},
}


@dataclass(frozen=True, slots=True)
class RawCamera:
    """One camera with its raw images: distorted, not rectified.

    Attributes:
        fx, fy, cx, cy: intrinsics, px; pixel centres at integers.
        width, height: image size, px.
        coefficients: coefficients of the model, see `DistortionModel`.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: DistortionModel = DistortionModel.NONE
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise CalibrationError(f"raw camera: {name} is {value}, must be finite and > 0")
        for name, size in (("cx", self.width), ("cy", self.height)):
            if not 0 < size <= _MAX_SIDE_PX:
                raise CalibrationError(
                    f"raw camera: image size is {self.width}×{self.height}, "
                    f"each side must be 1 to {_MAX_SIDE_PX} px"
                )
            if self.width * self.height > _MAX_PIXELS:
                raise CalibrationError(
                    f"raw camera: image size is {self.width}×{self.height}, at most "
                    f"{_MAX_PIXELS:,} px are rectified"
                )
            value = getattr(self, name)
            if not (np.isfinite(value) and -size <= value <= 2 * size):
                raise CalibrationError(f"raw camera: {name} is {value}, image size is {size} px")
        allowed = _COEFFICIENT_COUNTS[self.distortion]
        if len(self.coefficients) not in allowed:
            raise CalibrationError(
                f"raw camera: distortion {self.distortion.value!r} has "
                f"{' or '.join(map(str, sorted(allowed)))} coefficients, "
                f"not {len(self.coefficients)}"
            )
        if not np.isfinite(self.coefficients).all():
            raise CalibrationError("raw camera: a distortion coefficient is not finite")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The (3, 3) camera matrix, px."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class RawStereoCalibration:
    """Two raw cameras and their relative pose.

    Attributes:
        right_from_left: pose of the left raw camera in the frame of the right one, metres.
        left_from_rig: mounting of the left raw camera on the robot, if known.
    """

    left: RawCamera
    right: RawCamera
    right_from_left: SE3
    left_from_rig: SE3 | None = None

    @property
    def is_exchanged(self) -> bool:
        """Whether the camera called right is the left one of a pair side by side."""
        x, y, _ = self.right_from_left.inverse().translation
        return bool(x < -abs(y))

    def exchanged(self) -> RawStereoCalibration:
        """The same pair with the names of the two cameras exchanged."""
        mounting = self.left_from_rig
        return RawStereoCalibration(
            self.right,
            self.left,
            self.right_from_left.inverse(),
            None if mounting is None else self.right_from_left @ mounting,
        )

    def content_hash(self, field_of_view_deg: float | None = None) -> str:
        """Hash of the calibration without the mounting, 32 hexadecimal digits."""
        content = [_METHOD]
        if field_of_view_deg is not None:
            content.append(float(field_of_view_deg).hex())
        for camera in (self.left, self.right):
            content += [float(value).hex() for value in camera.matrix.ravel()]
            content += [f"{camera.width}x{camera.height}", camera.distortion.value]
            content += [float(value).hex() for value in camera.coefficients]
        content += [float(value).hex() for value in self.right_from_left.matrix()[:3].ravel()]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:32]


@dataclass(frozen=True, slots=True, eq=False)
class RemapTable:
    """Source of each pixel of a rectified image, in OpenCV's fixed-point form.

    Attributes:
        pixels: (height, width, 2) int16, integer part of the source u, v, px.
        fractions: (height, width) uint16, index into the interpolation table.
    """

    pixels: NDArray[np.int16]
    fractions: NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class Rectification:
    """A rectified camera and the tables that produce its images.

    Attributes:
        camera: the rectified pair; its `rectification` is the hash of the raw calibration.
        rectified_from_raw: rotation of the left camera about its centre.
    """

    camera: StereoCamera
    rectified_from_raw: SE3
    left: RemapTable
    right: RemapTable


def rectify(
    calibration: RawStereoCalibration, field_of_view_deg: float | None = None
) -> Rectification:
    """Rectifies a raw stereo calibration; keeps the image size.

    Args:
        field_of_view_deg: horizontal field of view of the rectified images; None crops all unseen
            borders, and for a fisheye ends at 100°.
    """
    left, right = calibration.left, calibration.right
    _check_pair(calibration)
    if field_of_view_deg is not None and not 10 <= field_of_view_deg <= 170:
        raise CalibrationError(
            f"field of view is {field_of_view_deg:g}°, must be 10° to 170° for a pinhole image"
        )
    try:
        rotations, projections = _stereo_rectify(calibration)
        if field_of_view_deg is None and _is_too_wide(left, projections[0]):
            field_of_view_deg = _WIDEST_FISHEYE_DEG
        if field_of_view_deg is not None:
            projections = _seeing(calibration, field_of_view_deg)
        _check_rectified(rotations, projections)
        tables = [
            _table(camera, rotation, projection)
            for camera, rotation, projection in zip(
                (left, right), rotations, projections, strict=True
            )
        ]
    except cv2.error as error:
        raise CalibrationError(f"the stereo calibration cannot be rectified: {error}") from error
    rectified_from_raw = SE3(rotations[0], np.zeros(3))
    camera = _rectified_camera(calibration, projections, rectified_from_raw, field_of_view_deg)
    return Rectification(camera, rectified_from_raw, tables[0], tables[1])


def _check_pair(calibration: RawStereoCalibration) -> None:
    left, right = calibration.left, calibration.right
    if (left.width, left.height) != (right.width, right.height):
        raise CalibrationError(
            f"left images are {left.width}×{left.height}, right ones {right.width}×{right.height}: "
            "a stereo pair needs equal sizes; set both cameras to one resolution, or scale the "
            "images of one and with them its fx, fy, cx and cy"
        )
    fisheye = [camera.distortion is DistortionModel.EQUIDISTANT for camera in (left, right)]
    if fisheye[0] != fisheye[1]:
        raise CalibrationError(
            f"left lens is {left.distortion.value!r}, right lens {right.distortion.value!r}: "
            "a fisheye pairs only with a fisheye; calibrate both with one model"
        )
    _check_places(calibration)


def _check_places(calibration: RawStereoCalibration) -> None:
    """Refuses a pair whose right camera is not to the right of the left one."""
    x, y, z = calibration.right_from_left.inverse().translation + 0.0
    if x > 0 and x > abs(y):
        return
    where = f"the right camera is at ({x:.4f}, {y:.4f}, {z:.4f}) m in the left one's frame"
    if max(abs(x), abs(y), abs(z)) < _SAME_PLACE_M:
        raise CalibrationError(
            f"{where}: the calibration states no distance between the cameras; calibrate the two "
            "together, or fill in the pose of one in the other"
        )
    where += ": x must be positive and the largest part"
    if abs(y) >= abs(x):
        turn = "anticlockwise" if y > 0 else "clockwise"
        raise CalibrationError(
            f"{where}. The cameras are one above the other, and Engram needs them side by side: "
            f"turn all images by 90° {turn} and calibrate the turned ones"
        )
    raise CalibrationError(
        f"{where}. If the images of left and right are in order, the pose is the inverse of what "
        "it must be, that of the left camera in the right one's frame: invert it; otherwise swap "
        "the two cameras in the calibration. engram doctor shows whether the images are swapped"
    )


def _check_rectified(
    rotations: list[NDArray[np.float64]], projections: list[NDArray[np.float64]]
) -> None:
    """Refuses OpenCV's results for an impossible lens: infinities or a focal length of 0."""
    finite = all(np.isfinite(matrix).all() for matrix in (*rotations, *projections))
    if not (
        finite and all(projection[0, 0] > 0 and projection[1, 1] > 0 for projection in projections)
    ):
        raise CalibrationError(
            "the stereo calibration leaves no usable image: it gives focal lengths of "
            f"{', '.join(f'{projection[0, 0]:.6g}' for projection in projections)} px; check the "
            "distortion coefficients"
        )


def _stereo_rectify(
    calibration: RawStereoCalibration,
) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Rotations (3, 3) and projections (3, 4) of the left and the right rectified camera."""
    left, right = calibration.left, calibration.right
    size = (left.width, left.height)
    rotation = calibration.right_from_left.rotation
    translation = calibration.right_from_left.translation.reshape(3, 1)
    if left.distortion is DistortionModel.EQUIDISTANT:
        r0, r1, p0, p1, _ = cv2.fisheye.stereoRectify(
            left.matrix,
            np.array(left.coefficients),
            right.matrix,
            np.array(right.coefficients),
            size,
            rotation,
            translation,
            flags=cv2.CALIB_ZERO_DISPARITY,
            balance=0.0,
        )
        return _float64(r0, r1), _float64(p0, p1)
    r0, r1, p0, p1, *_ = cv2.stereoRectify(
        left.matrix,
        _coefficients(left),
        right.matrix,
        _coefficients(right),
        size,
        rotation,
        translation,
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0.0,
    )
    return _float64(r0, r1), _float64(p0, p1)


def _is_too_wide(left: RawCamera, projection: NDArray[np.float64]) -> bool:
    """Whether the largest view of a fisheye is wider than 100°, or not a pinhole's at all."""
    if left.distortion is not DistortionModel.EQUIDISTANT:
        return False
    half_rad = np.deg2rad(_WIDEST_FISHEYE_DEG / 2)
    return not projection[0, 0] >= left.width / 2 / np.tan(half_rad)


def _seeing(
    calibration: RawStereoCalibration, field_of_view_deg: float
) -> list[NDArray[np.float64]]:
    """Projections (3, 4) of both images, centred, with this horizontal field of view."""
    width, height = calibration.left.width, calibration.left.height
    focal_px = width / 2 / np.tan(np.deg2rad(field_of_view_deg) / 2)
    left = np.zeros((3, 4))
    left[:, :3] = [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    right = left.copy()
    right[0, 3] = -focal_px * float(np.linalg.norm(calibration.right_from_left.translation))
    return [left, right]


def _float64(*arrays: ArrayLike) -> list[NDArray[np.float64]]:
    return [np.asarray(array, dtype=np.float64) for array in arrays]


def _coefficients(camera: RawCamera) -> NDArray[np.float64]:
    return np.array(camera.coefficients or (0.0,) * 4, dtype=np.float64)


def _table(
    camera: RawCamera, rotation: NDArray[np.float64], projection: NDArray[np.float64]
) -> RemapTable:
    make = (
        cv2.fisheye.initUndistortRectifyMap
        if camera.distortion is DistortionModel.EQUIDISTANT
        else cv2.initUndistortRectifyMap
    )
    pixels, fractions = make(
        camera.matrix,
        _coefficients(camera),
        rotation,
        projection[:, :3],
        (camera.width, camera.height),
        cv2.CV_16SC2,
    )
    return RemapTable(np.asarray(pixels, np.int16), np.asarray(fractions, np.uint16))


def _rectified_camera(
    calibration: RawStereoCalibration,
    projections: list[NDArray[np.float64]],
    rectified_from_raw: SE3,
    field_of_view_deg: float | None,
) -> StereoCamera:
    left, right = projections
    # Rounded coarser than differences between processors: every digit counts for a camera's id, and
    # the same drive must give the same camera everywhere.
    fx, fy, cx, cy = (round(float(left[at]), 6) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    baseline_m = round(float(-right[0, 3] / left[0, 0]), 9)
    mounting = calibration.left_from_rig
    return StereoCamera(
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        baseline_m=baseline_m,
        width=calibration.left.width,
        height=calibration.left.height,
        cam_from_rig=None if mounting is None else _rounded(rectified_from_raw @ mounting),
        rectification=calibration.content_hash(field_of_view_deg),
    )


def _rounded(transform: SE3) -> SE3:
    # Adding 0.0 makes -0.0 positive: the two differ in a hash.
    return SE3(transform.rotation.round(9) + 0.0, transform.translation.round(9) + 0.0)
