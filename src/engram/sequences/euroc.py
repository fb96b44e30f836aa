"""EuRoC MAV / ASL layout, TUM-VI's included: raw pairs, rectified on reading, paired by stamp.

Source: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from engram.calibration import Cameras, read_calibration
from engram.calibration.cameras import rectified_cameras
from engram.calibration.entries import (
    entry,
    lens_of,
    numbers,
    read_yaml,
    transform,
    whole,
)
from engram.errors import CalibrationError, InputError, SequenceError
from engram.geometry import SE3
from engram.geometry.rectification import RawCamera, RawStereoCalibration
from engram.graph.model import Clock
from engram.sequences.calibrating import cameras_of
from engram.sequences.image_sequence import ImageDrive
from engram.sequences.listing import StampedFile, image_files, nanoseconds, pair_by_stamp
from engram.sequences.options import OpenOptions
from engram.sequences.sequence import SequenceInfo
from engram.untrusted import read_text

# Stamps of the data set are ns since 1970; one before 2000 means a relative clock.
YEAR_2000_NS = 946_684_800 * 1_000_000_000


def is_euroc(path: Path) -> bool:
    """A folder with `mav0/cam0`, or `mav0` itself; `tum-vi` keeps its calibration elsewhere."""
    return _has_cameras(path) and not tumvi_calibration(path).is_file()


def is_tumvi(path: Path) -> bool:
    """The same layout with `dso/camchain.yaml` next to `mav0`."""
    return _has_cameras(path) and tumvi_calibration(path).is_file()


def _has_cameras(path: Path) -> bool:
    return any((_mav_folder(path) / camera).is_dir() for camera in ("cam0", "cam1"))


def tumvi_calibration(path: Path) -> Path:
    """Where TUM-VI keeps its calibration."""
    return _mav_folder(path).resolve().parent / "dso" / "camchain.yaml"


def find_euroc(path: Path, options: OpenOptions) -> ImageDrive:
    """A drive in ASL layout, `cam0` left and `cam1` right, with its rectification.

    Raises:
        SequenceError: images or stamps are missing or malformed.
        CalibrationError: a `sensor.yaml` is missing or malformed, or the two cameras are not a
            stereo pair.
    """
    left, right = (_mav_folder(path) / name / "sensor.yaml" for name in ("cam0", "cam1"))
    view = options.field_of_view_deg
    return _find(path, options, "euroc", lambda: sensor_cameras(left, right, view))


def find_tumvi(path: Path, options: OpenOptions) -> ImageDrive:
    """A drive of TUM-VI: ASL layout, fisheye lenses, Kalibr's calibration.

    Source: Schubert et al., "The TUM VI Benchmark for Evaluating Visual-Inertial Odometry", IROS
    2018, and the data set's page: 16-bit images of 512 or 1024 px, `dso/camchain.yaml`.

    Raises:
        SequenceError: images or stamps are missing or malformed.
        CalibrationError: `camchain.yaml` is malformed.
    """
    file = tumvi_calibration(path)
    view = options.field_of_view_deg
    return _find(path, options, "tum-vi", lambda: read_calibration(file, field_of_view_deg=view))


def _find(
    path: Path, options: OpenOptions, name: str, cameras: Callable[[], Cameras]
) -> ImageDrive:
    sides = [_mav_folder(path) / camera for camera in ("cam0", "cam1")]
    calibrated = cameras_of(options, cameras, sides[0] / "data")
    if calibrated.right_first:
        sides.reverse()
    left, right = (list(_stamped_files(side)) for side in sides)
    tables = (sides[0] / "data.csv", sides[1] / "data.csv")
    places = pair_by_stamp(left, right, options.pair_tolerance_ns, tables)
    first_ns = next((one.stamp_ns for one in left if isinstance(one, StampedFile)), 0)
    clock = Clock.UTC if first_ns >= YEAR_2000_NS else Clock.RELATIVE
    resolved = path.resolve()
    shown = resolved.parent.name if resolved.name == "mav0" else resolved.name
    return ImageDrive(path, SequenceInfo(shown, name, clock), calibrated, places)


def sensor_cameras(left: Path, right: Path, field_of_view_deg: float | None = None) -> Cameras:
    """The stereo pair of two `sensor.yaml`.

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
    if calibration.is_exchanged:
        raise CalibrationError(
            f"{left} and {right}: by T_BS the left camera is {right.parent.name}, and the right "
            f"camera is {left.parent.name}: exchange the folders {left.parent} and {right.parent}"
        )
    try:
        return rectified_cameras(calibration, field_of_view_deg)
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
    text = read_text(path, CalibrationError)
    try:
        entries = read_yaml(text)
        width, height = (whole(value) for value in numbers(entries, "resolution", {2}))
        fx, fy, cx, cy = numbers(entries, "intrinsics", {4})
        camera_model = str(entries.get("camera_model", "pinhole")).strip().lower()
        if camera_model != "pinhole":
            raise CalibrationError(f"camera_model is {camera_model[:40]!r}, must be 'pinhole'")
        lens = lens_of(
            entry(entries, "distortion_model"),
            lambda counts: numbers(entries, "distortion_coefficients", counts),
        )
        camera = RawCamera(fx, fy, cx, cy, width, height, *lens)
        return camera, transform(entries, "T_BS")
    except InputError as error:
        raise CalibrationError(f"{path}: {error}") from error
