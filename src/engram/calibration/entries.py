"""Entries of an untrusted calibration file: names, numbers, matrices."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from engram.errors import CalibrationError
from engram.geometry import SE3
from engram.geometry.rectification import DistortionModel

# A calibration has a few kilobytes; this bounds the parser's work on malicious files.
MAX_CHARACTERS = 100_000

# Names of lens models that common calibration tools write.
_DISTORTION = {
    "radial-tangential": DistortionModel.RADIAL_TANGENTIAL,
    "radtan": DistortionModel.RADIAL_TANGENTIAL,
    "plumb_bob": DistortionModel.RADIAL_TANGENTIAL,
    "rational_polynomial": DistortionModel.RADIAL_TANGENTIAL,
    "equidistant": DistortionModel.EQUIDISTANT,
    "fisheye": DistortionModel.EQUIDISTANT,
    "kannala_brandt": DistortionModel.EQUIDISTANT,
    "none": DistortionModel.NONE,
    "": DistortionModel.NONE,
}


def read_yaml(text: str) -> dict[str, Any]:
    """The table of a YAML text; values are strings, lists and tables.

    Raises:
        CalibrationError: the text is not YAML, holds no table, or is too long.
    """
    # OpenCV writes "%YAML:1.0", which is not a valid YAML directive.
    text = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    if len(text) > MAX_CHARACTERS:
        raise CalibrationError(f"{len(text)} characters, too long for a calibration")
    try:
        # The base loader makes strings, lists and dictionaries, nothing else.
        entries = yaml.load(text, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        fact = str(error).splitlines()[0] if str(error) else "malformed"
        raise CalibrationError(f"not valid YAML: {fact}") from error
    if not isinstance(entries, dict):
        raise CalibrationError("holds no calibration (a table of names and values)")
    return entries


def entry(entries: dict[str, Any], name: str) -> Any:
    """The value of a name.

    Raises:
        CalibrationError: it is missing.
    """
    if name not in entries:
        raise CalibrationError(f"entry {name} is missing")
    return entries[name]


def numbers(entries: dict[str, Any], name: str, counts: set[int]) -> list[float]:
    """The finite numbers of a list, a nested list, or a matrix written as a table with `data`.

    Raises:
        CalibrationError: it is missing, has another count, or an entry that is not a number.
    """
    values = entry(entries, name)
    if isinstance(values, dict):
        values = entry(values, "data")
    if isinstance(values, list) and values and isinstance(values[0], list):
        values = [one for row in values if isinstance(row, list) for one in row]
    if not isinstance(values, list) or len(values) not in counts:
        wanted = " or ".join(map(str, sorted(counts)))
        raise CalibrationError(f"{name} must be a list of {wanted} numbers")
    try:
        found = [float(value) for value in values]
    except (TypeError, ValueError):
        raise CalibrationError(f"{name} has an entry that is not a number") from None
    if not all(map(math.isfinite, found)):
        raise CalibrationError(f"{name} has a number that is not finite")
    return found


def whole(value: float, name: str = "resolution") -> int:
    """A number of pixels.

    Raises:
        CalibrationError: it is not whole or not positive.
    """
    if not (0 < value < 1e6 and value == int(value)):
        raise CalibrationError(f"{name} holds {value:g}, must be whole numbers of pixels > 0")
    return int(value)


def pixels(entries: dict[str, Any], name: str) -> int:
    """A number of pixels that stands alone.

    Raises:
        CalibrationError: it is missing, or not a whole number > 0.
    """
    try:
        return whole(float(entry(entries, name)), name)
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"{name} is not a number") from None


def transform(entries: dict[str, Any], name: str) -> SE3:
    """A rigid transform of 16 (or 12) numbers.

    Raises:
        CalibrationError: it is missing or not rigid.
    """
    matrix = np.array(numbers(entries, name, {12, 16})).reshape(-1, 4)
    return rigid(matrix, name)


def rigid(matrix: NDArray[np.float64], name: str) -> SE3:
    """A rigid transform from a (3, 4) or (4, 4) matrix, its translation in m.

    Raises:
        CalibrationError: it is not rigid.
    """
    try:
        return SE3.from_matrix(matrix)
    except ValueError as error:
        raise CalibrationError(f"{name} is not a rigid transform: {error}") from error


def distortion_model(value: Any, name: str = "distortion_model") -> DistortionModel:
    """The lens model of a name.

    Raises:
        CalibrationError: it is unknown or not supported.
    """
    text = str(value).strip().lower()
    if text not in _DISTORTION:
        known = ", ".join(name for name in _DISTORTION if name)
        raise CalibrationError(f"{name} is {text[:40]!r}; known: {known}")
    return _DISTORTION[text]


def coefficients(
    model: DistortionModel, values: Callable[[set[int]], list[float]]
) -> tuple[DistortionModel, tuple[float, ...]]:
    """Model and coefficients in Engram's form; five zeros of an ideal lens are no distortion.

    Args:
        model: the stated model.
        values: reads the list; is given the allowed counts.
    """
    if model is DistortionModel.NONE:
        return model, ()
    counts = {4} if model is DistortionModel.EQUIDISTANT else {4, 5, 8}
    found = values(counts)
    if model is DistortionModel.RADIAL_TANGENTIAL and not any(found):
        return DistortionModel.NONE, ()
    return model, tuple(found)
