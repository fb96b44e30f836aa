"""KITTI odometry and KITTI raw: rectified pairs, paired by frame number.

Source: Geiger, Lenz, Stiller, Urtasun, "Vision meets Robotics: The KITTI Dataset", IJRR 2013.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.calibration import Cameras
from engram.errors import CalibrationError, SequenceError
from engram.geometry import SE3, StereoCamera
from engram.graph.model import Clock
from engram.sequences.calibrating import cameras_of
from engram.sequences.image_sequence import ImageDrive
from engram.sequences.images import image_size
from engram.sequences.listing import (
    Listing,
    PairFiles,
    date_as_ns,
    numbered_files,
    pair_by_number,
    read_stamps,
    seconds_as_ns,
)
from engram.sequences.options import OpenOptions, Rig
from engram.sequences.sequence import SequenceInfo
from engram.untrusted import read_text

_CAMERAS = {Rig.GREY: (0, 1), Rig.COLOUR: (2, 3)}

# The two rectified cameras of a pair share their intrinsics; KITTI prints seven digits.
_SAME_INTRINSICS_PX = 1e-3


def is_kitti_odometry(path: Path) -> bool:
    """A folder `sequences/NN` with `image_0` or another camera's."""
    return any((path / f"image_{camera}").is_dir() for camera in range(4))


def is_kitti_raw(path: Path) -> bool:
    """A drive folder with `image_00/data` or another camera's."""
    return any((path / f"image_{camera:02d}" / "data").is_dir() for camera in range(4))


def find_kitti_odometry(path: Path, options: OpenOptions) -> ImageDrive:
    """A sequence of the odometry benchmark: relative clock, `calib.txt`, `times.txt`.

    Raises:
        SequenceError: images or stamps are missing or malformed.
        CalibrationError: the projections of the rig are missing, malformed or not a pair.
    """
    left, right = _CAMERAS[options.rig]
    folders = _rig_folders(path, {camera: f"image_{camera}" for camera in range(4)}, options.rig)
    times = path / "times.txt"
    stamps_ns = read_stamps(times, seconds_as_ns)
    left_files, right_files = numbered_files(folders[0]), numbered_files(folders[1])
    places = pair_by_number(stamps_ns, left_files, right_files, times)
    cameras = cameras_of(
        options,
        lambda: Cameras(
            _Calibration(path / "calib.txt").stereo_camera(
                f"P{left}", f"P{right}", _first_size(places, path)
            )
        ),
        folders[0],
        rectified=True,
    )
    info = SequenceInfo(path.resolve().name, "kitti", Clock.RELATIVE)
    return ImageDrive(path, info, cameras, places)


def find_kitti_raw(path: Path, options: OpenOptions) -> ImageDrive:
    """A synced and rectified drive of the raw data: UTC stamps, `calib_cam_to_cam.txt`.

    Raises:
        SequenceError: images or stamps are missing or malformed.
        CalibrationError: the projections of the rig are missing, malformed or not a pair.
    """
    left, right = _CAMERAS[options.rig]
    names = {camera: f"image_{camera:02d}/data" for camera in range(4)}
    folders = _rig_folders(path, names, options.rig)
    stamps_file = folders[0].parent / "timestamps.txt"
    stamps_ns = read_stamps(stamps_file, date_as_ns)
    left_files, right_files = numbered_files(folders[0]), numbered_files(folders[1])
    places = pair_by_number(stamps_ns, left_files, right_files, stamps_file)

    def own() -> Cameras:
        calibration = _Calibration(_raw_calibration_file(path))
        width, height = calibration.numbers(f"S_rect_{left:02d}", 2)
        size = (_whole(width), _whole(height))
        projections = f"P_rect_{left:02d}", f"P_rect_{right:02d}"
        return Cameras(calibration.stereo_camera(*projections, size))

    cameras = cameras_of(options, own, folders[0], rectified=True)
    info = SequenceInfo(
        path.resolve().name, "kitti-raw", Clock.UTC, longitude_deg=_oxts_longitude_deg(path)
    )
    return ImageDrive(path, info, cameras, places)


