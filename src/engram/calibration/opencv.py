"""OpenCV `FileStorage` in YAML: what `stereo_calib` and programs after its model write.

Source: OpenCV samples/cpp/stereo_calib.cpp writes ``M1 D1 M2 D2`` to intrinsics.yml and ``R T R1 R2
P1 P2 Q`` to extrinsics.yml; ``T`` is in the unit of the board's squares.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from engram.calibration.entries import numbers, pixels, rigid, whole
from engram.errors import CalibrationError
from engram.geometry.rectification import DistortionModel, RawCamera, RawStereoCalibration

# Spellings of the entries: left and right camera matrix, left and right distortion.
_SPELLINGS = (
    ("M1", "M2", "D1", "D2"),
    ("K1", "K2", "D1", "D2"),
    ("cameraMatrix1", "cameraMatrix2", "distCoeffs1", "distCoeffs2"),
    ("camera_matrix_1", "camera_matrix_2", "dist_coeffs_1", "dist_coeffs_2"),
    ("camera_matrix_left", "camera_matrix_right", "dist_coeffs_left", "dist_coeffs_right"),
    ("left_K", "right_K", "left_D", "right_D"),
)
_WIDTHS = ("image_width", "imageWidth", "width")
_HEIGHTS = ("image_height", "imageHeight", "height")
_SIZES = ("image_size", "imageSize", "size", "resolution")


def is_file_storage(entries: dict[str, Any]) -> bool:
    """Whether the file holds two camera matrices, or the relative pose of a pair."""
    return any(names[0] in entries for names in _SPELLINGS) or {"R", "T"} <= entries.keys()


def parse_file_storage(
    entries: dict[str, Any], size: Callable[[], tuple[int, int]] | None
) -> RawStereoCalibration:
    """The pair of a file, or of two files whose entries are joined.

    Args:
        entries: the entries.
        size: gives that of the drive's images, px, which the sample's files do not state.

    Raises:
        CalibrationError: an entry is missing or malformed.
    """
    names = next((names for names in _SPELLINGS if names[0] in entries), None)
    if names is None or not {"R", "T"} <= entries.keys():
        raise CalibrationError(
            "needs two camera matrices (M1, M2), two distortions (D1, D2), R and T; give the "
            "file with the intrinsics, and put the file with the extrinsics next to it"
        )
    width, height = _size(entries, size)
    model = _model(entries)
    lenses = []
    for matrix_name, distortion_name in ((names[0], names[2]), (names[1], names[3])):
        k = np.array(numbers(entries, matrix_name, {9})).reshape(3, 3)
        counts = {4} if model is DistortionModel.EQUIDISTANT else {4, 5, 8, 12, 14}
        d = numbers(entries, distortion_name, counts)
        if any(d[8:]):
            raise CalibrationError(f"{distortion_name} has thin-prism or tilt terms: not supported")
        lens = (model, tuple(d[:8])) if any(d) else (DistortionModel.NONE, ())
        lenses.append(RawCamera(k[0, 0], k[1, 1], k[0, 2], k[1, 2], width, height, *lens))
    pose = np.c_[
        np.array(numbers(entries, "R", {9})).reshape(3, 3),
        np.array(numbers(entries, "T", {3})),
    ]
    return RawStereoCalibration(lenses[0], lenses[1], rigid(pose, "R, T"))


def _model(entries: dict[str, Any]) -> DistortionModel:
    """`fisheye: 1` or a model named so; without a word Brown's polynomial, as the sample."""
    words = f"{entries.get('fisheye', '')} {entries.get('model', '')}".lower().split()
    fisheye = {"1", "true", "fisheye", "equidistant"}
    return (
        DistortionModel.EQUIDISTANT if fisheye & set(words) else DistortionModel.RADIAL_TANGENTIAL
    )


def _size(entries: dict[str, Any], size: Callable[[], tuple[int, int]] | None) -> tuple[int, int]:
    for name in _SIZES:
        if name in entries:
            width, height = numbers(entries, name, {2})
            return whole(width, name), whole(height, name)
    names = [next((one for one in known if one in entries), None) for known in (_WIDTHS, _HEIGHTS)]
    if all(names):
        return pixels(entries, str(names[0])), pixels(entries, str(names[1]))
    if size is None:
        raise CalibrationError("states no image size: add image_width and image_height")
    return size()
