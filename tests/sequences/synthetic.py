"""Small drives in every layout, written to a folder: the same pictures in each."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from engram.errors import EngramError
from engram.frontend.blobs import LandmarkCodes, landmarks_from_codes
from engram.frontend.frame import BRIEF, Frame, FrameStatus, Landmarks, StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import Clock
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FrameLogWriter
from engram.sequences.sequence import LoggedFrame, SequenceInfo, first_pair_hash

WIDTH, HEIGHT, PAIRS = 48, 32, 6
PERIOD_NS = 100_000_000
START_NS = 1_400_000_000_000_000_000


def picture(index: int, side: int) -> np.ndarray:
    """(32, 48) uint8, different for every pair and side."""
    return np.random.default_rng([index, side]).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def stamp_ns(index: int) -> int:
    return START_NS + index * PERIOD_NS


def camera() -> StereoCamera:
    return StereoCamera(40.0, 40.0, 23.5, 15.5, 0.1, WIDTH, HEIGHT)


def interrupt_transaction(path: Path, delete_from: str, target: Path) -> None:
    """Copies an SQLite file as a process killed within a deletion leaves it, with its journal."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA cache_spill = 1")
        connection.execute("PRAGMA cache_size = 1")
        connection.execute("PRAGMA secure_delete = ON")
        connection.execute("BEGIN IMMEDIATE")
        connection.execute(f"DELETE FROM {delete_from}")
        target.parent.mkdir(exist_ok=True)
        for end in ("", "-journal"):
            content = path.with_name(path.name + end).read_bytes()
            target.with_name(target.name + end).write_bytes(content)
        connection.execute("ROLLBACK")


def name_super_journal(path: Path, named: Path) -> None:
    """Lets the journal of an interrupted transaction name a file, which SQLite then deletes."""
    name = str(named).encode()
    page = 2**30 // 4096 + 1
    record = page.to_bytes(4, "big") + name + len(name).to_bytes(4, "big")
    with path.with_name(f"{path.name}-journal").open("ab") as journal:
        journal.write(record + sum(name).to_bytes(4, "big") + bytes.fromhex("d9d505f920a163d7"))


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, content = cv2.imencode(path.suffix, image)
    assert ok
    path.write_bytes(content.tobytes())


# Index of the pair, side → image.
Picture = Callable[[int, int], np.ndarray]


class WriteLayout(Protocol):
    def __call__(self, root: Path, picture: Picture = picture) -> Path: ...


@dataclass(frozen=True)
class ImageLayout:
    """How a layout lays its files out.

    Attributes:
        format: key in `SEQUENCES`.
        write: writes a drive of `PAIRS` pairs below a folder, of these pictures or others, and
            gives the path to open.
        image: the path of an image, from the path to open, the pair's index and the side.
        calibration: the calibration file, from the path to open.
        stamps: the file with the stamps of the left images, one line a pair after `head` lines.
        head: lines before the first stamp.
        first_ns: stamp of the first pair.
    """

    format: str
    write: WriteLayout
    image: Callable[[Path, int, int], Path]
    calibration: Callable[[Path], Path]
    stamps: Callable[[Path], Path] | None
    head: int = 0
    first_ns: int = START_NS


def _write_kitti(root: Path, picture: Picture = picture) -> Path:
    path = root / "sequences" / "03"
    for index in range(PAIRS):
        for side in range(2):
            write_image(_kitti_image(path, index, side), picture(index, side))
    projection = "40 0 23.5 {} 0 40 15.5 0 0 0 1 0"
    (path / "calib.txt").write_text(
        f"P0: {projection.format(0)}\nP1: {projection.format(-4.0)}\nTr: 1 0 0 0\n"
    )
    lines = (f"{index * PERIOD_NS / 1e9:e}" for index in range(PAIRS))
    (path / "times.txt").write_text("\n".join(lines) + "\n")
    return path


def _kitti_image(path: Path, index: int, side: int) -> Path:
    return path / f"image_{side}" / f"{index:06d}.png"


def _write_kitti_raw(root: Path, picture: Picture = picture) -> Path:
    path = root / "2014_05_13" / "2014_05_13_drive_0007_sync"
    for side in range(2):
        for index in range(PAIRS):
            write_image(_kitti_raw_image(path, index, side), picture(index, side))
        lines = (f"2014-05-13 16:53:20.{index * PERIOD_NS:09d}" for index in range(PAIRS))
        (path / f"image_0{side}" / "timestamps.txt").write_text("\n".join(lines) + "\n")
    projection = "40 0 23.5 {} 0 40 15.5 0 0 0 1 0"
    (path.parent / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n"
        f"S_rect_00: 48 32\nP_rect_00: {projection.format(0)}\n"
        f"S_rect_01: 48 32\nP_rect_01: {projection.format(-4.0)}\n"
    )
    return path


def _kitti_raw_image(path: Path, index: int, side: int) -> Path:
    return path / f"image_0{side}" / "data" / f"{index:010d}.png"


SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, {x}, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
resolution: [48, 32]
camera_model: pinhole
intrinsics: [40.0, 40.0, 23.5, 15.5]
distortion_model: radial-tangential
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""


def _write_euroc(root: Path, picture: Picture = picture) -> Path:
    path = root / "V9_01"
    for side in range(2):
        folder = path / "mav0" / f"cam{side}"
        for index in range(PAIRS):
            write_image(_euroc_image(path, index, side), picture(index, side))
        lines = (f"{stamp_ns(index)},{stamp_ns(index)}.png" for index in range(PAIRS))
        (folder / "data.csv").write_text("#timestamp [ns],filename\n" + "\n".join(lines) + "\n")
        (folder / "sensor.yaml").write_text(SENSOR.format(x=0.1 * side))
    return path