class _Calibration:
    """A text file of lines `NAME: number number …`; other lines are ignored."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = (line.partition(":") for line in read_text(path, CalibrationError).splitlines())
        self._texts = {name.strip(): rest.split() for name, _, rest in lines}

    def numbers(self, name: str, count: int) -> NDArray[np.float64]:
        """The (count,) float64 numbers of an entry, all finite."""
        if name not in self._texts:
            raise CalibrationError(f"{self.path}: entry {name} is missing")
        texts = self._texts[name]
        if len(texts) != count:
            raise CalibrationError(f"{self.path}: {name} has {len(texts)} numbers, must be {count}")
        try:
            values = np.array([float(text) for text in texts])
        except ValueError as error:
            raise CalibrationError(f"{self.path}: {name}: {error}") from None
        if not np.isfinite(values).all():
            raise CalibrationError(f"{self.path}: {name} has a number that is not finite")
        return values

    def stereo_camera(self, left: str, right: str, size: tuple[int, int]) -> StereoCamera:
        """The rectified pair of two projections (3×4); its rig frame is rectified camera 0's."""
        projections = [self.numbers(name, 12).reshape(3, 4) for name in (left, right)]
        difference = np.abs(projections[0][:, :3] - projections[1][:, :3]).max()
        if not difference <= _SAME_INTRINSICS_PX:
            raise CalibrationError(
                f"{self.path}: {left} and {right} differ by {difference:.6g} in their intrinsics: "
                "they are not a rectified pair"
            )
        matrix = projections[0][:, :3]
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and abs(matrix[2, 2] - 1) < 1e-6):
            raise CalibrationError(f"{self.path}: {left} is not the projection of a pinhole camera")
        # P = K [I | t], t the position of camera 0's centre in this camera's frame, metres.
        # Rounded, since every digit counts for a camera's id, which must not differ between
        # processors; + 0.0 makes -0.0 positive.
        offsets_m: list[NDArray[np.float64]] = [
            np.asarray(np.linalg.solve(matrix, projection[:, 3]).round(9) + 0.0, dtype=np.float64)
            for projection in projections
        ]
        baseline_m = round(float(offsets_m[0][0] - offsets_m[1][0]), 9)
        if not baseline_m > 0:
            raise CalibrationError(
                f"{self.path}: {left} and {right} give a baseline of {baseline_m:.6g} m, "
                f"must be > 0: the fourth number of {right} must be −fx·baseline; change its sign, "
                "and engram doctor shows whether the images are exchanged"
            )
        try:
            return StereoCamera(
                fx=float(matrix[0, 0]),
                fy=float(matrix[1, 1]),
                cx=float(matrix[0, 2]),
                cy=float(matrix[1, 2]),
                baseline_m=baseline_m,
                width=size[0],
                height=size[1],
                cam_from_rig=SE3(np.eye(3), offsets_m[0]),
            )
        except CalibrationError as error:
            raise CalibrationError(f"{self.path}: {error}") from error


def _rig_folders(path: Path, names: dict[int, str], rig: Rig) -> tuple[Path, Path]:
    left, right = (path / names[camera] for camera in _CAMERAS[rig])
    other = next(choice for choice in Rig if choice is not rig)
    if not left.is_dir() and (path / names[_CAMERAS[other][0]]).is_dir():
        raise SequenceError(
            f"{left}: the {rig.value} rig's images are missing, but those of the {other.value} "
            f"rig are there: choose rig {other.value!r}"
        )
    return left, right


def _first_size(places: Listing, path: Path) -> tuple[int, int]:
    """Size of the first readable image: KITTI odometry does not state it."""
    failure: SequenceError | None = None
    for place in places:
        if isinstance(place, PairFiles):
            try:
                return image_size(place.left)
            except SequenceError as error:
                failure = failure or error
    raise failure or SequenceError(f"{path}: no frame number has both images and a stamp")


def _raw_calibration_file(path: Path) -> Path:
    resolved = path.resolve()
    candidates = [folder / "calib_cam_to_cam.txt" for folder in (resolved, *resolved.parents[:2])]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise CalibrationError(
        f"{path}: calib_cam_to_cam.txt is missing in the drive's folder and in its parent; "
        "download it from KITTI (it is a separate file) and put it there"
    )


def _oxts_longitude_deg(path: Path) -> float | None:
    """Longitude of the first GPS record, degrees east; None without GPS."""
    record = path / "oxts" / "data" / "0000000000.txt"
    if not record.is_file():
        return None
    try:
        longitude_deg = float(read_text(record).split()[1])
    except (IndexError, ValueError):
        raise SequenceError(f"{record}: no GPS record (latitude longitude …)") from None
    if not abs(longitude_deg) <= 180:
        raise SequenceError(f"{record}: longitude is {longitude_deg}, must be in [-180, 180]")
    return longitude_deg


def _whole(value: float) -> int:
    if not (value == int(value) and 0 < value < 1e6):
        raise CalibrationError(f"image size {value} must be a whole number of pixels > 0")
    return int(value)
