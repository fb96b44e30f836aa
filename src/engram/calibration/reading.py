"""Reads a calibration of any known format: the table of formats and `read_calibration`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from engram.calibration.camera_info import cameras_of_infos, is_camera_info, parse_camera_info
from engram.calibration.cameras import Cameras, rectified_cameras
from engram.calibration.entries import MAX_CHARACTERS, read_yaml
from engram.calibration.kalibr import is_camchain, parse_camchain
from engram.calibration.opencv import is_file_storage, parse_file_storage
from engram.calibration.toml import parse_toml
from engram.errors import CalibrationError, InputError
from engram.untrusted import read_text

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

    Raises:
        CalibrationError: it is missing, malformed, of an unknown format, or not of a stereo pair.
    """
    text = read_text(path, CalibrationError, 4 * MAX_CHARACTERS)
    try:
        if path.suffix == ".toml":
            return parse_toml(text, field_of_view_deg)
        entries = read_yaml(text)
        if is_camchain(entries):
            return parse_camchain(entries, field_of_view_deg)
        if is_camera_info(entries):
            infos = [parse_camera_info(one) for one in (entries, _partner(path))]
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
    """The entries of the file that belongs to this one.

    Raises:
        CalibrationError: there is none.
    """
    partner = _partner_path(path)
    if partner is None:
        raise CalibrationError(
            "is one camera's calibration, and the other's is not next to it: name the pair "
            "left.yaml and right.yaml, and give left.yaml"
        )
    return read_yaml(read_text(partner, CalibrationError, 4 * MAX_CHARACTERS))


def _partner_path(path: Path) -> Path | None:
    names = (path.name.replace(*words) for words in _PARTNERS if words[0] in path.name)
    return next((one for one in map(path.with_name, names) if one.is_file()), None)
