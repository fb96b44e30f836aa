"""Opens a drive of any layout: the table of known layouts and `open_drive`.

Other packages add layouts by entry points of the group `engram.readers` that name a
`SequenceFormat`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import Any, TypeAlias

from engram.drive_options import DriveOptions
from engram.errors import ConfigError, SequenceError
from engram.files import check_there
from engram.keywords import keywords_of
from engram.plugins import PluginGroup, check_is
from engram.sequences.bags.bag_sequence import BagSequence, open_bag
from engram.sequences.bags.containers import is_bag
from engram.sequences.clocks import StampReport
from engram.sequences.framelog.reader import FrameLog, is_framelog, open_framelog
from engram.sequences.images import IMAGE_SUFFIXES
from engram.sequences.layouts import (
    TEMPLATE,
    ImageDrive,
    ImageSequence,
    find_euroc,
    find_folder,
    find_fourseasons,
    find_kitti_odometry,
    find_kitti_raw,
    find_robotcar,
    find_tumvi,
    find_utias,
    is_euroc,
    is_folder,
    is_fourseasons,
    is_kitti_odometry,
    is_kitti_raw,
    is_robotcar,
    is_tumvi,
    is_utias,
)
from engram.sequences.sequence import OpenOptions, Rig

Drive: TypeAlias = ImageSequence | BagSequence | FrameLog

_VIDEOS = frozenset((".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".h264", ".h265"))
_TEMPLATE_OF = (
    "For rectified images it is this, with your numbers (of one half, for images in both/):\n"
    f"{TEMPLATE}"
)
_RECORDINGS = {
    ".svo": "ZED: export its images with the ZED SDK into left/ and right/, or record a bag",
    ".svo2": "ZED: export its images with the ZED SDK into left/ and right/, or record a bag",
}


def stamps_of(sequence: object) -> StampReport:
    """What happened to the stamps of a drive; a frame log has times."""
    if isinstance(sequence, ImageSequence | BagSequence):
        return sequence.stamps
    return StampReport()


# Most drives listed if a parent folder is given.
_MOST_NAMED = 10


@dataclass(frozen=True, slots=True)
class SequenceFormat:
    """One known layout.

    Attributes:
        looks_like: what a path must hold, as text.
        recognises: whether a path has this layout; checks names only.
        open: opens it; `open_images` makes it for layouts of image files.
    """

    looks_like: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, OpenOptions], Drive]
    rigs: tuple[Rig, ...] = (Rig.GREY,)
    has_topics: bool = False


def open_images(
    find: Callable[[Path, OpenOptions], ImageDrive],
) -> Callable[[Path, OpenOptions], ImageSequence]:
    """What opens a layout of image files, by the function that finds them."""
    return lambda path, options: ImageSequence(find(path, options), options)


SEQUENCES: Mapping[str, SequenceFormat] = MappingProxyType(
    {
        "kitti": SequenceFormat(
            "KITTI odometry, sequences/NN with image_0/, image_1/, calib.txt, times.txt",
            is_kitti_odometry,
            open_images(find_kitti_odometry),
            (Rig.GREY, Rig.COLOUR),
        ),
        "kitti-raw": SequenceFormat(
            "KITTI raw, DATE_drive_NNNN_sync with image_00/data/, image_00/timestamps.txt, …",
            is_kitti_raw,
            open_images(find_kitti_raw),
            (Rig.GREY, Rig.COLOUR),
        ),
        "euroc": SequenceFormat(
            "EuRoC / ASL, mav0/cam0/{data/,data.csv,sensor.yaml} and mav0/cam1 likewise",
            is_euroc,
            open_images(find_euroc),
        ),
        "folder": SequenceFormat(
            "plain folder, left/, right/ (or both/), calibration.toml and perhaps times.txt",
            is_folder,
            open_images(find_folder),
        ),
        "tum-vi": SequenceFormat(
            "TUM-VI, mav0/cam0 and mav0/cam1 as in EuRoC, with dso/camchain.yaml next to mav0",
            is_tumvi,
            open_images(find_tumvi),
        ),
        "robotcar": SequenceFormat(
            "Oxford RobotCar, stereo/left/ and stereo/right/, models/ there or above",
            is_robotcar,
            open_images(find_robotcar),
        ),
        "utias": SequenceFormat(
            "UTIAS In the Dark or Multiseason, a run with images/left/ and timestamps_images.txt",
            is_utias,
            open_images(find_utias),
        ),
        "4seasons": SequenceFormat(
            "4Seasons, undistorted_images/cam0/ and cam1/, calibration/ there or above",
            is_fourseasons,
            open_images(find_fourseasons),
        ),
        "bag": SequenceFormat(
            "ROS bag, a file NAME.bag, NAME.mcap or NAME.db3, or a folder of them",
            is_bag,
            open_bag,
            has_topics=True,
        ),
        "framelog": SequenceFormat(
            "frame log, NAME.framelog, that `engram record` made; or a flight record, NAME.flight",
            is_framelog,
            open_framelog,
        ),
    }
)


@keywords_of(DriveOptions, start="recorded_at")
def open_drive(path: str | Path, **given: Any) -> Drive:
    """Opens a drive of any known layout. Folders are checked for all images; none is decoded.

    Image layouts give an `ImageSequence`, bags a `BagSequence` (both are a `StereoSequence`), frame
    logs a `FrameLog`.

    Args:
        path: folder or file of the drive: stereo images, a ROS bag, or a frame log.
        **given: the fields of `DriveOptions`, which describes them.

    Raises:
        SequenceError: the path does not exist, has no known layout, or its images or stamps
            cannot be used; the message names file and fault.
        CalibrationError: its calibration is missing, malformed, or does not fit.
        ConfigError: a keyword is unknown, out of range, or does not fit the layout.
        MapError: a frame log is damaged, locked, or of a newer format.
        MissingExtraError: it is a bag, and the extra `bags` is not installed.
        IncompatibleError: another package adds a layout, and it cannot be used.
    """
    return open_with(Path(path), DriveOptions(**given))


def open_with(path: Path, given: DriveOptions) -> Drive:
    """As `open_drive`, with all keywords in one."""
    options = OpenOptions.of(given)
    name = recognise(path) if given.format is None else given.format
    layout = layout_named(name)
    if options.rig not in layout.rigs:
        raise ConfigError(
            f"{path}: layout {name!r} has no rig {options.rig.value!r}, only "
            f"{', '.join(known.value for known in layout.rigs)}"
        )
    if not layout.has_topics and {options.left, options.right} != {None}:
        raise ConfigError(f"{path}: --left and --right name topics of a bag; this is {name!r}")
    return layout.open(path, options)


def layout_names() -> list[str]:
    """The names of all layouts: Engram's own, then those that other packages add."""
    return [*SEQUENCES, *(name for name in _PLUGINS.names() if name not in SEQUENCES)]


