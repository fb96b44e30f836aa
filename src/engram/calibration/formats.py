"""Reads calibrations of every known format: Kalibr, OpenCV, ROS and Engram's own.

Source: Kalibr wiki, "Yaml formats": intrinsics [fu, fv, pu, pv]; ``T_cn_cnm1`` takes points from
the previous camera of the chain to this one; ``T_cam_imu`` from the IMU to the camera. The chain
has the cameras in the order in which their topics were named: either may be the left one.

OpenCV `FileStorage` in YAML: what `stereo_calib` and programs after its model write. Source: OpenCV
samples/cpp/stereo_calib.cpp writes ``M1 D1 M2 D2`` to intrinsics.yml and ``R T R1 R2 P1 P2 Q`` to
extrinsics.yml; ``T`` is in the unit of the board's squares.

ROS `CameraInfo`: in messages, and in the YAML files of the `camera_calibration` package. Source:
sensor_msgs/CameraInfo. Raw images: x = K·distort(X); `R` rotates the camera to its rectified one;
`P` = [K' | −fx'·baseline] projects the rectified pair, as seen from the left camera. Drivers that
calibrate no pair leave `R` and `P` at zero, drivers of rectified images `K`; some state
+fx'·baseline.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.calibration.calibrated_pair import (
    MAX_CHARACTERS,
    Cameras,
    cameras_in_order,
    entry,
    lens_of,
    numbers,
    pixels,
    read_yaml,
    rectified_cameras,
    rigid,
    transform,
    whole,
)
from engram.calibration.toml import parse_toml
from engram.errors import CalibrationError, InputError
from engram.geometry.cameras import StereoCamera
from engram.geometry.rectification import DistortionModel, RawCamera, RawStereoCalibration
from engram.geometry.se3 import SE3
from engram.untrusted import read_text


def is_camchain(entries: dict[str, Any]) -> bool:
    """Whether the file holds cameras of a chain."""
    return isinstance(entries.get("cam0"), dict)


def parse_camchain(entries: dict[str, Any], field_of_view_deg: float | None = None) -> Cameras:
    """The first two cameras of a chain, in either order, and their image topics."""
    sides = [entry(entries, name) for name in ("cam0", "cam1")]
    lenses = []
    for name, side in zip(("cam0", "cam1"), sides, strict=True):
        if not isinstance(side, dict):
            raise CalibrationError(f"{name} is not a table")
        try:
            lenses.append(_lens(side))
        except CalibrationError as error:
            raise CalibrationError(f"{name}: {error}") from error
    first, second = sides
    second_from_first = transform(second, "T_cn_cnm1")
    first_from_rig = transform(first, "T_cam_imu") if "T_cam_imu" in first else None
    topics = (str(first.get("rostopic", "")), str(second.get("rostopic", "")))
    chain = RawStereoCalibration(lenses[0], lenses[1], second_from_first, first_from_rig)
    return cameras_in_order(chain, field_of_view_deg, topics if all(topics) else None)


def _lens(side: dict[str, Any]) -> RawCamera:
    stated = entry(side, "camera_model")
    model = stated.strip().lower() if isinstance(stated, str) else "no text"
    if model != "pinhole":
        raise CalibrationError(
            f"camera_model is {model[:40]!r}, only 'pinhole' is supported; calibrate again with "
            "Kalibr's models pinhole-radtan, or pinhole-equi for a wide lens"
        )
    fx, fy, cx, cy = numbers(side, "intrinsics", {4})
    width, height = (whole(value) for value in numbers(side, "resolution", {2}))
    lens = lens_of(
        entry(side, "distortion_model"),
        lambda counts: numbers(side, "distortion_coeffs", counts),
    )
    return RawCamera(fx, fy, cx, cy, width, height, *lens)


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
        size: gives that of the drive's images, px, which the sample's files do not state.
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
    names = [next((key for key in known if key in entries), None) for known in (_WIDTHS, _HEIGHTS)]
    if all(names):
        return pixels(entries, str(names[0])), pixels(entries, str(names[1]))
    if size is None:
        raise CalibrationError("states no image size: add image_width and image_height")
    return size()


# The two projections of a rectified pair share focal length and rows, px.
_SAME_PX = 1e-3
# Cameras turned against each other by less, and with their centres this little off a common row, as
# a share of the baseline, give rows that agree to a tenth of a pixel.
_PARALLEL_RAD, _LEVEL = 1e-4, 1e-3
# No robot's cameras are closer, metres.
_SHORTEST_BASELINE_M = 4e-3
# K and P of an ideal, rectified camera agree to the digits that drivers print.
_IDEAL_PX = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfo:
    """Calibration of one camera as ROS states it.

    Attributes:
        width, height: image size, px.
        k: (3, 3) float64, intrinsics of the raw image, px.
        r: (3, 3) float64, rotation of the raw camera to the rectified one.
        p: (3, 4) float64, projection of the rectified image, px and px·m.
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
    def projects(self) -> bool:
        """Whether it states the projection of rectified images."""
        return bool(self.p[0, 0] > 0)

    @property
    def is_ideal(self) -> bool:
        """Whether its raw images are rectified already: no distortion, no rotation, K as in P."""
        same = np.abs(self.k - self.p[:, :3]).max() < _IDEAL_PX
        return not any(self.d) and bool(same) and bool(np.abs(self.r - np.eye(3)).max() < 1e-6)

    def completed(self) -> CameraInfo:
        """With what drivers leave at zero: an ideal camera's K from P, its P from K, and R."""
        k, r, p = self.k, self.r, self.p
        if not (k[0, 0] > 0 or p[0, 0] > 0):
            raise CalibrationError("is not calibrated: its camera matrix holds only zeros")
        if not r.any():
            r = np.eye(3)
        if not p[0, 0] > 0:
            p = np.column_stack([k, np.zeros(3)])
        elif not k[0, 0] > 0:
            k = p[:, :3]
        return replace(self, k=k, r=r, p=p)

    @property
    def lens(self) -> RawCamera:
        """The raw camera."""
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
    """The YAML of `camera_calibration`."""
    model, d = lens_of(
        entries.get("distortion_model", "plumb_bob"),
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
        rectified: whether the images are the rectified ones (`image_rect`).
        right_from_left: relative pose of the raw cameras, metres, if known from elsewhere; used if
            `P` states no baseline.
        field_of_view_deg: of the rectified images, if raw ones are rectified here.
    """
    _check_sizes(left, right)
    stated = left.projects and right.projects
    left, right = _completed(left, "left"), _completed(right, "right")
    baseline_m = float(left.p[0, 3] - right.p[0, 3]) / float(left.p[0, 0])
    if baseline_m == 0 and right_from_left is None:
        raise (
            _no_baseline(left, right)
            if stated
            else CalibrationError(
                "no projection P, which states the baseline: calibrate the pair, or give its "
                "calibration with --calibration FILE"
            )
        )
    if rectified:
        left, right = (_seen_through_p(info, stated=stated) for info in (left, right))
        _check_rows(left, right)
    ideal = left.is_ideal and right.is_ideal and _apart_px(left, right) <= _SAME_PX
    if baseline_m == 0 and right_from_left is not None:
        # Two projections without a baseline do not say that the cameras are aligned.
        if ideal and (rectified or _is_aligned(right_from_left)):
            return _rectified(left, right_from_left.distance_m, left_from_rig)
    elif ideal:
        return _rectified(left, baseline_m, left_from_rig)
    if baseline_m != 0:
        right_from_left = _relative_pose(left, right, baseline_m)
    assert right_from_left is not None
    raw = RawStereoCalibration(left.lens, right.lens, right_from_left, left_from_rig)
    return _with_doubts(rectified_cameras(raw, field_of_view_deg), baseline_m)


def _check_sizes(left: CameraInfo, right: CameraInfo) -> None:
    if (left.width, left.height) != (right.width, right.height):
        raise CalibrationError(
            f"the left images are {left.width}×{left.height} px, the right ones {right.width}×"
            f"{right.height}: a stereo pair needs equal sizes; set both cameras to one resolution, "
            "or scale the images of one and with them its fx, fy, cx and cy"
        )


def _seen_through_p(info: CameraInfo, *, stated: bool) -> CameraInfo:
    """The camera of rectified images, whose projection is all that counts."""
    if not stated and any(info.d):
        raise CalibrationError(
            "the images are rectified, but P, which describes rectified images, is zero; name the "
            "raw topics with --left and --right, or give the calibration of the rectified images "
            "with --calibration FILE"
        )
    lens = DistortionModel.NONE
    return replace(info, k=info.p[:, :3], r=np.eye(3), model=lens, d=())


def _check_rows(left: CameraInfo, right: CameraInfo) -> None:
    apart_px = np.abs(left.p[1, :3] - right.p[1, :3]).max()
    if apart_px > _SAME_PX:
        raise CalibrationError(
            f"the projections of the rectified images differ by {apart_px:.4g} px in their rows: "
            "they are not a rectified pair; name the raw topics with --left and --right, or "
            "calibrate the pair again"
        )


def _apart_px(left: CameraInfo, right: CameraInfo) -> float:
    return float(np.abs(left.p[:2, :3] - right.p[:2, :3]).max())


def _completed(info: CameraInfo, side: str) -> CameraInfo:
    try:
        return info.completed()
    except CalibrationError as error:
        raise CalibrationError(
            f"the {side} camera {error}; calibrate the pair, or give its calibration with "
            "--calibration FILE"
        ) from error


def _is_aligned(right_from_left: SE3) -> bool:
    """Whether rows of two ideal cameras correspond."""
    _, y, z = np.abs(right_from_left.translation)
    return right_from_left.angle_rad < _PARALLEL_RAD and max(y, z) < (
        _LEVEL * right_from_left.distance_m
    )


def _rectified(info: CameraInfo, baseline_m: float, mounting: SE3 | None) -> Cameras:
    """The pair of rectified images, whatever the sign of the baseline."""
    (fx, _, cx), (_, fy, cy) = info.p[:2, :3].tolist()
    width, height = info.width, info.height
    length_m = round(abs(baseline_m), 9)
    camera = StereoCamera(fx, fy, cx, cy, length_m, width, height, mounting)
    return _with_doubts(Cameras(camera), baseline_m)


def _relative_pose(left: CameraInfo, right: CameraInfo, baseline_m: float) -> SE3:
    """right_from_left of the raw cameras, from their rotations and the baseline in P."""
    return SE3(right.r.T @ left.r, right.r.T @ np.array([-abs(baseline_m), 0.0, 0.0]))


def _with_doubts(cameras: Cameras, baseline_m: float) -> Cameras:
    """The cameras, with warnings about the baseline that P states."""
    if baseline_m < 0:
        note = (
            f"the projections state a baseline of {baseline_m:.6g} m: P[3] of the right camera is "
            f"positive, and must be −fx·baseline; read as {-baseline_m:.6g} m, as the images of "
            "left and right are in order"
        )
        return replace(cameras, sides_doubtful=True, notes=(note,))
    if 0 < baseline_m < _SHORTEST_BASELINE_M:
        note = (
            f"the baseline is {1000 * baseline_m:.3g} mm: P[3] of the right camera must be "
            "−fx·baseline, in px·m; is it the baseline alone, or another unit?"
        )
        return replace(cameras, notes=(note,))
    return cameras


def _no_baseline(left: CameraInfo, right: CameraInfo) -> CalibrationError:
    rise_m = float(left.p[1, 3] - right.p[1, 3]) / float(left.p[1, 1])
    if rise_m != 0:
        turn = "anticlockwise" if rise_m > 0 else "clockwise"
        return CalibrationError(
            f"the projections state that the cameras are {abs(rise_m):.4g} m one above the other, "
            f"and Engram needs them side by side; turn all images by 90° {turn} and calibrate the "
            "turned ones"
        )
    return CalibrationError(
        "the right camera's projection P states no baseline: each camera was calibrated alone; "
        "give a calibration of the pair with --calibration FILE"
    )


CALIBRATIONS: Mapping[str, str] = MappingProxyType(
    {
        "calibration.toml": "TOML with [rectified] or [raw], see `engram drive calibration`",
        "Kalibr": "camchain.yaml with cam0 and cam1, pinhole with radtan or equidistant",
        "ROS": "left.yaml and right.yaml of camera_calibration; name the left one",
        "OpenCV": "FileStorage YAML with M1 D1 M2 D2 R T, in one file or intrinsics and extrinsics",
    }
)
# Words of the left file's name and of its partner's.
_PARTNERS = (
    ("left", "right"),
    ("Left", "Right"),
    ("cam0", "cam1"),
    ("infra1", "infra2"),
    ("intrinsics", "extrinsics"),
    ("extrinsics", "intrinsics"),
)


def read_calibration(
    path: Path,
    *,
    rectified: bool = False,
    size: Callable[[], tuple[int, int]] | None = None,
    field_of_view_deg: float | None = None,
) -> Cameras:
    """The stereo pair of a calibration file; its format is recognised by its content.

    Args:
        path: the file; for pairs of files, the left camera's.
        rectified: whether the drive's images are rectified, for formats that describe both.
        size: gives that of the drive's images, px, for formats that state none.
        field_of_view_deg: of the rectified images; None for that of the file.
    """
    text = read_text(path, CalibrationError, 4 * MAX_CHARACTERS)
    try:
        if path.suffix == ".toml":
            return parse_toml(text, field_of_view_deg)
        entries = read_yaml(text)
        if is_camchain(entries):
            return parse_camchain(entries, field_of_view_deg)
        if is_camera_info(entries):
            infos = [parse_camera_info(side) for side in (entries, _partner(path))]
            return cameras_of_infos(
                *infos, rectified=rectified, field_of_view_deg=field_of_view_deg
            )
        if is_file_storage(entries):
            if not {"R", "T", "M1"} <= entries.keys() and _partner_path(path) is not None:
                entries = {**_partner(path), **entries}
            return rectified_cameras(parse_file_storage(entries, size), field_of_view_deg)
    except InputError as error:
        raise CalibrationError(f"{path}: {error}") from error
    known = "\n".join(f"  {name}: {what}" for name, what in CALIBRATIONS.items())
    raise CalibrationError(f"{path}: not a calibration of a known format; known are\n{known}")


def _partner(path: Path) -> dict[str, Any]:
    partner = _partner_path(path)
    if partner is None:
        raise CalibrationError(
            "holds one camera's calibration, but the other's is not next to it: name the pair "
            "left.yaml and right.yaml, and give left.yaml"
        )
    return read_yaml(read_text(partner, CalibrationError, 4 * MAX_CHARACTERS))


def _partner_path(path: Path) -> Path | None:
    names = (path.name.replace(*words) for words in _PARTNERS if words[0] in path.name)
    return next((partner for partner in map(path.with_name, names) if partner.is_file()), None)
