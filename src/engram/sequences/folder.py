"""Plain folders: `left/`, `right/`, `calibration.toml` and an optional `times.txt`.

`docs/data.md` shows the layout with an example.
"""

from __future__ import annotations

import re
from pathlib import Path

from engram.calibration.toml import CalibrationFile
from engram.config import load_toml
from engram.errors import CalibrationError, InputError, SequenceError
from engram.graph.clock import check_longitude, check_zone
from engram.graph.model import Clock
from engram.sequences.calibrating import cameras_of
from engram.sequences.image_sequence import ImageDrive
from engram.sequences.listing import (
    Listing,
    StampedFile,
    image_files,
    nanoseconds,
    pair_by_number,
    pair_by_stamp,
    read_stamps,
    seconds_as_ns,
)
from engram.sequences.options import OpenOptions, parse_choice
from engram.sequences.sequence import SequenceInfo
from engram.untrusted import read_text

# Names whose numbers are this close, ns, are frame numbers: no camera is that fast.
_CLOSEST_NS = 100_000
_TIMES_NEEDED = (
    "write times.txt beside left/ and right/, with one line for each pair: its time in seconds, "
    "such as 0.0, 0.1, 0.2 at 10 Hz"
)


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
    needed = options.calibration is None or file.exists()
    text = read_text(file, CalibrationError) if needed else ""
    try:
        calibration = load_toml(text, CalibrationFile)
        check_longitude(calibration.longitude_deg)
        check_zone(calibration.zone)
        clock = parse_choice(Clock, calibration.clock)
        cameras = cameras_of(
            options, lambda: calibration.cameras(options.field_of_view_deg), path / "left"
        )
    except InputError as error:
        raise CalibrationError(f"{file}: {error}") from error
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
    left, right, times = path / "left", path / "right", path / "times.txt"
    if not times.exists():
        return pair_by_stamp(
            _named_by_stamp(left), _named_by_stamp(right), options.pair_tolerance_ns, (left, right)
        )
    stamps_ns = read_stamps(times, seconds_as_ns)
    sides = [{file.stem: file for file in image_files(folder)} for folder in (left, right)]
    # A name that only one side has keeps its place, so that later stamps remain correct.
    places = _numbered({*sides[0], *sides[1]}, len(stamps_ns))
    by_number = [
        {number: side[name] for name, number in places.items() if name in side} for side in sides
    ]
    return pair_by_number(stamps_ns, by_number[0], by_number[1], times)


def _numbered(names: set[str], stamps: int) -> dict[str, int]:
    """The line of its stamp for each name; 9 comes before 10.

    If there are more stamps than names, and the names are numbers of lines, images are lost on both
    sides, and those after them keep their lines.
    """
    ordered = sorted(names, key=_by_number)
    if len(names) < stamps and all(one.isascii() and one.isdecimal() for one in names):
        lines = {name: int(name) for name in ordered}
        if len(set(lines.values())) == len(names) and max(lines.values()) < stamps:
            return lines
    return {name: line for line, name in enumerate(ordered)}


def _by_number(name: str) -> tuple[list[str | int], str]:
    parts = re.split("([0-9]+)", name)  # every other one is a number
    return [int(one) if at % 2 else one for at, one in enumerate(parts)], name


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
