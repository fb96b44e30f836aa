"""Drives stored as images: KITTI, EuRoC, plain folders, Oxford RobotCar, UTIAS, 4Seasons.

KITTI odometry and KITTI raw: rectified pairs, paired by frame number. Source: Geiger, Lenz,
Stiller, Urtasun, "Vision meets Robotics: The KITTI Dataset", IJRR 2013.

EuRoC MAV / ASL layout, TUM-VI's included: raw pairs, rectified on reading, paired by stamp. Source:
Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.

Plain folders: `left/`, `right/`, `calibration.toml` and an optional `times.txt`. Images that hold
both sides, the left one in the left half, lie in `both/` instead of the two. `docs/data.md` shows
the layout with an example.

Oxford RobotCar: raw Bayer images of the Bumblebee XB3, rectified by the data set's tables. Source:
Maddern, Pascoe, Linegar, Newman, "1 Year, 1000km: The Oxford RobotCar Dataset", IJRR 2017, and the
data set's documentation and software kit: `stereo/left|right/MICROSECONDS.png` with pattern GBRG,
`stereo.timestamps`, models `stereo_wide_left.txt` (fx fy cx cy, then a 4×4 transform) and
`stereo_wide_left_distortion_lut.bin` (the source u, then v, of each rectified pixel, float64).

UTIAS Long-Term Localization and Mapping (In the Dark, Multiseason): rectified key frames of a run,
`run_NNNNNN/images/left|right/NNNNNN.png`, and `timestamps_images.txt` with lines `frame,ns`.
Source: the data set's page and its tools, utiasASRL/vtr-dataset-tools.

4Seasons: `recording_…/undistorted_images/cam0|cam1/NANOSECONDS.png`, rectified, and `calibration/`
with `undistorted_calib_0|1.txt` ("Pinhole fx fy cx cy …", then width and height) and
`undistorted_calib_stereo.txt` (4×4). Source: Wenzel et al., "4Seasons: A Cross-Season Dataset for
Multi-Weather SLAM in Autonomous Driving", GCPR 2020, and the data set's documentation,
pmwenzel/4seasons-dataset.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.calibration.calibrated_pair import (
    Cameras,
    entry,
    lens_of,
    numbers,
    read_yaml,
    rectified_cameras,
    transform,
    whole,
)
from engram.calibration.formats import read_calibration
from engram.calibration.toml import CalibrationFile
from engram.config import load_toml
from engram.errors import CalibrationError, ConfigError, InputError, SequenceError
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.rectification import RawCamera, RawStereoCalibration, Rectification, RemapTable
from engram.geometry.se3 import SE3
from engram.graph.clock import check_longitude, check_zone
from engram.graph.model import Clock
from engram.odometry.outside import MotionSource
from engram.sequences.calibrating import (
    TELLING,
    cameras_given,
    cameras_of,
    check_no_view,
    check_sides,
    read_mask,
    scaled_by,
)
from engram.sequences.images import grey, image_bits, image_size, read_image
from engram.sequences.listing import (
    Listing,
    PairFiles,
    StampedFile,
    WrongStamp,
    date_as_ns,
    image_files,
    nanoseconds,
    numbered_files,
    pair_by_number,
    pair_by_stamp,
    read_stamps,
    seconds_as_ns,
    stamp_report,
    usable_pairs,
)
from engram.sequences.motion_files import motion_of_files, stamp_facts_of_files
from engram.sequences.sequence import Channel, OpenOptions, Rig, SequenceInfo, parse_choice
from engram.untrusted import printable, read_bytes, read_text


@dataclass(frozen=True, slots=True, eq=False)
class ImageDrive:
    """The content of a layout, before the caller's options.

    Attributes:
        read: decodes one image: path, width, height, channel → (height, width) uint8 grey.
    """

    path: Path
    info: SequenceInfo
    cameras: Cameras
    places: Listing
    read: Callable[[Path, int, int, Channel], NDArray[np.uint8]] = read_image


class ImageSequence:
    """A `StereoSequence` over image files. Pairs are decoded on demand."""

    def __init__(self, drive: ImageDrive, options: OpenOptions) -> None:
        self.info = with_options(drive.info, options)
        self.cameras = drive.cameras
        self.camera = drive.cameras.camera
        check_no_view(options, drive.cameras)
        self.frames = options.frames
        self._drive = drive
        self._options = options
        places = drive.places
        self._shift_ns = 0
        if options.recorded_at_ns is not None:
            places, self._shift_ns = _shifted(places, options.recorded_at_ns)
        self.motion()  # so that a file that cannot be used is known at once
        self._pairs, self._listing_faults = usable_pairs(
            places, options.skip_bad, drive.path, partial(_chosen, options)
        )
        self._check_sizes()
        self._mask = None if options.mask is None else read_mask(options.mask, drive.cameras)
        self._reading_faults: list[str] = []
        self.stamps = stamp_report(drive.places)
        telling = range(len(self._pairs))[TELLING]
        check_sides(drive.cameras, self.usable(telling), drive.path)

    @property
    def rectification(self) -> Rectification | None:
        """Rectification of raw images; None for a rectified drive."""
        return self.cameras.rectification

    def motion(self) -> MotionSource | None:
        """A new pass through the motion of the caller's files; None without one."""
        mounting = self.camera.cam_from_rig
        return motion_of_files(self._options.motion, mounting, self._shift_ns)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(N,) int64 stamps of the pairs, ns, including pairs that may prove unreadable."""
        return np.array([pair.stamp_ns for pair in self._pairs], dtype=np.int64)

    @property
    def skipped(self) -> int:
        """Pairs left out so far under `skip_bad`, in the latest pass; not those by their stamps."""
        return len(self.skipped_reasons)

    @property
    def skipped_reasons(self) -> list[str]:
        """Why each of the `skipped` pairs was left out."""
        bad = (fault for fault in self._listing_faults if not isinstance(fault, WrongStamp))
        return [*bad, *self._reading_faults]

    @property
    def stamp_facts(self) -> list[str]:
        """Faults of the stamps of images and motion, for people; empty for sound ones."""
        return [*self.stamps.texts("pair"), *stamp_facts_of_files(self._options.motion)]

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[StereoPair]:
        """Decodes one pair at a time."""
        self._reading_faults.clear()
        return self.usable(range(len(self._pairs)))

    def usable(self, indices: Iterable[int]) -> Iterator[StereoPair]:
        """Decodes some pairs, as iterating decodes all."""
        for index in indices:
            try:
                pair = self.read(index)
            except SequenceError as error:
                if not self._options.skip_bad:
                    advice = self._advice(index)
                    raise SequenceError(f"{error}; {advice}") from error
                self._reading_faults.append(str(error))
                continue
            yield pair

    def _advice(self, bad: int) -> str:
        """What to do about a bad pair, by whether others are better."""
        for index in {0, len(self) // 2, len(self) - 1} - {bad}:
            with suppress(SequenceError):
                self.read(index)
                return "leave it out with --set drive.skip_bad=true"
        return "the pairs in the middle and at the end cannot be read either"

    def bits(self) -> int | None:
        """Bits of the brightest pixel of a few left images of 16 bits; None for 8-bit ones.

        Images that cannot be read are left out.
        """
        found: list[int] = []
        for index in {0, len(self) // 2, len(self) - 1}:
            with suppress(SequenceError):
                bits = image_bits(self._pairs[index].left)
                found += [] if bits is None else [bits]
        return max(found, default=None)

    def read(self, index: int) -> StereoPair:
        """Decode pair `index` of `len(self)`, whatever `skip_bad` says."""
        files = self._pairs[index]
        rectification = self.cameras.rectification
        left, right = self._load(files)
        if rectification is not None:
            left, right = rectified(left, rectification.left), rectified(right, rectification.right)
        return StereoPair(files.stamp_ns, left, right, self.camera, self._mask)

    def _check_sizes(self) -> None:
        """Refuses a calibration of another image size; one wrong image alone is a bad pair."""
        sizes = set()
        for pair in (self._pairs[0], self._pairs[-1]):
            with suppress(SequenceError):
                width, height = image_size(pair.left)
                sizes.add((width // 2, height) if pair.left == pair.right else (width, height))
        stated = self.camera.width, self.camera.height
        if len(sizes) != 1 or stated in sizes:
            return
        size = sizes.pop()
        raise SequenceError(
            f"{self._pairs[0].left}: the images are {size[0]}×{size[1]} px, the calibration says "
            f"{stated[0]}×{stated[1]}: give the calibration of these images"
            f"{scaled_by(stated, size)}"
        )

    def _load(self, files: PairFiles) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The two images, not rectified; rectification keeps their size."""
        width, height, channel = self.camera.width, self.camera.height, self._options.channel
        if files.left == files.right:
            both = self._drive.read(files.left, 2 * width, height, channel)
            return half(both, Side.LEFT), half(both, Side.RIGHT)
        left, right = (
            self._drive.read(path, width, height, channel) for path in (files.left, files.right)
        )
        return left, right


