"""Engram next to a pipeline of single images, on the same drives: one table.

    engram lab evaluate peers --out results/peers

The town is a loop of 130 m: five drives are mapped (clear morning and afternoon, overcast, night,
rain), or two of them (clear morning, night); five others are judged (fair, overcast, night, rain,
snow). **It is Engram's own**: networks
and confidence were fitted on other towns of the same kind. Of the real clips some frames are mapped
and the others judged, of the same drive. Every judged drive begins lost.

`SIFT` is the pipeline of `sift_places`: its map consists of the *true* poses, it has no odometry,
and is mapped from and asked at every other frame of the town. RTAB-Map is not run: it has no Python
packages, and no package of it could be had where this study was written.
"""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from engram.errors import ConfigError
from engram.geometry.se3 import SE3
from engram.localiser.settings import METHOD_VERSION
from engram.maps.map import open_map
from engram.monitor import QUIET, Monitor
from engram.robot.mapping import map_drive
from engram.sequences.layouts import ImageSequence
from engram.sequences.motion_files import read_kitti_poses
from engram.sequences.opening import open_drive
from engram_lab.accuracy import is_false
from engram_lab.studies.building import write_json
from engram_lab.studies.plan import Row, alone_in, make_folder, plain_table, write_csv
from engram_lab.studies.sift_places import SiftMap
from engram_lab.town.camera_model import CLEAN
from engram_lab.town.campaigns import WORLD_VERSION, Campaign, small_loop
from engram_lab.town.session import SimulatedSequence
from engram_lab.town.simulating import campaign_folder, simulate
from engram_lab.truth import read_matrix_truth

SEED = 21
_LOOP_M = 130.0
_FIRST_DAY = datetime(2025, 7, 14, tzinfo=UTC)
# Condition, day, UTC hour, weather; the first five are mapped.
_DRIVES = (
    ("clear morning", 0, 7.5, "clear"),
    ("clear afternoon", 0, 16.0, "clear"),
    ("overcast", 1, 10.0, "overcast"),
    ("night", 1, 21.8, "fair"),
    ("rain", 2, 9.0, "rain"),
    ("fair", 5, 8.0, "fair"),
    ("overcast", 6, 14.0, "overcast"),
    ("night", 7, 22.0, "clear"),
    ("rain", 8, 11.0, "rain"),
    ("snow", 180, 11.0, "snow"),
)
_MAPPED = 5
# Scenes of the town, with the drives that are mapped.
MAPS: Mapping[str, Sequence[int]] = {"village": range(_MAPPED), "village, two drives": (0, 3)}
# A stretch without a fix counts as a gap from this length on, metres.
GAP_M = 10.0


def small_village(seed: int = SEED) -> Campaign:
    """One loop with ten drives of one robot."""
    drives = [
        (_FIRST_DAY + timedelta(days=day, hours=hour), weather, CLEAN)
        for _, day, hour, weather in _DRIVES
    ]
    return small_loop("peers", seed, _LOOP_M, drives)


@dataclass(frozen=True, slots=True, eq=False)
class TrueDrive:
    """Frames of a drive, and where they are.

    Attributes:
        options: of `engram.open_drive`.
        world_from_cam: true pose of the left camera by stamp; one world for a scene.
    """

    name: str
    path: Path
    options: Mapping[str, Any]
    world_from_cam: Mapping[int, SE3]

    def open(self) -> ImageSequence:
        """The drive as Engram reads it: rectified grey pairs."""
        return _images(self.path, self.options)


