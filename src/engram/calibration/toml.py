"""`calibration.toml`: Engram's own format, which people can edit and give back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from engram.calibration.calibrated_pair import Cameras, rectified_cameras
from engram.config import load_toml
from engram.errors import CalibrationError, ConfigError
from engram.geometry.cameras import StereoCamera
from engram.geometry.rectification import DistortionModel, RawCamera, RawStereoCalibration
from engram.geometry.se3 import SE3


@dataclass(frozen=True, slots=True)
class RectifiedTable:
    """`[rectified]`: the images are rectified; fields as in `StereoCamera`."""

    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class LensTable:
    """`[raw.left]`, `[raw.right]`: fields as in `RawCamera`."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: DistortionModel = DistortionModel.NONE
    coefficients: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class RawTable:
    """`[raw]`: the images are distorted and not rectified.

    Attributes:
        width, height: image size, px.
        right_from_left: 16 numbers, row-major 4×4: pose of the left camera in the frame of the
            right one, metres.
        field_of_view_deg: horizontal field of view of the rectified images; missing for the
            largest.
    """

    width: int
    height: int
    right_from_left: tuple[float, ...]
    left: LensTable
    right: LensTable
    field_of_view_deg: float | None = None


@dataclass(frozen=True, slots=True)
class CalibrationFile:
    """`calibration.toml`: one of `[rectified]` and `[raw]`, and facts of the drive.

    Attributes:
        cam_from_rig: 16 numbers, row-major 4×4: mounting of the left camera (of the stored images),
            metres; missing if unknown.
        clock: meaning of the stamps: utc, relative, unknown.
    """

    rectified: RectifiedTable | None = None
    raw: RawTable | None = None
    cam_from_rig: tuple[float, ...] | None = None
    clock: str = "unknown"
    robot: str | None = None
    longitude_deg: float | None = None
    zone: str | None = None

    def cameras(self, field_of_view_deg: float | None = None) -> Cameras:
        """The stereo pair.

        Args:
            field_of_view_deg: replaces that of `[raw]`.
        """
        mounting = _transform("cam_from_rig", self.cam_from_rig)
        rectified, raw = self.rectified, self.raw
        if (rectified is None) == (raw is None):
            raise ConfigError("give exactly one of the tables [rectified] and [raw]")
        if rectified is not None:
            values = {name: getattr(rectified, name) for name in RectifiedTable.__slots__}
            return Cameras(StereoCamera(**values, cam_from_rig=mounting))
        assert raw is not None
        right_from_left = _transform("right_from_left", raw.right_from_left)
        assert right_from_left is not None
        lenses = (_lens(raw, raw.left), _lens(raw, raw.right))
        calibration = RawStereoCalibration(*lenses, right_from_left, mounting)
        return rectified_cameras(calibration, field_of_view_deg or raw.field_of_view_deg)


def parse_toml(text: str, field_of_view_deg: float | None = None) -> Cameras:
    """The stereo pair of a `calibration.toml`."""
    return load_toml(text, CalibrationFile).cameras(field_of_view_deg)


def calibration_toml(cameras: Cameras) -> str:
    """A calibration as TOML text that `parse_toml` reads as equal cameras."""
    raw, camera = cameras.raw, cameras.camera
    if raw is not None:
        return _raw_toml(raw, cameras.field_of_view_deg)
    if cameras.rectification is not None:
        raise CalibrationError(
            "the lenses are calibrated by a table of pixels, which TOML does not hold; use the "
            "drive's own files"
        )
    lines = _mounting(camera.cam_from_rig)
    lines += ["[rectified]"]
    lines += [f"{name} = {getattr(camera, name)!r}" for name in RectifiedTable.__slots__]
    return "\n".join(lines) + "\n"


def _raw_toml(raw: RawStereoCalibration, field_of_view_deg: float | None) -> str:
    lines = _mounting(raw.left_from_rig)
    lines += ["[raw]", f"width = {raw.left.width}", f"height = {raw.left.height}"]
    if field_of_view_deg is not None:
        lines.append(f"field_of_view_deg = {float(field_of_view_deg)!r}")
    lines.append("# Pose of the left camera in the right one, 4×4 by rows, metres.")
    lines += _matrix("right_from_left", raw.right_from_left)
    for side, lens in (("left", raw.left), ("right", raw.right)):
        lines += ["", f"[raw.{side}]"]
        lines += [f"{name} = {float(getattr(lens, name))!r}" for name in ("fx", "fy", "cx", "cy")]
        lines.append(f'distortion = "{lens.distortion.value}"')
        lines.append(
            f"coefficients = {[float(coefficient) for coefficient in lens.coefficients]!r}"
        )
    return "\n".join(lines) + "\n"


def _mounting(cam_from_rig: SE3 | None) -> list[str]:
    if cam_from_rig is None:
        return []
    note = "# Mounting: pose of the robot's frame in the left camera, 4×4 by rows, metres."
    return [note, *_matrix("cam_from_rig", cam_from_rig), ""]


def _matrix(name: str, transform: SE3) -> list[str]:
    rows = [", ".join(repr(float(value)) for value in row) for row in transform.matrix()]
    return [f"{name} = [", *(f"    {row}," for row in rows), "]"]


def _lens(raw: RawTable, lens: LensTable) -> RawCamera:
    return RawCamera(
        lens.fx,
        lens.fy,
        lens.cx,
        lens.cy,
        raw.width,
        raw.height,
        lens.distortion,
        lens.coefficients,
    )


def _transform(name: str, values: tuple[float, ...] | None) -> SE3 | None:
    if values is None:
        return None
    if len(values) != 16:
        raise ConfigError(f"{name} has {len(values)} numbers, must be 16: a 4×4 matrix by rows")
    return SE3.from_matrix(np.array(values).reshape(4, 4))