class Side(StrEnum):
    """A side of an image that holds both of a pair's, side by side."""

    LEFT = "left"
    RIGHT = "right"


def half(image: NDArray[np.uint8], side: Side) -> NDArray[np.uint8]:
    """The (h, w / 2) uint8 image of one side of a (h, w) image that holds both."""
    width = image.shape[1] // 2
    return np.ascontiguousarray(image[:, :width] if side is Side.LEFT else image[:, -width:])


def rectified(image: NDArray[np.uint8], table: RemapTable) -> NDArray[np.uint8]:
    """The (h, w) uint8 rectified image of a raw one of the same size."""
    return np.asarray(
        cv2.remap(image, table.pixels, table.fractions, cv2.INTER_LINEAR), dtype=np.uint8
    )


def with_options(info: SequenceInfo, options: OpenOptions) -> SequenceInfo:
    """Facts of a drive, completed by the caller's options."""
    clock = info.clock
    if options.recorded_at_ns is not None:
        if clock is Clock.UTC:
            raise ConfigError(
                f"{info.name}: its stamps are UTC already; a start time is for drives whose clock "
                "is relative or unknown"
            )
        clock = Clock.UTC
    return replace(
        info,
        clock=clock,
        name=printable(info.name),
        robot=info.robot if options.robot is None else options.robot,
        longitude_deg=(
            info.longitude_deg if options.longitude_deg is None else options.longitude_deg
        ),
        zone=info.zone if options.zone is None else options.zone,
    )


