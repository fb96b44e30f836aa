"""Oxford RobotCar: raw Bayer images of the Bumblebee XB3, rectified by the data set's tables.

Source: Maddern, Pascoe, Linegar, Newman, "1 Year, 1000km: The Oxford RobotCar Dataset", IJRR 2017,
and the data set's documentation and software kit: `stereo/left|right/MICROSECONDS.png` with pattern
GBRG, `stereo.timestamps`, models `stereo_wide_left.txt` (fx fy cx cy, then a 4×4 transform) and
`stereo_wide_left_distortion_lut.bin` (the source u, then v, of each rectified pixel, float64).
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.calibration import Cameras
from engram.errors import CalibrationError, SequenceError
from engram.geometry import SE3, StereoCamera
from engram.geometry.rectification import Rectification, RemapTable
from engram.graph.model import Clock
from engram.sequences.calibrating import cameras_of
from engram.sequences.image_sequence import ImageDrive
from engram.sequences.images import grey, image_size, read_image
from engram.sequences.listing import (
    Listing,
    PairFiles,
    StampedFile,
    WrongStamp,
    image_files,
    pair_by_stamp,
)
from engram.sequences.options import Channel, OpenOptions
from engram.sequences.sequence import SequenceInfo
from engram.untrusted import read_bytes, read_text

# Of the wide pair, between its left and right lens. The models do not state it. Source: data sheet
# of the Bumblebee XB3 and the data set's paper, §II.
_BASELINE_M = 0.24
_MODELS = ("stereo_wide_left", "stereo_wide_right")
_ZONE, _LONGITUDE_DEG = "Europe/London", -1.26
_MAX_TABLE_BYTES = 200_000_000


def is_robotcar(path: Path) -> bool:
    """A folder with `stereo/left` or `stereo/right`."""
    return any((path / "stereo" / side).is_dir() for side in ("left", "right"))


def find_robotcar(path: Path, options: OpenOptions) -> ImageDrive:
    """A traversal; its models lie in `models/`, there or one or two folders up.

    Raises:
        SequenceError: images or stamps are missing or malformed.
        CalibrationError: the models are missing or malformed.
    """
    sides = [path / "stereo" / side for side in ("left", "right")]
    cameras = cameras_of(options, lambda: _cameras(path, sides[0]), sides[0])
    left, right = (_stamped(side) for side in sides)
    places = pair_by_stamp(left, right, options.pair_tolerance_ns, (sides[0], sides[1]))
    info = SequenceInfo(
        path.resolve().name,
        "robotcar",
        Clock.UTC,
        longitude_deg=_LONGITUDE_DEG,
        zone=_ZONE,
    )
    return ImageDrive(path, info, cameras, _without_lone(places), read=_debayered)


def _stamped(side: Path) -> list[StampedFile]:
    files = []
    for path in image_files(side):
        if not (path.stem.isascii() and path.stem.isdecimal() and len(path.stem) <= 16):
            raise SequenceError(f"{path}: the name is not a stamp in microseconds")
        files.append(StampedFile(int(path.stem) * 1000, path))
    return sorted(files, key=lambda file: file.stamp_ns)


def _without_lone(places: Listing) -> Listing:
    """Places of pairs: single images are missing from traversals, by their documentation."""
    pairs = [place for place in places if isinstance(place, PairFiles | WrongStamp)]
    return pairs or places


def _debayered(path: Path, width: int, height: int, channel: Channel) -> NDArray[np.uint8]:
    raw = read_image(path, width, height)
    return grey(path, np.asarray(cv2.cvtColor(raw, cv2.COLOR_BayerGBRG2BGR)), channel)


def _cameras(path: Path, left: Path) -> Cameras:
    models = _models(path)
    width, height = image_size(image_files(left)[0])
    values = [_intrinsics(models / f"{name}.txt") for name in _MODELS]
    if np.abs(values[0] - values[1]).max() > 1e-3:
        raise CalibrationError(
            f"{models}: the models of the wide pair differ: they are not a rectified pair"
        )
    tables = [_table(models / f"{name}_distortion_lut.bin", width, height) for name in _MODELS]
    fx, fy, cx, cy = values[0].tolist()
    made_by = hashlib.sha256(b"".join(one.pixels.tobytes() for one in tables)).hexdigest()[:32]
    camera = StereoCamera(fx, fy, cx, cy, _BASELINE_M, width, height, rectification=made_by)
    return Cameras(camera, Rectification(camera, SE3.identity(), tables[0], tables[1]))


def _models(path: Path) -> Path:
    resolved = path.resolve()
    for folder in (resolved, *resolved.parents[:2]):
        if (folder / "models" / f"{_MODELS[0]}.txt").is_file():
            return folder / "models"
    raise CalibrationError(
        f"{path}: the folder models/ with {_MODELS[0]}.txt is missing there and in its parents; "
        "copy it from the data set's software kit"
    )


def _intrinsics(path: Path) -> NDArray[np.float64]:
    """(4,) float64 fx, fy, cx, cy, px."""
    first = read_text(path, CalibrationError).split("\n", 1)[0].split()
    try:
        values = np.array([float(one) for one in first[:4]])
    except ValueError as error:
        raise CalibrationError(f"{path}: line 1: {error}") from None
    if len(values) != 4 or not np.isfinite(values).all():
        raise CalibrationError(f"{path}: line 1 must be fx fy cx cy, four finite numbers")
    return values


def _table(path: Path, width: int, height: int) -> RemapTable:
    content = read_bytes(path, _MAX_TABLE_BYTES, CalibrationError)
    if len(content) != 16 * width * height:
        raise CalibrationError(
            f"{path}: {len(content)} bytes, must be 16 for each of {width}×{height} px: two "
            "float64 numbers"
        )
    u, v = np.frombuffer(content, "<f8").reshape(2, height, width).astype(np.float32)
    if not (np.isfinite(u).all() and np.isfinite(v).all()):
        raise CalibrationError(f"{path}: has a number that is not finite")
    pixels, fractions = cv2.convertMaps(u, v, cv2.CV_16SC2)
    return RemapTable(np.asarray(pixels, np.int16), np.asarray(fractions, np.uint16))