def layout_named(name: str) -> SequenceFormat:
    """The layout of that name."""
    if name in SEQUENCES:
        return SEQUENCES[name]
    if name in _PLUGINS.names():
        return _PLUGINS.load(name)
    raise ConfigError(f"format {name!r} is unknown; known are\n{_known_layouts()}")


_PLUGINS = PluginGroup(
    "engram.readers", "reader of drives", lambda _, value: check_is(value, SequenceFormat)
)


def _layouts() -> dict[str, SequenceFormat]:
    return {name: layout_named(name) for name in layout_names()}


def recognise(path: Path) -> str:
    """The name of the layout found at a path."""
    if path.suffix == ".engram":
        raise SequenceError(f"{path}: is the name of a map, not of a drive; the map is given first")
    check_there(path, SequenceError)
    layouts = [name for name, layout in _layouts().items() if layout.recognises(path)]
    if len(layouts) == 1:
        return layouts[0]
    if layouts:
        raise SequenceError(
            f"{path}: could be {' or '.join(layouts)}: name the layout with --set drive.format=NAME"
        )
    inside = drives_inside(path)
    if inside:
        named = "\n".join(f"  {drive}" for drive in inside[:_MOST_NAMED])
        more = f"\n  and {len(inside) - _MOST_NAMED} more" if len(inside) > _MOST_NAMED else ""
        raise SequenceError(f"{path}: is not a drive but contains some; name one of\n{named}{more}")
    raise SequenceError(
        _asked_of(path) or f"{path}: not a drive of a known layout; known are\n{_known_layouts()}"
    )


def _asked_of(path: Path) -> str | None:
    """Advice for a video, or for a folder of images; None for anything else."""
    folder, suffix = quote(str(path.with_suffix(""))), path.suffix.lower()
    if path.is_file() and suffix in _RECORDINGS:
        return f"{path}: is a recording of {_RECORDINGS[suffix]}"
    if path.is_file() and suffix in _VIDEOS:
        return (
            f"{path}: is a video, and Engram reads images. If each frame holds left and right side "
            f"by side, extract them:\n  mkdir -p {folder}/both && ffmpeg -i {quote(str(path))} "
            f"{folder}/both/%06d.png\nof two videos put the images of one into {folder}/left, "
            f"those of the other into {folder}/right. Then write times.txt there (one line per "
            f"pair, seconds) and calibration.toml. {_TEMPLATE_OF}"
        )
    images = next((folder for folder in (path, *_entries(path)) if _has_images(folder)), None)
    if images is None:
        return None
    return (
        f"{path}: has images in {images}, but not of a known layout; put those of the left camera "
        "into left/ and of the right one into right/, with the same names, or those that hold left "
        "and right side by side into both/. Next to them put times.txt (one line per pair, "
        f"seconds) and calibration.toml. {_TEMPLATE_OF}"
    )


def _has_images(folder: Path) -> bool:
    return any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in _entries(folder))


def drives_inside(path: Path) -> list[Path]:
    """The drives up to two folders below a path, by name; checks names only.

    KITTI keeps them in `sequences/NN` and `DATE/DATE_drive_NNNN_sync`.
    """
    layouts = _layouts().values()

    def is_drive(path: Path) -> bool:
        return any(layout.recognises(path) for layout in layouts)

    drives: list[Path] = []
    for child in _entries(path):
        if is_drive(child):
            drives.append(child)
        elif not child.name.startswith("."):
            drives += filter(is_drive, _entries(child))
    return drives


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _known_layouts() -> str:
    return "\n".join(f"  {name}: {layout.looks_like}" for name, layout in _layouts().items())