def _chosen(options: OpenOptions, places: Listing) -> Listing:
    """The places of the chosen frames and times; a fault between two pairs stays."""
    chosen = options.frames.of(places)
    if options.times.is_all:
        return chosen
    first_ns = next((place.stamp_ns for place in places if isinstance(place, PairFiles)), 0)
    inside = [
        row
        for row, place in enumerate(chosen)
        if isinstance(place, PairFiles) and options.times.holds(place.stamp_ns, first_ns)
    ]
    return chosen[inside[0] : inside[-1] + 1] if inside else []


def _shifted(places: Listing, start_ns: int) -> tuple[Listing, int]:
    """The same places, shifted so that the first good stamp is `start_ns`; and the shift, ns."""
    first_ns = next((place.stamp_ns for place in places if isinstance(place, PairFiles)), 0)
    moved_ns = start_ns - first_ns
    return [
        place if isinstance(place, str) else replace(place, stamp_ns=place.stamp_ns + moved_ns)
        for place in places
    ], moved_ns


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
    """A sequence of the odometry benchmark: relative clock, `calib.txt`, `times.txt`."""
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
    """A synced and rectified drive of the raw data: UTC stamps, `calib_cam_to_cam.txt`."""
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
    """A drive in ASL layout, `cam0` left and `cam1` right, with its rectification."""
    left, right = (_mav_folder(path) / name / "sensor.yaml" for name in ("cam0", "cam1"))
    view = options.field_of_view_deg
    return _find(path, options, "euroc", lambda: sensor_cameras(left, right, view))