def _images(path: Path, options: Mapping[str, Any]) -> ImageSequence:
    found = open_drive(path, **options)
    assert isinstance(found, ImageSequence)  # all drives of the study are images in folders
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Drives to map, and drives to judge.

    Attributes:
        every: the single-image pipeline takes every nth frame, to map and to localise.
    """

    name: str
    mapped: tuple[TrueDrive, ...]
    judged: tuple[TrueDrive, ...]
    every: int = 1


def village(folder: Path, numbers: Sequence[int], name: str, seed: int = SEED) -> Scene:
    """The rendered town, below a folder of campaigns, of which these drives are mapped."""
    campaign = small_village(seed)
    images = campaign_folder(folder, campaign) / "images/sequences"
    drives = []
    for number, (condition, *_) in enumerate(_DRIVES):
        start = campaign.session(number).start
        options = {"robot": "wildcat", "recorded_at": f"{start:%Y-%m-%dT%H:%M:%SZ}"}
        poses = SimulatedSequence(campaign, number).drive.world_from_cams()
        drives.append(_true_drive(condition, images / f"{number:03d}", options, poses))
    mapped = tuple(drives[number] for number in numbers)
    return Scene(name, mapped, tuple(drives[_MAPPED:]), every=2)


def _true_drive(
    name: str, path: Path, options: Mapping[str, Any], poses: Sequence[SE3]
) -> TrueDrive:
    """Of a drive with a pose for each of all its frames."""
    every = _images(path, {key: value for key, value in options.items() if key != "frames"})
    return TrueDrive(name, path, options, dict(zip(every.stamps_ns.tolist(), poses, strict=True)))


def kitti(data: Path) -> Scene:
    """KITTI 06, its first five seconds: even frames are mapped, odd ones judged."""
    path = data / "kitti_odometry/sequences/06"
    stamps_ns = _images(path, {}).stamps_ns
    truth = read_kitti_poses(data / "kitti_odometry/poses/06.txt", stamps_ns)
    even, odd = (
        _true_drive("odd frames", path, {"frames": frames}, truth.world_from_cam)
        for frames in ("0::2", "1::2")
    )
    return Scene("KITTI 06", (even,), (odd,))


def euroc(data: Path) -> Scene:
    """EuRoC V1_01, 63 pairs in a room: the first half is mapped, the second judged."""
    path = data / "euroc/V1_01_easy_sparse"
    truth = read_matrix_truth(path / "poses_world_from_rectified_cam0.txt")
    first, second = (
        _true_drive("second half", path, {"frames": frames}, truth.world_from_cam)
        for frames in ("0:32", "32:")
    )
    return Scene("EuRoC V1_01", (first,), (second,))


@dataclass(frozen=True, slots=True)
class Answer:
    """What a system answers for a frame.

    Attributes:
        at_m: distance driven so far, by the truth.
        error_m, error_rad: of its fix; None where it has none.
        inliers: of its match; 0 where it has none.
        cpu_ms: processor time of the frame, all threads.
    """

    at_m: float
    error_m: float | None
    error_rad: float | None
    inliers: int
    cpu_ms: float


class System(Protocol):
    """One way to localise."""

    name: str

    def build(self, scene: Scene, folder: Path) -> Path:
        """Maps a scene, as far as that is not done; the map's file."""
        ...

    def answers(self, scene: Scene, drive: TrueDrive, file: Path) -> Iterator[Answer]:
        """One answer for each frame that it is asked at."""
        ...


class Engram:
    """Engram with its defaults, by a kind of features."""

    def __init__(self, features: str) -> None:
        self.name = f"Engram, `{features}`"
        self._features = features

    def build(self, scene: Scene, folder: Path) -> Path:
        """See `System`; drives that a map holds already are not mapped again."""
        file = folder / f"{_plain(scene.name)}-{self._features}.engram"
        for drive in scene.mapped:
            map_drive(file, drive.open(), features=self._features)
        return file

    def answers(self, scene: Scene, drive: TrueDrive, file: Path) -> Iterator[Answer]:
        """See `System`; errors are those in the node that a frame matched."""
        known = {key: pose for one in scene.mapped for key, pose in one.world_from_cam.items()}
        sequence = drive.open()
        driven = _driven_m(drive)
        with open_map(file) as town, town.robot(sequence.camera) as robot:
            for pair in sequence:
                began = time.process_time()
                found = robot.step(pair)
                cpu_ms = 1e3 * (time.process_time() - began)
                pose = found.node_from_live if found.localised else None
                off = None
                if pose is not None and found.node_stamp_ns is not None:
                    truth = (
                        known[found.node_stamp_ns].inverse() @ drive.world_from_cam[pair.stamp_ns]
                    )
                    off = truth.inverse() @ pose
                yield _answer(driven[pair.stamp_ns], off, found.inliers, cpu_ms)


class Sift:
    """SIFT, VLAD and an absolute pose, in a map of true poses."""

    name = "SIFT, VLAD and PnP"

    def build(self, scene: Scene, folder: Path) -> Path:
        """See `System`."""
        file = folder / f"{_plain(scene.name)}-sift.npz"
        if not file.exists():
            pairs = [
                (pair, drive.world_from_cam[pair.stamp_ns])
                for drive in scene.mapped
                for number, pair in enumerate(drive.open())
                if number % scene.every == 0
            ]
            SiftMap.of(pairs).save(file)
        return file

    def answers(self, scene: Scene, drive: TrueDrive, file: Path) -> Iterator[Answer]:
        """See `System`; every pose counts, whatever its inliers."""
        places, driven = SiftMap.load(file), _driven_m(drive)
        for number, pair in enumerate(drive.open()):
            if number % scene.every:
                continue
            began = time.process_time()
            found = places.localise(pair)
            cpu_ms = 1e3 * (time.process_time() - began)
            pose, inliers = (None, 0) if found is None else found
            off = None if pose is None else drive.world_from_cam[pair.stamp_ns].inverse() @ pose
            yield _answer(driven[pair.stamp_ns], off, inliers, cpu_ms)


def _plain(name: str) -> str:
    """A name as part of a file's."""
    return "".join(letter if letter.isalnum() else "-" for letter in name.lower())


def _answer(at_m: float, off: SE3 | None, inliers: int, cpu_ms: float) -> Answer:
    if off is None:
        return Answer(at_m, None, None, 0, cpu_ms)
    return Answer(at_m, off.distance_m, off.angle_rad, inliers, cpu_ms)


def _driven_m(drive: TrueDrive) -> dict[int, float]:
    """Distance driven up to each frame that is judged, by stamp."""
    stamps_ns = drive.open().stamps_ns.tolist()
    poses = [drive.world_from_cam[stamp_ns] for stamp_ns in stamps_ns]
    steps = [(a.inverse() @ b).distance_m for a, b in pairwise(poses)]
    return dict(zip(stamps_ns, np.cumsum([0.0, *steps]).tolist(), strict=True))


