"""The drives that ship: written to a folder, and fixes held against their truth."""

from __future__ import annotations

import filecmp
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, storage_full
from engram.files import draft_folder, naming
from engram.maps.map import open_map
from engram.monitor import QUIET, Monitor
from engram.robot.starting import localise_drive
from engram.sequences.motion_files import read_tum
from engram.sequences.opening import open_drive

_DATA = Path(__file__).parent / "data"


@dataclass(frozen=True, slots=True)
class SampleDrive:
    """A drive that ships.

    Attributes:
        name: of its folder; its truth is in `NAME.truth.txt` next to that.
        about: when it was, in what weather, and where it leads.
    """

    name: str
    about: str


DRIVES = (
    SampleDrive("monday", "14 July 2025, 09:30, sun; 27 m of a street"),
    SampleDrive(
        "tuesday", "15 July 2025, 12:00, clouds; starts 7 m further on and ends 7 m further on"
    ),
)


def write_drives(folder: Path, monitor: Monitor = QUIET) -> None:
    """Writes the drives into a folder, each as a whole or not at all; those that are there stay."""
    shipped = {drive.name: sorted(_files(_DATA / drive.name)) for drive in DRIVES}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with monitor.stage("write drives", sum(map(len, shipped.values()))) as part:
            for name, files in shipped.items():
                _write(folder / name, files, part)
                truth = _truth(name)
                shutil.copyfile(_DATA / truth, folder / truth)
    except OSError as error:
        raise storage_full(error, folder) or InputError(
            f"{folder} cannot be written to: {error.strerror}"
        ) from error


def _write(target: Path, files: list[Path], monitor: Monitor) -> None:
    source = _DATA / target.name
    if target.exists():
        if not all(_equal(source / file, target / file) for file in files):
            raise InputError(
                f"{target} is there already, and is not the drive that Engram would write; remove "
                "it, or choose another folder with --out"
            )
        return
    with naming(target), draft_folder(target) as folder:
        draft = folder / target.name
        for file in files:
            monitor.check()
            (draft / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / file, draft / file)
            monitor.advance(target.name)
        draft.rename(target)


def _files(folder: Path) -> Iterator[Path]:
    return (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())


def _equal(file: Path, other: Path) -> bool:
    return other.is_file() and filecmp.cmp(file, other, shallow=False)


def _truth(name: str) -> str:
    return f"{name}.truth.txt"


def offsets_m(map_path: Path, folder: Path) -> NDArray[np.float64]:
    """Localises the second drive in a map, as `engram localise` does; compares with the truth.

    Args:
        map_path: the map; fixes in nodes of other drives than these two do not count.
        folder: where `write_drives` wrote them.

    Returns:
        (K,) float64: distance of each fix's ``node_from_live`` from the truth, metres.
    """
    world_from_cam = {
        int(stamp_ns): pose
        for drive in DRIVES
        for trajectory in [read_tum(folder / _truth(drive.name))]
        for stamp_ns, pose in zip(trajectory.stamps_ns, trajectory.world_from_cam, strict=True)
    }
    with open_map(map_path) as opened:
        results = localise_drive(opened, open_drive(folder / DRIVES[-1].name))
    offsets = []
    for result in results:
        if result.node_from_live is None or result.node_stamp_ns not in world_from_cam:
            continue
        true = world_from_cam[result.node_stamp_ns].inverse() @ world_from_cam[result.stamp_ns]
        offsets.append(np.linalg.norm(result.node_from_live.translation - true.translation))
    return np.array(offsets, np.float64)
