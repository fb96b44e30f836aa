"""Plain folders: `left/`, `right/`, `calibration.toml` and an optional `times.txt`.

`docs/data.md` shows the layout with an example.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram.config import load_toml
from engram.errors import CalibrationError, ConfigError, InputError, SequenceError
from engram.geometry import SE3, StereoCamera
from engram.geometry.rectification import (
    DistortionModel,
    RawCamera,
    RawStereoCalibration,
    Rectification,
    rectify,
)
from engram.graph.clock import check_longitude, check_zone
from engram.graph.model import Clock
from engram.sequences.image_sequence import ImageDrive
from engram.sequences.listing import (
    Listing,
    StampedFile,
    image_files,
    nanoseconds,
    pair_by_number,
    pair_by_stamp,
    read_calibration_text,
    read_stamps,
    seconds_as_ns,
)
from engram.sequences.options import OpenOptions
from engram.sequences.sequence import SequenceInfo

# Names whose numbers are this close, ns, are frame numbers: no camera is that fast.
_CLOSEST_NS = 100_000
_TIMES_NEEDED = (
    "write times.txt beside left/ and right/, with one line for each pair: its time in seconds, "
    "such as 0.0, 0.1, 0.2 at 10 Hz"
)


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
        left, right: the two lenses.
    """

    width: int
    height: int
    right_from_left: tuple[float, ...]
    left: LensTable
    right: LensTable


@dataclass(frozen=True, slots=True)
class FolderCalibration:
    """`calibration.toml`: one of `[rectified]` and `[raw]`, and facts of the drive.

    Attributes:
        rectified, raw: the cameras; exactly one of the two.
        cam_from_rig: 16 numbers, row-major 4×4: mounting of the left camera (of the stored images),
            metres; missing if unknown.
        clock: meaning of the stamps.
        robot: name of the robot.
        longitude_deg, zone: where the drive was.
    """

    rectified: RectifiedTable | None = None
    raw: RawTable | None = None
    cam_from_rig: tuple[float, ...] | None = None
    clock: Clock = Clock.UNKNOWN
    robot: str | None = None
    longitude_deg: float | None = None
    zone: str | None = None


def is_folder(path: Path) -> bool:
    """A folder with `left/`, `right/` or `calibration.toml`, at least two of the three."""
    parts = (path / "left", path / "right", path / "calibration.toml")
    return sum(part.exists() for part in parts) >= 2


def find_folder(path: Path, options: OpenOptions) -> ImageDrive:
    """A plain folder. With `times.txt`, images pair by name; without it, names are stamps in ns.

    Raises:
        SequenceError: images or stamps are missing or malformed.
        CalibrationError: `calibration.toml` is missing or malformed, or not of a stereo pair.
    """
    file = path / "calibration.toml"
    text = read_calibration_text(file)
    try:
        calibration = load_toml(text, FolderCalibration)
        check_longitude(calibration.longitude_deg)
        check_zone(calibration.zone)
        camera, rectification = _camera(calibration)
    except InputError as error:
        raise CalibrationError(f"{file}: {error}") from error
    info = SequenceInfo(
        path.resolve().name,
        "folder",
        calibration.clock,
        calibration.robot,
        calibration.longitude_deg,
        calibration.zone,
    )
    return ImageDrive(path, info, camera, _places(path, options), rectification)


def _camera(calibration: FolderCalibration) -> tuple[StereoCamera, Rectification | None]:
    rectified, raw = calibration.rectified, calibration.raw
    mounting = _transform("cam_from_rig", calibration.cam_from_rig)
    if (rectified is None) == (raw is None):
        raise ConfigError("give exactly one of the tables [rectified] and [raw]")
    if rectified is not None:
        values = {name: getattr(rectified, name) for name in RectifiedTable.__slots__}
        return StereoCamera(**values, cam_from_rig=mounting), None
    assert raw is not None
    right_from_left = _transform("right_from_left", raw.right_from_left)
    assert right_from_left is not None
    rectification = rectify(
        RawStereoCalibration(_lens(raw, raw.left), _lens(raw, raw.right), right_from_left, mounting)
    )
    return rectification.camera, rectification


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


def _places(path: Path, options: OpenOptions) -> Listing:
    left, right, times = path / "left", path / "right", path / "times.txt"
    if not times.exists():
        return pair_by_stamp(
            _named_by_stamp(left), _named_by_stamp(right), options.pair_tolerance_ns, (left, right)
        )
    stamps_ns = read_stamps(times, seconds_as_ns)
    sides = [{file.stem: file for file in image_files(folder)} for folder in (left, right)]
    # A name that only one side has keeps its place, so that later stamps remain correct.
    names = sorted({*sides[0], *sides[1]})
    by_number = [
        {number: side[name] for number, name in enumerate(names) if name in side} for side in sides
    ]
    return pair_by_number(stamps_ns, by_number[0], by_number[1], times)


def _named_by_stamp(folder: Path) -> list[StampedFile]:
    files: list[StampedFile] = []
    for path in image_files(folder):
        stamp_ns = nanoseconds(path.stem)
        if stamp_ns is None:
            raise SequenceError(f"{path}: the name is not a stamp in ns; {_TIMES_NEEDED}")
        files.append(StampedFile(stamp_ns, path))
    files.sort(key=lambda file: file.stamp_ns)
    span_ns = files[-1].stamp_ns - files[0].stamp_ns
    if len(files) > 1 and span_ns < _CLOSEST_NS * (len(files) - 1):
        raise SequenceError(
            f"{files[0].path}, {files[1].path.name}, …: the names are frame numbers, not stamps "
            f"in ns; {_TIMES_NEEDED}"
        )
    return files