def judged(answers: Sequence[Answer], least_inliers: int = 0) -> Row:
    """The figures of a drive.

    Args:
        least_inliers: a pose with fewer does not count as a fix.
    """
    fixes = [one for one in answers if one.error_m is not None and one.inliers >= least_inliers]
    errors_m = [float(one.error_m or 0.0) for one in fixes]
    end_m = answers[-1].at_m
    stops = [answers[0].at_m, *(one.at_m for one in fixes), end_m]
    gaps = np.diff(stops)
    return {
        "frames": len(answers),
        "localised": len(fixes),
        "false": sum(is_false(one.error_m or 0.0, one.error_rad or 0.0) for one in fixes),
        "gap_share": float(gaps[gaps > GAP_M].sum() / max(end_m - answers[0].at_m, 1e-9)),
        "median_cm": 100 * float(np.median(errors_m)) if errors_m else "",
        "cpu_ms": float(np.mean([one.cpu_ms for one in answers])),
    }


# The pipeline accepts a pose from so many inliers on: as few as hloc's users take, and twice that.
LEAST_INLIERS = (15, 30)


def rows_of(system: System, scene: Scene, work: Path) -> Iterator[Row]:
    """The figures of a system on the judged drives of a scene; what is done is read again."""
    file = system.build(scene, work)
    for drive in scene.judged:
        kept = work / f"{_plain(scene.name)}-{_plain(system.name)}-{_plain(drive.name)}.csv"
        if not kept.exists():
            write_csv(kept, [asdict(one) for one in system.answers(scene, drive, file)])
        answers = list(_read(kept))
        whose = {"scene": scene.name, "drive": drive.name, "map_mb": file.stat().st_size / 1e6}
        if not isinstance(system, Sift):
            yield {"system": system.name, **whose, **judged(answers)}
            continue
        for least in LEAST_INLIERS:
            yield {"system": f"{system.name}, {least} inliers", **whose, **judged(answers, least)}


def _read(path: Path) -> Iterator[Answer]:
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            error_m, error_rad = (
                float(row[name]) if row[name] else None for name in ("error_m", "error_rad")
            )
            yield Answer(
                float(row["at_m"]),
                error_m,
                error_rad,
                int(row["inliers"]),
                float(row["cpu_ms"]),
            )


COLUMNS = {
    "scene": "scene",
    "drive": "drive",
    "system": "system",
    "localised": "localised",
    "frames": "of frames",
    "false": "false",
    "gap_share": "route in gaps",
    "median_cm": "median cm",
    "cpu_ms": "CPU ms",
    "map_mb": "map MB",
}


def systems() -> list[System]:
    """What can be run here."""
    found: list[System] = [Engram("brief"), Engram("net")]
    return [*found, Sift()] if find_spec("pycolmap") else found


def missing() -> list[str]:
    """What is not run here, and why."""
    lines = ["RTAB-Map: not run, it has no Python packages"]
    if not find_spec("pycolmap"):
        lines.append("SIFT, VLAD and PnP: not run, pycolmap is not installed: pip install pycolmap")
    return lines


def run_peers(
    out: Path,
    campaigns: Path,
    data: Path | None,
    *,
    seed: int = SEED,
    workers: int = 1,
    monitor: Monitor = QUIET,
) -> list[Row]:
    """Renders, maps and judges what is missing; writes ``peers.csv``.

    Args:
        out: folder of results, of one version of method and world.
        campaigns: folder of rendered drives.
        data: the real images; None leaves them out.

    Raises:
        ConfigError: the folder holds results of another version.
    """
    make_folder(out)
    with alone_in(out):
        _check_version(out / "configuration.json", seed)
        simulate(small_village(seed), campaigns, images=True, workers=workers, monitor=monitor)
        makers: list[Callable[[], Scene]] = [
            partial(village, campaigns, numbers, name, seed) for name, numbers in MAPS.items()
        ]
        if data is not None:
            makers += [partial(kitti, data), partial(euroc, data)]
        chosen = systems()
        rows: list[Row] = []
        with monitor.stage("peers", len(makers) * len(chosen)) as stage:
            for make in makers:
                scene = make()
                for system in chosen:
                    rows += rows_of(system, scene, out)
                    stage.advance()
        write_csv(out / "peers.csv", rows)
    return rows


def _check_version(file: Path, seed: int) -> None:
    now = {"method": METHOD_VERSION, "world": WORLD_VERSION, "seed": seed}
    if not file.exists():
        write_json(file, now)
    elif (known := json.loads(file.read_text(encoding="utf-8"))) != now:
        raise ConfigError(
            f"{file.parent} holds results of {_words(known)}, this run is of {_words(now)}; "
            "give another --out"
        )


def _words(version: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in version.items())


def text_of(rows: Iterable[Row]) -> str:
    """The table for a terminal, and what was not run."""
    return "\n".join([*plain_table(list(rows), COLUMNS), *missing()])
