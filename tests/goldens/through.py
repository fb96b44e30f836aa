"""The few calls by which goldens reach Engram; nothing else here imports it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from platformdirs import user_cache_path

import engram
from engram import _core
from engram.fleet.build.building import BuildOptions, build_map
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.merging import merge as merge_maps
from engram.frontend.frame import Frame, StereoPair
from engram.frontend.frontend import Frontend
from engram.localiser.localisation import Localisation
from engram.maps import map_files
from engram.maps.map import Map, open_map
from engram.odometry.odometry import Odometry
from engram.robot.localisers import DriveSequence, session_of_drive
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import localise_drive
from engram.sequences.opening import open_drive
from engram_lab.there_and_back import ThereAndBack
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.simulating import simulate

Values = dict[str, Any]
CODE = Path(engram.__file__).parent
ISA: str = _core.isa


def rendered(campaign: str, sessions: list[int]) -> list[Path]:
    """Frame logs of a campaign's sessions; those that the cache lacks are rendered."""
    named = os.environ.get("ENGRAM_CAMPAIGNS")  # the cache of `engram simulate`
    folder = Path(named) if named else user_cache_path("engram") / "campaigns"
    report = simulate(campaign_named(campaign), folder, sessions=sessions)
    return [Path(file) for file in report.files]


def drive(path: Path, there_and_back: int | None = None, **how: Any) -> DriveSequence:
    """A drive, or so many frames of it there and back again."""
    sequence = open_drive(path, **how)
    return sequence if there_and_back is None else ThereAndBack(sequence, there_and_back)


def session_prefix(path: Path) -> str:
    """Beginning of the UUID of a drive's session."""
    return str(session_of_drive(drive(path)).id)[:13]


def input_hash(sequence: DriveSequence) -> str:
    """Of all that is read of a drive: pixels, or what its frame log recorded."""
    digest = hashlib.sha256()
    for one in sequence:
        if isinstance(one, StereoPair):
            digest.update(one.stamp_ns.to_bytes(8, "little"))
            digest.update(np.ascontiguousarray(one.left).data)
            digest.update(np.ascontiguousarray(one.right).data)
        else:
            digest.update(one.frame.stamp_ns.to_bytes(8, "little"))
            digest.update(_landmark_bytes(one.frame))
            motion = one.odometry.prev_from_curr
            digest.update(b"-" if motion is None else motion.matrix().tobytes())
    return digest.hexdigest()[:32]


def measured(sequence: DriveSequence) -> Iterator[Values]:
    """Front-end and odometry over a drive's images, frame by frame."""
    settings = Settings()
    frontend, odometry = Frontend(settings.frontend), Odometry(settings.odometry)
    for pair in sequence:
        frame = frontend.extract(pair)
        step = odometry.step(frame)
        yield {
            "frame": str(frame.status),
            "landmarks": len(frame.landmarks),
            "landmark_bytes": _landmark_bytes(frame),
            "status": str(step.status),
            "inliers": step.inliers,
            "prev_from_curr": None if step.prev_from_curr is None else step.prev_from_curr.matrix(),
            "covariance": step.covariance,
        }


def _most(threads: bool) -> int | None:
    """Most threads of a robot; without, all its lanes run on the caller's."""
    return None if threads else 5


def map_one(path: Path, sequence: DriveSequence, *, threads: bool, **how: Any) -> list[Values]:
    """Maps a drive; what was found of each frame."""
    report = map_drive(path, sequence, Settings(), RobotOptions(threads=_most(threads), **how))
    return [_found(one, one.motion.odometry.prev_from_curr) for one in report.results]


def localise(path: Path, sequence: DriveSequence, *, policy: str, threads: bool) -> list[Values]:
    """Localises a drive by the budget of the command line; what was found of each frame."""
    options = RobotOptions(ranking=policy, threads=_most(threads))
    with open_map(path) as opened:
        found = localise_drive(opened, sequence, Settings(), options)
    return [_found(one, one.motion.odometry.prev_from_curr) for one in found]


def live(path: Path, sequence: DriveSequence) -> list[Values]:
    """The same pair by pair, as a robot that embeds Engram does; its odometry is not shown."""
    with open_map(path) as opened, opened.robot(sequence.camera) as robot:
        return [_found(robot.localise(pair), None) for pair in sequence]


def merge(centre: Path, *robots: Path) -> list[Values]:
    """Merges maps into a centre; the counts of each merge."""
    names = (
        "sessions", "known", "known_omissions", "taken", "omitted", "edges", "path_entries",
        "attempts", "match_attempts", "proposed_attempts", "lookups", "components",
    )  # fmt: skip
    reports = merge_maps(centre, list(robots))
    return [{name: getattr(report, name) for name in names} for report in reports]


def send(centre: Path, out: Path, **options: Any) -> Values:
    """Downloads a part of a centre; its counts, and what its nodes promise."""
    names = (
        "nodes", "of_nodes", "sessions", "partial_paths", "edges", "bridges", "components",
        "expected_missed", "copy_missed",
    )  # fmt: skip
    report = download(centre, out, DownloadOptions(**options))
    return {name: getattr(report, name) for name in names}


def build(centre: Path, drives: list[Path], *, groups: int, threads: bool) -> Values:
    """Builds a centre of drives."""
    options = BuildOptions(workers=1, groups=groups, mapping=RobotOptions(threads=_most(threads)))
    report = build_map(centre, [str(path) for path in drives], Settings(), options)
    return {"groups": [" ".join(names) for names in report.groups]}


def revert(path: Path, revision: int) -> Values:
    """Takes a revision back; how many rows of others went with it."""
    with Map.open(path) as store:
        lost = store.revert(revision, author="golden").lost_by_others
    return {"lost_by_others": {name: count for name, count in sorted(lost.items()) if count}}


def contents(path: Path) -> Values:
    """A map: counts, and hashes of its records by table."""
    with Map.open(path) as store:
        info = store.info()
        names = ("revision", "sessions", "nodes", "edges", "path_entries", "attempts")
        return {
            "counts": {name: getattr(info, name) for name in names},
            "mapped_m": info.mapped_m,
            "records": store.record_hashes(),
        }


def copy_map(source: Path, target: Path) -> None:
    map_files.copy_map(source, target)


def robot_over(path: Path, sequence: DriveSequence) -> Iterator[object]:
    """A robot on a drive through its map: one result per `next`, for timing."""
    with open_map(path) as opened, opened.robot(sequence.camera) as robot:
        for pair in sequence:
            yield robot.localise(pair)


def _landmark_bytes(frame: Frame) -> bytes:
    columns = ("pixels", "disparity_px", "disparity_sigma_px", "points_in_cam", "descriptors",
               "octaves")  # fmt: skip
    parts = (np.ascontiguousarray(getattr(frame.landmarks, name)) for name in columns)
    return b"".join(part.tobytes() for part in parts)


def _found(found: Localisation, prev_from_curr: Any) -> Values:
    position = found.position
    return {
        "status": str(found.status),
        "node": None if found.node is None else str(found.node),
        "inliers": found.inliers,
        "attempts": found.attempts,
        "candidates": found.candidates,
        "proposed": found.proposed,
        "usable": found.motion.usable,
        "open_loop_m": found.open_loop_m,
        "moved_m": found.motion.moved_m,
        "node_from_live": None if found.node_from_live is None else found.node_from_live.matrix(),
        "covariance": found.covariance,
        "position": None
        if position is None
        else (str(position.node), position.node_from_live.matrix(), position.covariance),
        "prev_from_curr": None if prev_from_curr is None else prev_from_curr.matrix(),
    }
