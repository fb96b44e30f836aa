"""EuRoC MAV / ASL layout: raw pairs, rectified on reading, paired by stamp.

Source: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from engram.errors import CalibrationError, InputError, SequenceError
from engram.geometry import SE3
from engram.geometry.rectification import (
    DistortionModel,
    RawCamera,
    RawStereoCalibration,
    Rectification,
    rectify,
)
from engram.graph.model import Clock
from engram.sequences.image_sequence import ImageDrive
from engram.sequences.listing import (
    StampedFile,
    image_files,
    nanoseconds,
    pair_by_stamp,
    read_calibration_text,
    read_text,
)
from engram.sequences.options import OpenOptions
from engram.sequences.sequence import SequenceInfo

# Values of `distortion_model` that common calibration tools write.
_DISTORTION = {
    "radial-tangential": DistortionModel.RADIAL_TANGENTIAL,
    "radtan": DistortionModel.RADIAL_TANGENTIAL,
    "plumb_bob": DistortionModel.RADIAL_TANGENTIAL,
    "equidistant": DistortionModel.EQUIDISTANT,
    "fisheye": DistortionModel.EQUIDISTANT,
    "kannala_brandt": DistortionModel.EQUIDISTANT,
    "none": DistortionModel.NONE,
}

# Stamps of the data set are ns since 1970; one before 2000 means a relative clock.
_YEAR_2000_NS = 946_684_800 * 1_000_000_000
# A calibration has a few hundred bytes; this bounds the parser's work on malicious files.
_MAX_YAML_CHARACTERS = 1_000_000


def is_euroc(path: Path) -> bool:
    """A folder with `mav0/cam0`, or `mav0` itself."""
    return (_mav_folder(path) / "cam0").is_dir()


def find_euroc(path: Path, options: OpenOptions) -> ImageDrive:
    """A drive in ASL layout, `cam0` left and `cam1` right, with its rectification.

    Raises:
        SequenceError: images or stamps are missing or malformed.
        CalibrationError: a `sensor.yaml` is missing or malformed, or the two cameras are not a
            stereo pair.
    """
    folder = _mav_folder(path)
    sides = (folder / "cam0", folder / "cam1")
    rectification = rectify_sensors(*(side / "sensor.yaml" for side in sides))
    left, right = (list(_stamped_files(side)) for side in sides)
    places = pair_by_stamp(
        left, right, options.pair_tolerance_ns, (sides[0] / "data.csv", sides[1] / "data.csv")
    )
    stamps_ns = [item.stamp_ns for item in left if isinstance(item, StampedFile)]
    clock = Clock.UTC if stamps_ns and stamps_ns[0] >= _YEAR_2000_NS else Clock.RELATIVE
    resolved = path.resolve()
    name = resolved.parent.name if resolved.name == "mav0" else resolved.name
    info = SequenceInfo(name, "euroc", clock)
    return ImageDrive(path, info, rectification.camera, places, rectification)


def rectify_sensors(left: Path, right: Path) -> Rectification:
    """Rectification of two `sensor.yaml`.

    Raises:
        CalibrationError: one is missing or malformed, or the two cameras are not a stereo pair.
    """
    left_camera, body_from_left = _read_sensor(left)
    right_camera, body_from_right = _read_sensor(right)
    calibration = RawStereoCalibration(
        left_camera,
        right_camera,
        right_from_left=body_from_right.inverse() @ body_from_left,
        left_from_rig=body_from_left.inverse(),
    )
    try:
        return rectify(calibration)
    except CalibrationError as error:
        raise CalibrationError(f"{left} and {right}: {error}") from error


def _mav_folder(path: Path) -> Path:
    inner = path / "mav0"
    return inner if inner.is_dir() else path


def _stamped_files(side: Path) -> Iterator[StampedFile | str]:
    """The images that `data.csv` names, in its order, then those that it does not name."""
    table, folder = side / "data.csv", side / "data"
    present = {path.name: path for path in image_files(folder)}
    named: set[str] = set()
    for number, line in enumerate(read_text(table).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        stamp_text, _, name = (part.strip() for part in line.partition(","))
        stamp_ns = nanoseconds(stamp_text)
        if stamp_ns is None or not name:
            raise SequenceError(f"{table}: line {number} is not 'stamp_ns,filename': {line[:80]!r}")
        named.add(name)
        missing = f"{folder / name}: the image is missing ({table.name} line {number})"
        yield StampedFile(stamp_ns, folder / name, None if name in present else missing)
    if not named:
        raise SequenceError(f"{table}: names no image")
    for name in sorted(present.keys() - named):
        yield f"{present[name]}: extra image, not in {table.name}"


def _read_sensor(path: Path) -> tuple[RawCamera, SE3]:
    """Camera and body_from_camera of a `sensor.yaml`."""
    entries = _read_yaml(path)
    try:
        width, height = (_whole(value) for value in _numbers(entries, "resolution", {2}))
        fx, fy, cx, cy = _numbers(entries, "intrinsics", {4})
        distortion = str(_entry(entries, "distortion_model")).strip().lower()
        if distortion not in _DISTORTION:
            raise CalibrationError(
                f"distortion_model is {distortion[:40]!r}; known: {', '.join(_DISTORTION)}"
            )
        camera_model = str(entries.get("camera_model", "pinhole")).strip().lower()
        if camera_model != "pinhole":
            raise CalibrationError(f"camera_model is {camera_model[:40]!r}, must be 'pinhole'")
        model = _DISTORTION[distortion]
        coefficients = (
            ()
            if model is DistortionModel.NONE
            else tuple(_numbers(entries, "distortion_coefficients", {4, 5, 8}))
        )
        camera = RawCamera(fx, fy, cx, cy, width, height, model, coefficients)
        return camera, _mounting(entries)
    except InputError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _mounting(entries: dict[str, Any]) -> SE3:
    matrix = _entry(entries, "T_BS")
    if isinstance(matrix, dict):
        values = _numbers(matrix, "data", {16})
    else:
        values = _numbers(entries, "T_BS", {16})
    return SE3.from_matrix(np.array(values).reshape(4, 4))


def _read_yaml(path: Path) -> dict[str, Any]:
    # OpenCV writes "%YAML:1.0", which is not a valid YAML directive.
    lines = read_calibration_text(path).splitlines()
    text = "\n".join(line for line in lines if not line.startswith("%"))
    if len(text) > _MAX_YAML_CHARACTERS:
        raise CalibrationError(f"{path}: {len(text)} characters, too long for a calibration")
    try:
        # The base loader makes strings, lists and dictionaries, nothing else.
        entries = yaml.load(text, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        fact = str(error).splitlines()[0] if str(error) else "malformed"
        raise CalibrationError(f"{path}: not valid YAML: {fact}") from error
    if not isinstance(entries, dict):
        raise CalibrationError(f"{path}: holds no calibration (a table of names and values)")
    return entries


def _entry(entries: dict[str, Any], name: str) -> Any:
    if name not in entries:
        raise CalibrationError(f"entry {name} is missing")
    return entries[name]


def _numbers(entries: dict[str, Any], name: str, counts: set[int]) -> list[float]:
    values = _entry(entries, name)
    if not isinstance(values, list) or len(values) not in counts:
        wanted = " or ".join(map(str, sorted(counts)))
        raise CalibrationError(f"{name} must be a list of {wanted} numbers")
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        raise CalibrationError(f"{name} has an entry that is not a number") from None
    if not all(map(math.isfinite, numbers)):
        raise CalibrationError(f"{name} has a number that is not finite")
    return numbers


def _whole(value: float) -> int:
    if not (0 < value < 1e6 and value == int(value)):
        raise CalibrationError(f"resolution holds {value}, must be whole numbers of pixels > 0")
    return int(value)