def find_tumvi(path: Path, options: OpenOptions) -> ImageDrive:
    """A drive of TUM-VI: ASL layout, fisheye lenses, Kalibr's calibration.

    Source: Schubert et al., "The TUM VI Benchmark for Evaluating Visual-Inertial Odometry", IROS
    2018, and the data set's page: 16-bit images of 512 or 1024 px, `dso/camchain.yaml`.
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
    first_ns = next((file.stamp_ns for file in left if isinstance(file, StampedFile)), 0)
    clock = Clock.UTC if first_ns >= YEAR_2000_NS else Clock.RELATIVE
    resolved = path.resolve()
    shown = resolved.parent.name if resolved.name == "mav0" else resolved.name
    return ImageDrive(path, SequenceInfo(shown, name, clock), calibrated, places)


def sensor_cameras(left: Path, right: Path, field_of_view_deg: float | None = None) -> Cameras:
    """The stereo pair of two `sensor.yaml`."""
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


# Words in the names of images that tell the sides.
_SIDE = re.compile(
    r"[_.-]?(?:left|right|(?<![a-z])(?:l|r|(?:cam|camera|image)_?[01])(?![a-z0-9]))", re.IGNORECASE
)
# Names whose numbers are this close, ns, are frame numbers: no camera is that fast.
_CLOSEST_NS = 100_000
# Digits of a time since 1970 in other units, and what makes ns of it.
_UNITS = {13: ("ms", "000000"), 16: ("µs", "000")}
_TIMES_NEEDED = (
    "write times.txt next to left/ and right/, with one line for each pair: its time in seconds, "
    "such as 0.0, 0.1, 0.2 at 10 Hz"
)


# What a drive without a calibration is asked for.
TEMPLATE = """[rectified]
fx = 707.1                # px, of both rectified images
fy = 707.1
cx = 601.9
cy = 183.1
baseline_m = 0.537        # from the left camera to the right one
width = 1226
height = 370"""


def is_folder(path: Path) -> bool:
    """A folder with `left/`, `right/` or `calibration.toml`, at least two of the three; or `both/`.

    `images/` stands for `both/` next to a `calibration.toml`.
    """
    parts = (path / "left", path / "right", path / "calibration.toml")
    return sum(part.exists() for part in parts) >= 2 or _both(path) is not None


def _both(path: Path) -> Path | None:
    """The folder of images that hold both sides; None if the sides have folders of their own."""
    if (path / "left").exists() or (path / "right").exists():
        return None
    if (path / "both").is_dir():
        return path / "both"
    calibrated = (path / "calibration.toml").is_file() and (path / "images").is_dir()
    return path / "images" if calibrated else None


def find_folder(path: Path, options: OpenOptions) -> ImageDrive:
    """A plain folder. With `times.txt`, images pair by name; without it, names are stamps in ns."""
    file = path / "calibration.toml"
    if options.calibration is None and not file.exists():
        raise CalibrationError(
            f"{file}: the file is missing; give a calibration with --calibration FILE (Kalibr's, "
            f"ROS's or OpenCV's), or write this one for rectified images:\n{TEMPLATE}"
        )
    text = read_text(file, CalibrationError) if file.exists() else ""
    try:
        calibration = load_toml(text, CalibrationFile)
        check_longitude(calibration.longitude_deg)
        check_zone(calibration.zone)
        clock = parse_choice(Clock, calibration.clock)
        own = None if options.calibration else calibration.cameras(options.field_of_view_deg)
    except InputError as error:
        raise CalibrationError(f"{file}: {error}") from error
    both = _both(path)
    halves = both is not None
    cameras = own or cameras_given(options, both or path / "left", halves=halves)
    info = SequenceInfo(
        path.resolve().name,
        "folder",
        clock,
        calibration.robot,
        calibration.longitude_deg,
        calibration.zone,
    )
    return ImageDrive(path, info, cameras, _places(path, options))


def _places(path: Path, options: OpenOptions) -> Listing:
    both = _both(path)
    left, right = (path / "left", path / "right") if both is None else (both, both)
    times = path / "times.txt"
    if not times.exists():
        return pair_by_stamp(
            _named_by_stamp(left), _named_by_stamp(right), options.pair_tolerance_ns, (left, right)
        )
    stamps_ns = read_stamps(times, seconds_as_ns)
    sides = _named_alike(left, right)
    # A name that only one side has keeps its place, so that later stamps remain correct.
    places = _numbered({*sides[0], *sides[1]}, len(stamps_ns))
    by_number = [
        {number: side[name] for name, number in places.items() if name in side} for side in sides
    ]
    return pair_by_number(stamps_ns, by_number[0], by_number[1], times)


def _named_alike(left: Path, right: Path) -> list[dict[str, Path]]:
    """The images of both sides by name, without the words for the sides."""
    sides = [{file.stem: file for file in image_files(folder)} for folder in (left, right)]
    if sides[0].keys() & sides[1].keys():
        return sides
    bare = [{_SIDE.sub("", name): file for name, file in side.items()} for side in sides]
    whole = all(len(names) == len(other) for names, other in zip(bare, sides, strict=True))
    if whole and bare[0].keys() & bare[1].keys():
        return bare
    first = [next(iter(side.values())).name for side in sides]
    raise SequenceError(
        f"{left} and {right}: no image has the same name on both sides; the first are {first[0]} "
        f"and {first[1]}: give the images of a pair the same name"
    )


def _numbered(names: set[str], stamps: int) -> dict[str, int]:
    """The line of its stamp for each name; 9 comes before 10.

    If there are more stamps than names, and the names are numbers of lines, images are lost on both
    sides, and those after them keep their lines.
    """
    ordered = sorted(names, key=_by_number)
    if len(names) < stamps and all(name.isascii() and name.isdecimal() for name in names):
        lines = {name: int(name) for name in ordered}
        if len(set(lines.values())) == len(names) and max(lines.values()) < stamps:
            return lines
    return {name: line for line, name in enumerate(ordered)}


def _by_number(name: str) -> tuple[list[str | int], str]:
    parts = re.split("([0-9]+)", name)  # every other one is a number
    return [int(part) if at % 2 else part for at, part in enumerate(parts)], name


def _named_by_stamp(folder: Path) -> list[StampedFile]:
    files: list[StampedFile] = []
    for path in image_files(folder):
        stamp_ns = nanoseconds(_SIDE.sub("", path.stem).strip("_.-"))
        if stamp_ns is None:
            raise SequenceError(f"{path}: the name is not a stamp in ns; {_TIMES_NEEDED}")
        files.append(StampedFile(stamp_ns, path))
    files.sort(key=lambda file: file.stamp_ns)
    span_ns = files[-1].stamp_ns - files[0].stamp_ns
    if len(files) > 1 and span_ns < _CLOSEST_NS * (len(files) - 1):
        what = _UNITS.get(len(str(files[0].stamp_ns)))
        if what is not None:
            raise SequenceError(
                f"{files[0].path}, {files[1].path.name}, …: the names seem to be stamps in "
                f"{what[0]}, but must be in ns: append {what[1]} to each, or {_TIMES_NEEDED}"
            )
        raise SequenceError(
            f"{files[0].path}, {files[1].path.name}, …: the names are frame numbers, not stamps "
            f"in ns; {_TIMES_NEEDED}"
        )
    return files


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
    """A traversal; its models lie in `models/`, there or one or two folders up."""
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
    made_by = hashlib.sha256(b"".join(table.pixels.tobytes() for table in tables)).hexdigest()[:32]
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
        values = np.array([float(text) for text in first[:4]])
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


# Of images 512 px wide. Source: the data set's `camera_parameters.txt`.
_UTIAS_FOCAL_PX, _UTIAS_CENTRE_PX, _UTIAS_WIDTH = 387.777, (257.446, 197.718), 512
_UTIAS_BASELINE_M = 0.239965
_TORONTO, _TORONTO_LONGITUDE_DEG = "America/Toronto", -79.47


def is_utias(path: Path) -> bool:
    """A run: a folder with `images/left` or `images/right` and `timestamps_images.txt`."""
    sides = any((path / "images" / side).is_dir() for side in ("left", "right"))
    return sides and (path / "timestamps_images.txt").is_file()


def find_utias(path: Path, options: OpenOptions) -> ImageDrive:
    """A run of UTIAS In the Dark or Multiseason; the camera is that of the data set's page."""
    stamps = path / "timestamps_images.txt"
    sides = [path / "images" / side for side in ("left", "right")]
    left, right = (numbered_files(side) for side in sides)
    listed = utias_stamps(stamps)

    def files(side: dict[int, Path], folder: Path) -> Iterator[StampedFile | str]:
        for number, stamp_ns in listed.items():
            found = side.get(number, folder / f"{number:06d}.png")
            missing = None if number in side else f"{found}: missing, {stamps.name} has its stamp"
            yield StampedFile(stamp_ns, found, missing)
        for number in sorted(side.keys() - listed.keys()):
            yield f"{side[number]}: extra image, {stamps.name} has no stamp for it"

    places = pair_by_stamp(
        files(left, sides[0]), files(right, sides[1]), options.pair_tolerance_ns, (stamps, stamps)
    )
    cameras = cameras_of(options, lambda: _utias_cameras(places, path), sides[0], rectified=True)
    info = SequenceInfo(
        path.resolve().name,
        "utias",
        Clock.UTC,
        longitude_deg=_TORONTO_LONGITUDE_DEG,
        zone=_TORONTO,
    )
    return ImageDrive(path, info, cameras, places)


