"""The stereo pair of a drive, and the entries of an untrusted calibration file."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from engram.errors import CalibrationError
from engram.geometry.cameras import StereoCamera
from engram.geometry.rectification import (
    DistortionModel,
    RawStereoCalibration,
    Rectification,
    rectify,
)
from engram.geometry.se3 import SE3


@dataclass(frozen=True, slots=True, eq=False)
class Cameras:
    """A calibrated stereo pair.

    Attributes:
        rectification: tables for raw images; None for images that come rectified.
        raw: the raw calibration behind the tables, if it has lenses of a known model.
        field_of_view_deg: chosen horizontal field of view of the rectified images; None for the
            largest without unseen borders.
        topics: names of the left and the right image topic, if the calibration states them.
        right_first: whether the calibration names the right camera first, as cam0.
        sides_doubtful: whether the sign of the baseline says that left and right are exchanged, or
            is wrong itself: the images show which.
        notes: what was read otherwise than it is written, for people.
    """

    camera: StereoCamera
    rectification: Rectification | None = None
    raw: RawStereoCalibration | None = None
    field_of_view_deg: float | None = None
    topics: tuple[str, str] | None = None
    right_first: bool = False
    sides_doubtful: bool = False
    notes: tuple[str, ...] = ()


def rectified_cameras(
    raw: RawStereoCalibration,
    field_of_view_deg: float | None = None,
    topics: tuple[str, str] | None = None,
) -> Cameras:
    """The cameras of a raw calibration."""
    rectification = rectify(raw, field_of_view_deg)
    return Cameras(rectification.camera, rectification, raw, field_of_view_deg, topics)


def cameras_in_order(
    chain: RawStereoCalibration,
    field_of_view_deg: float | None = None,
    topics: tuple[str, str] | None = None,
) -> Cameras:
    """The cameras of a calibration that numbers them, where the first may be the right one.

    Args:
        chain: the first camera as `left`, the second as `right`, whichever they are.
        field_of_view_deg: of the rectified images; None for the largest.
        topics: image topics of the first and the second camera.
    """
    if not chain.is_exchanged:
        return rectified_cameras(chain, field_of_view_deg, topics)
    ordered = rectified_cameras(
        chain.exchanged(), field_of_view_deg, topics and (topics[1], topics[0])
    )
    note = "the calibration has the right camera first: its second camera is read as the left one"
    return replace(ordered, right_first=True, notes=(note,))


# A calibration has a few kilobytes; this bounds the parser's work on malicious files.
MAX_CHARACTERS = 100_000

# Names of lens models that common calibration tools and drivers write.
_DISTORTION = {
    "radial_tangential": DistortionModel.RADIAL_TANGENTIAL,
    "radtan": DistortionModel.RADIAL_TANGENTIAL,
    "plumb_bob": DistortionModel.RADIAL_TANGENTIAL,
    "rational_polynomial": DistortionModel.RADIAL_TANGENTIAL,
    "brown_conrady": DistortionModel.RADIAL_TANGENTIAL,
    "equidistant": DistortionModel.EQUIDISTANT,
    "equi": DistortionModel.EQUIDISTANT,
    "fisheye": DistortionModel.EQUIDISTANT,
    "kannala_brandt": DistortionModel.EQUIDISTANT,
    "kannala_brandt4": DistortionModel.EQUIDISTANT,
    "none": DistortionModel.NONE,
    "pinhole": DistortionModel.NONE,
    "perspective": DistortionModel.NONE,
    "": DistortionModel.NONE,
}
# Models that are not read, but whose lens with coefficients of zero has no distortion.
_IDEAL_AT_ZERO = ("inverse_brown_conrady", "modified_brown_conrady")


def read_yaml(text: str) -> dict[str, Any]:
    """The table of a YAML text; values are strings, lists and tables."""
    # OpenCV writes "%YAML:1.0", which is not a valid YAML directive.
    text = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    if len(text) > MAX_CHARACTERS:
        raise CalibrationError(
            f"{len(text)} characters, too long: at most {MAX_CHARACTERS} are read"
        )
    try:
        # The base loader makes strings, lists and dictionaries, nothing else.
        entries = yaml.load(text, Loader=yaml.BaseLoader)
        spread = _characters(entries, {})
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        fact = str(error).splitlines()[0] if str(error) else "malformed"
        raise CalibrationError(f"not valid YAML: {fact}") from error
    if spread > 4 * MAX_CHARACTERS:  # without aliases it is at most twice the text
        raise CalibrationError("its YAML aliases expand to too much text; write them out")
    if not isinstance(entries, dict):
        raise CalibrationError("holds no calibration (a table of names and values)")
    return entries


def _characters(value: Any, known: dict[int, int]) -> int:
    """Length of a YAML text if its aliases were expanded; nothing is expanded here.

    Args:
        known: lengths by identity; 0 while one is counted.
    """
    if not isinstance(value, list | dict):
        return 1 + len(value or "")
    length = known.setdefault(id(value), -1)
    if length == 0:
        raise ValueError("an alias refers to itself")
    if length < 0:
        known[id(value)] = 0
        parts = [*value, *value.values()] if isinstance(value, dict) else value
        length = known[id(value)] = 1 + sum(_characters(part, known) for part in parts)
    return length


def entry(entries: dict[str, Any], name: str) -> Any:
    """The value of a name."""
    if name not in entries:
        raise CalibrationError(f"entry {name} is missing")
    return entries[name]


def numbers(entries: dict[str, Any], name: str, counts: set[int]) -> list[float]:
    """The finite numbers of a list, a nested list, or a matrix written as a table with `data`."""
    values = entry(entries, name)
    if isinstance(values, dict):
        values = entry(values, "data")
    if isinstance(values, list) and values and isinstance(values[0], list):
        values = [value for row in values if isinstance(row, list) for value in row]
    if not isinstance(values, list) or len(values) not in counts:
        wanted = " or ".join(map(str, sorted(counts)))
        raise CalibrationError(f"{name} must be a list of {wanted} numbers")
    try:
        floats = [float(value) for value in values]
    except (TypeError, ValueError):
        raise CalibrationError(f"{name} has an entry that is not a number") from None
    if not all(map(math.isfinite, floats)):
        raise CalibrationError(f"{name} has a number that is not finite")
    return floats


def whole(value: float, name: str = "resolution") -> int:
    """A number of pixels."""
    if not (0 < value < 1e6 and value == int(value)):
        raise CalibrationError(f"{name} holds {value:g}, must be whole numbers of pixels > 0")
    return int(value)


def pixels(entries: dict[str, Any], name: str) -> int:
    """A number of pixels that stands alone."""
    try:
        return whole(float(entry(entries, name)), name)
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"{name} is not a number") from None


def transform(entries: dict[str, Any], name: str) -> SE3:
    """A rigid transform of 16 (or 12) numbers."""
    matrix = np.array(numbers(entries, name, {12, 16})).reshape(-1, 4)
    return rigid(matrix, name)


def rigid(matrix: NDArray[np.float64], name: str) -> SE3:
    """A rigid transform from a (3, 4) or (4, 4) matrix, its translation in m."""
    try:
        return SE3.from_matrix(matrix)
    except ValueError as error:
        raise CalibrationError(f"{name} is not a rigid transform: {error}") from error


def distortion_model(value: Any, name: str = "distortion_model") -> DistortionModel:
    """The lens model of a name."""
    text = _model_name(value)
    if text not in _DISTORTION:
        known = ", ".join(name for name in _DISTORTION if name)
        raise CalibrationError(
            f"{name} is {text[:40]!r}; known: {known}; calibrate the lenses again with one of "
            "them, or give rectified images"
        )
    return _DISTORTION[text]


def _model_name(value: Any) -> str:
    """A model's name in one spelling: small letters, words joined by underscores."""
    if not isinstance(value, str):  # of a stranger: written out it may be long
        return "no text"
    return re.sub(r"[\s_-]+", "_", value.strip().lower())


