"""A reader of drives whose images lie in one folder, beside `camera.json`."""

import json
from pathlib import Path

from engram.calibration import Cameras
from engram.errors import CalibrationError
from engram.geometry import StereoCamera
from engram.graph.model import Clock
from engram.sequences import ImageDrive, OpenOptions, SequenceFormat, SequenceInfo, open_images
from engram.sequences.calibrating import cameras_of
from engram.sequences.listing import StampedFile, pair_by_stamp


def is_shots(path: Path) -> bool:
    """A folder with `camera.json`."""
    return (path / "camera.json").is_file()


def find_shots(path: Path, options: OpenOptions) -> ImageDrive:
    """The pairs `NANOSECONDS-left.png` and `NANOSECONDS-right.png` of a folder."""
    left, right = (
        [
            StampedFile(int(one.stem.split("-")[0]), one)
            for one in sorted(path.glob(f"*-{side}.png"))
        ]
        for side in ("left", "right")
    )
    places = pair_by_stamp(left, right, options.pair_tolerance_ns, (path, path))
    cameras = cameras_of(options, lambda: _own_cameras(path / "camera.json"), rectified=True)
    return ImageDrive(path, SequenceInfo(path.name, "shots", Clock.UTC), cameras, places)


def _own_cameras(file: Path) -> Cameras:
    try:
        return Cameras(StereoCamera(**json.loads(file.read_text())))
    except (ValueError, TypeError) as error:
        raise CalibrationError(f"{file}: {error}") from error


SHOTS = SequenceFormat(
    "one folder with NANOSECONDS-left.png, NANOSECONDS-right.png and camera.json",
    is_shots,
    open_images(find_shots),
)
