"""Tiny campaigns of frame logs: drives along one road, in a few appearances of the world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tests.builders import World, drive

from engram.graph.model import Clock
from engram.robot.settings import RobotOptions
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FrameLogWriter
from engram.sequences.motion_files import Trajectory, write_tum
from engram.sequences.sequence import LoggedFrame, SequenceInfo
from engram_lab.studies.drives import DriveSet, drives_of
from engram_lab.studies.running import RankingOptions
from engram_lab.truth import truth_path

WORLD = World(24.0)
ROAD = np.arange(0.0, 18.0, 0.9)
DAY_NS = 86_400_000_000_000
# Few enough to be quick.
LOOKS = (0, 1, 0, 1, 0, 1)


def write_campaign(folder: Path, looks=LOOKS, *, truth: bool = True, road=ROAD) -> DriveSet:
    """One log per look, a day apart, each 0.1 m further aside than the one before."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, look in enumerate(looks):
        seen = drive(
            WORLD,
            road + 0.11 * number,
            look,
            aside_m=0.1 * (number % 3),
            start_ns=20_000 * DAY_NS + number * DAY_NS,
            seed=number,
        )
        path = folder / f"{number:03d}.framelog"
        info = SequenceInfo(path.stem, "synthetic", Clock.UTC, "robot", 0.0)
        first = seen[0].frame
        header = FrameLogHeader(info, first.camera, first.descriptor, first.frontend)
        writer = FrameLogWriter(path, header)
        for index, one in enumerate(seen):
            writer.append(LoggedFrame(one.frame, one.odometry), f"{number:032x}{index:032x}")
        writer.close(complete=True)
        if truth:
            stamps = np.array([one.frame.stamp_ns for one in seen], np.int64)
            write_tum(truth_path(path), Trajectory(stamps, [one.world_from_live for one in seen]))
        paths.append(path)
    return DriveSet("tiny", drives_of(paths))


def few_options(**changes) -> RankingOptions:
    """Two policies, two budgets, two folds."""
    values = {
        "policies": ("distance", "path-near"),
        "lanes": (1, 2),
        "rounds": (1,),
        "folds": 2,
        "live_folds": 0,
        "map_sizes": False,
        # One core and a second are enough on so short a road.
        "build": RobotOptions(ranking="path-near", lanes=2, rounds=4, relocaliser="exhaustive"),
    }
    return RankingOptions(**{**values, **changes})