def lens_of(
    model: Any, values: Callable[[set[int]], list[float]]
) -> tuple[DistortionModel, tuple[float, ...]]:
    """Model and coefficients of a lens; those of a model that is not read may all be zero.

    Args:
        values: reads the coefficients; is given the allowed counts.
    """
    if _model_name(model) in _IDEAL_AT_ZERO and not any(values({4, 5, 8, 12, 14})):
        return DistortionModel.NONE, ()
    return coefficients(distortion_model(model), values)


def coefficients(
    model: DistortionModel, values: Callable[[set[int]], list[float]]
) -> tuple[DistortionModel, tuple[float, ...]]:
    """Model and coefficients in Engram's form; zeros of an ideal lens are no distortion."""
    if model is DistortionModel.NONE:
        return model, ()
    fisheye = model is DistortionModel.EQUIDISTANT
    used = 4 if fisheye else 8
    # Drivers fill up with zeros: OpenCV's thin prisms and tilts, and Brown's k3 of a fisheye.
    stated = values({4, 5, 8} if fisheye else {4, 5, 8, 12, 14})
    if any(stated[used:]):
        more = "more than 4 coefficients" if fisheye else "thin-prism or tilt terms"
        raise CalibrationError(
            f"the lens has {more}, which are not supported; calibrate again without them"
        )
    if not fisheye and not any(stated):
        return DistortionModel.NONE, ()
    return model, tuple(stated[:used])
