"""A robot that maps while it drives, in real time: how many of its answers come late.

    python -m engram_lab.checks.live_mapping DRIVE [--frames 1000] [--rate 20] [--deadline 40]

The drive is repeated there and back until there are enough frames; the robot maps it in an empty
map, on as many cores as the process may use (`taskset -c 0,1` for two). A frame is late when its
answer comes after the deadline, counted from the time at which the camera delivered it.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from engram.maps.map import open_map
from engram.monitor import QUIET
from engram.robot.live import Owner
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_in
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram_lab.there_and_back import ThereAndBack


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=20.0, help="frames a second")
    parser.add_argument("--deadline", type=float, default=40.0, help="ms")
    asked = parser.parse_args()
    drive = open_drive(asked.drive)
    if isinstance(drive, FrameLog):
        parser.error("a frame log leaves out what a live robot does with its images; give a folder")
    sequence = ThereAndBack(drive, asked.frames)
    options = RobotOptions(deadline_ms=asked.deadline)
    owner = Owner("live", sequence.camera, Settings(), options)
    found = []
    with tempfile.TemporaryDirectory(prefix="engram-live-") as folder:
        town = open_map(Path(folder) / "live.engram", create=True)
        with town, robot_in(town, owner, maps=True) as robot:
            found = list(robot.drive(sequence, QUIET, asked.rate))
    late = sum(one.late for one in found)
    took_ms = np.array([one.ms for one in found])
    cores = len(os.sched_getaffinity(0))
    print(f"{len(found)} frames at {asked.rate:g} Hz on {cores} cores: {late} late "
          f"({late / len(found):.2%}) of a deadline of {asked.deadline:g} ms")  # fmt: skip
    print(f"{robot.saving.nodes} nodes saved, {sum(one.localised for one in found)} localised")
    print(
        f"{np.median(took_ms):.1f} ms a frame, 99 of 100 below {np.percentile(took_ms, 99):.1f} ms"
    )
    return int(late > 0.01 * len(found))


if __name__ == "__main__":
    sys.exit(main())
