"""A drive as a folder and as bags of every container: equal frames, and each localises the other.

    python -m engram_lab.checks.folder_and_bag DATA/kitti_odometry/sequences/06

PNG in bags is compared by `tests/sequences/test_real_drives.py`. Ends with 1 if a byte differs, or
if fewer than 48 of 51 frames are localised.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from itertools import zip_longest
from pathlib import Path

import numpy as np

from engram.calibration.calibrated_pair import Cameras
from engram.calibration.toml import calibration_toml
from engram.frontend.frame import StereoPair
from engram.maps.map import open_map
from engram.monitor import QUIET
from engram.robot.localisers import DriveSequence
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on
from engram.sequences.opening import open_drive
from engram_lab.checks.euroc_bag import write_bag

_LEAST_SHARE = 48 / 51


def equal(folder: DriveSequence, bag: DriveSequence) -> bool:
    """Whether both hold the same stamps and pixels."""
    for one, other in zip_longest(folder, bag):
        if not (isinstance(one, StereoPair) and isinstance(other, StereoPair)):
            return False
        same = np.array_equal(one.left, other.left) and np.array_equal(one.right, other.right)
        if one.stamp_ns != other.stamp_ns or not same:
            return False
    return True


def localised(town: Path, live: DriveSequence) -> tuple[int, int]:
    """Frames localised in a map, and all frames."""
    with open_map(town) as opened, robot_on(opened, live, Settings(), RobotOptions()) as robot:
        found = [one.localised for one in robot.drive(live, QUIET)]
    return sum(found), len(found)


def main() -> int:
    """Prints one line for each container."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    asked = parser.parse_args()
    missed = False
    with tempfile.TemporaryDirectory(prefix="engram-bag-") as name:
        work = Path(name)
        folder = open_drive(asked.folder)
        pairs = [one for one in folder if isinstance(one, StereoPair)]
        calibration = work / "calibration.toml"
        calibration.write_text(calibration_toml(Cameras(folder.camera)))
        map_drive(work / "folder.engram", folder)
        for kind in ("ros1", "sqlite3", "mcap"):
            pictures = ((one.stamp_ns, one.left, one.right) for one in pairs)
            bag = write_bag(work / kind, pictures, kind)
            same = equal(folder, open_drive(bag, calibration=calibration))
            there = localised(work / "folder.engram", open_drive(bag, calibration=calibration))
            town = work / f"{kind}.engram"
            map_drive(town, open_drive(bag, calibration=calibration))
            back = localised(town, folder)
            missed |= not same or min(there[0] / there[1], back[0] / back[1]) < _LEAST_SHARE
            print(
                f"{kind}: frames {'equal' if same else 'DIFFER'}; bag in the folder's map "
                f"{there[0]} of {there[1]}, folder in the bag's map {back[0]} of {back[1]}",
                flush=True,
            )
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