def utias_stamps(path: Path) -> dict[int, int]:
    """Stamps of a run's frames by their number, ns, in the order of the file."""
    stamps_ns: dict[int, int] = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        frame, stamp_ns = (nanoseconds(part.strip()) for part in f"{line},".split(",")[:2])
        if frame is None or stamp_ns is None or frame in stamps_ns:
            raise SequenceError(
                f"{path}: line {number} is not 'frame,stamp_ns' of a new frame: {line[:60]!r}"
            )
        stamps_ns[frame] = stamp_ns
    if not stamps_ns:
        raise SequenceError(f"{path}: holds no stamp")
    return stamps_ns


def _utias_cameras(places: Listing, path: Path) -> Cameras:
    width, height = _first_size(places, path)
    scale = width / _UTIAS_WIDTH
    cx, cy = (scale * one for one in _UTIAS_CENTRE_PX)
    focal_px = scale * _UTIAS_FOCAL_PX
    return Cameras(StereoCamera(focal_px, focal_px, cx, cy, _UTIAS_BASELINE_M, width, height))


# Of a rectified pair: greatest angle between the cameras, and greatest offset that is no baseline.
_RECTIFIED_RAD, _RECTIFIED_M = 1e-3, 1e-3


def is_fourseasons(path: Path) -> bool:
    """A recording: a folder with `undistorted_images/cam0` or `cam1`."""
    return any((path / "undistorted_images" / name).is_dir() for name in ("cam0", "cam1"))