def _euroc_image(path: Path, index: int, side: int) -> Path:
    return path / "mav0" / f"cam{side}" / "data" / f"{stamp_ns(index)}.png"


FOLDER_CALIBRATION = """clock = "utc"

[rectified]
fx = 40.0
fy = 40.0
cx = 23.5
cy = 15.5
baseline_m = 0.1
width = 48
height = 32
"""


def _write_folder(root: Path, picture: Picture = picture) -> Path:
    path = root / "monday"
    for index in range(PAIRS):
        for side in range(2):
            write_image(_folder_image(path, index, side), picture(index, side))
    (path / "calibration.toml").write_text(FOLDER_CALIBRATION)
    lines = (f"{stamp_ns(index) // 10**9}.{stamp_ns(index) % 10**9:09d}" for index in range(PAIRS))
    (path / "times.txt").write_text("\n".join(lines) + "\n")
    return path


def _folder_image(path: Path, index: int, side: int) -> Path:
    return path / ("left", "right")[side] / f"shot_{index:03d}.png"


def _write_stamped_folder(root: Path, picture: Picture = picture) -> Path:
    path = root / "tuesday"
    for index in range(PAIRS):
        for side in range(2):
            write_image(_stamped_image(path, index, side), picture(index, side))
    (path / "calibration.toml").write_text(FOLDER_CALIBRATION)
    return path


def _stamped_image(path: Path, index: int, side: int) -> Path:
    return path / ("left", "right")[side] / f"{stamp_ns(index)}.png"


LAYOUTS: dict[str, ImageLayout] = {
    "kitti": ImageLayout(
        "kitti",
        _write_kitti,
        _kitti_image,
        lambda path: path / "calib.txt",
        lambda path: path / "times.txt",
        first_ns=0,
    ),
    "kitti-raw": ImageLayout(
        "kitti-raw",
        _write_kitti_raw,
        _kitti_raw_image,
        lambda path: path.parent / "calib_cam_to_cam.txt",
        lambda path: path / "image_00" / "timestamps.txt",
    ),
    "euroc": ImageLayout(
        "euroc",
        _write_euroc,
        _euroc_image,
        lambda path: path / "mav0" / "cam1" / "sensor.yaml",
        lambda path: path / "mav0" / "cam0" / "data.csv",
        head=1,
    ),
    "folder": ImageLayout(
        "folder",
        _write_folder,
        _folder_image,
        lambda path: path / "calibration.toml",
        lambda path: path / "times.txt",
    ),
    "folder, named by stamp": ImageLayout(
        "folder",
        _write_stamped_folder,
        _stamped_image,
        lambda path: path / "calibration.toml",
        None,
    ),
}


def landmarks(index: int, count: int = 40) -> Landmarks:
    rng = np.random.default_rng([index, 7])
    codes = LandmarkCodes(
        rng.integers(0, 2000, (count, 2), dtype=np.uint16),
        rng.integers(1, 900, count, dtype=np.uint16),
        rng.integers(0, 200, count, dtype=np.uint8),
    )
    descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    octaves = rng.integers(0, 3, count, dtype=np.uint8)
    return landmarks_from_codes(codes, descriptors, octaves, camera())


def logged(index: int, status: OdometryStatus | None = None) -> LoggedFrame:
    """Frame `index` of a synthetic drive: FIRST for the first, else OK unless told otherwise."""
    status = status or (OdometryStatus.FIRST if index == 0 else OdometryStatus.OK)
    step = OdometryStep(status)
    if status is OdometryStatus.OK:
        rng = np.random.default_rng([index, 11])
        root = rng.normal(size=(6, 6)) * 1e-3
        step = OdometryStep(
            status,
            SE3.exp([0.1, 0.0, 1.0, 0.0, 0.05, 0.01] + 0.1 * rng.normal(size=6)),
            root @ root.T,
            100 + index,
        )
    frame = Frame(
        stamp_ns(index),
        camera(),
        landmarks(index),
        BRIEF,
        "frontend-hash",
        FrameStatus.OK,
        picture(index, 0),
    )
    return LoggedFrame(frame, step)


def pair_hash(index: int) -> str:
    return first_pair_hash(
        StereoPair(stamp_ns(index), picture(index, 0), picture(index, 1), camera())
    )


def log_header(**changes) -> FrameLogHeader:
    info = SequenceInfo("monday", "folder", Clock.UTC, "husky", 8.4, "Europe/Berlin")
    values = {
        "info": info,
        "camera": camera(),
        "descriptor": BRIEF,
        "frontend": "frontend-hash",
        "odometry": "odometry-hash",
    }
    return FrameLogHeader(**{**values, **changes})


def write_log(path: Path, frames: list[LoggedFrame] | None = None) -> Path:
    frames = [logged(index) for index in range(PAIRS)] if frames is None else frames
    with FrameLogWriter(path, log_header()) as writer:
        for index, frame in enumerate(frames):
            writer.append(frame, pair_hash(index))
    return path


def only_engram_errors(action: Callable[[], object]) -> EngramError | None:
    """Run something on hostile input; whatever it raises must be one of ours, with a message."""
    try:
        action()
    except EngramError as error:
        caught = error
    else:
        return None
    assert str(caught)
    return caught
