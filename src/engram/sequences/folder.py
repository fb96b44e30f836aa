"""Plain folders: `left/`, `right/`, `calibration.toml` and an optional `times.txt`.

Images that hold both sides, the left one in the left half, lie in `both/` instead of the two.
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
from engram.sequences.calibrating import cameras_given
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
    """A plain folder. With `times.txt`, images pair by name; without it, names are stamps in ns.

    Raises:
        SequenceError: images or stamps are missing or malformed.
        CalibrationError: `calibration.toml` is missing or malformed, or not of a stereo pair.
    """
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
    """The images of both sides by name, without the words for the sides.

    Raises:
        SequenceError: no image has a partner.
    """
    sides = [{file.stem: file for file in image_files(folder)} for folder in (left, right)]
    if sides[0].keys() & sides[1].keys():
        return sides
    bare = [{_SIDE.sub("", name): file for name, file in side.items()} for side in sides]
    whole = all(len(one) == len(other) for one, other in zip(bare, sides, strict=True))
    if whole and bare[0].keys() & bare[1].keys():
        return bare
    first = [next(iter(side.values())).name for side in sides]
    raise SequenceError(
        f"{left} and {right}: no two images have one name, as {first[0]} and {first[1]}: rename "
        "them so that the images of a pair have the same name on both sides"
    )


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
                f"{files[0].path}, {files[1].path.name}, …: the names are stamps in {what[0]}, it "
                f"seems, and must be in ns: append {what[1]} to each, or {_TIMES_NEEDED}"
            )
        raise SequenceError(
            f"{files[0].path}, {files[1].path.name}, …: the names are frame numbers, not stamps "
            f"in ns; {_TIMES_NEEDED}"
        )
    return files