def find_fourseasons(path: Path, options: OpenOptions) -> ImageDrive:
    """A recording of 4Seasons; `calibration/` lies there or one or two folders up."""
    sides = [path / "undistorted_images" / name for name in ("cam0", "cam1")]
    left, right = (_named_by_stamp(side) for side in sides)
    places = pair_by_stamp(left, right, options.pair_tolerance_ns, (sides[0], sides[1]))
    cameras = cameras_of(options, lambda: _fourseasons_cameras(path), sides[0], rectified=True)
    info = SequenceInfo(path.resolve().name, "4seasons", Clock.UTC, zone="Europe/Berlin")
    return ImageDrive(path, info, cameras, places)


def _fourseasons_cameras(path: Path) -> Cameras:
    folder = _fourseasons_calibration(path)
    sides = [_pinhole(folder / f"undistorted_calib_{number}.txt") for number in (0, 1)]
    values, sizes = zip(*sides, strict=True)
    if sizes[0] != sizes[1] or np.abs(values[0] - values[1]).max() > _SAME_INTRINSICS_PX:
        raise CalibrationError(f"{folder}: the two undistorted cameras differ: they are not a pair")
    stereo = folder / "undistorted_calib_stereo.txt"
    pose = all_numbers(stereo, 16).reshape(4, 4)
    try:
        # Documented as right to left, the files hold left to right: the length is the same.
        between = SE3.from_matrix(pose)
    except InputError as error:
        raise CalibrationError(f"{stereo}: {error}") from error
    x, y, z = between.translation.tolist()
    if between.angle_rad > _RECTIFIED_RAD or max(abs(y), abs(z)) > _RECTIFIED_M or x == 0:
        raise CalibrationError(
            f"{stereo}: must be a shift along x only, as for a rectified pair, not "
            f"({x:g}, {y:g}, {z:g}) m and {between.angle_rad:.3g} rad"
        )
    fx, fy, cx, cy = values[0].tolist()
    try:
        return Cameras(StereoCamera(fx, fy, cx, cy, abs(x), *sizes[0]))
    except CalibrationError as error:
        raise CalibrationError(f"{folder}: {error}") from error


def _fourseasons_calibration(path: Path) -> Path:
    resolved = path.resolve()
    for folder in (resolved, *resolved.parents[:2]):
        for name in ("calibration", "Calibration"):
            if (folder / name / "undistorted_calib_0.txt").is_file():
                return folder / name
    raise CalibrationError(
        f"{path}: the folder calibration/ with undistorted_calib_0.txt is missing there and in its "
        "parents; it is a separate file of the data set"
    )


def _pinhole(path: Path) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """(4,) float64 fx, fy, cx, cy, px, and the size of the image."""
    lines = [line.split() for line in read_text(path, CalibrationError).splitlines()[:2]]
    try:
        (model, *texts), (width, height) = lines
        values = np.array([float(text) for text in texts])
        size = _whole(float(width)), _whole(float(height))
    except ValueError:
        model, values, size = "", np.empty(0), (0, 0)
    if model != "Pinhole" or len(values) < 4 or not np.isfinite(values).all() or values[4:].any():
        raise CalibrationError(
            f"{path}: must be 'Pinhole fx fy cx cy', without distortion, then width and height"
        )
    return values[:4], size


def all_numbers(path: Path, count: int) -> NDArray[np.float64]:
    """(count,) float64: the numbers of a text file, in lines as they come, all finite."""
    texts = read_text(path, CalibrationError).replace(",", " ").split()
    try:
        values = np.array([float(text) for text in texts])
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from None
    if len(values) != count or not np.isfinite(values).all():
        raise CalibrationError(f"{path}: must hold {count} finite numbers, not {len(values)}")
    return values
