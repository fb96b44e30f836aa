"""Real drives as clips, where ENGRAM_DATA names them: one part is mapped, another driven there.

Each is driven there and back, or back and there, so that it is as long as a rendered clip. Cameras
keep looking the same way.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path

from engram.errors import SequenceError
from engram.frontend import StereoPair
from engram.geometry import SE3
from engram.robot import open_drive
from engram.sequences.trajectories import Trajectory
from engram_lab.studies.faults.clips import Clip
from engram_lab.truth import read_kitti_poses, read_matrix_truth


@dataclass(frozen=True, slots=True)
class RealDrive:
    """A real drive with truth.

    Attributes:
        rig: name of its cameras.
        folder, truth_file: below the folder of the data.
        read_truth: reads that file; gets the stamps of the frames, ns.
        mapped, live: the frames of which the map is made, and those that are driven in it.
    """

    rig: str
    folder: str
    truth_file: str
    read_truth: Callable[[Path, Sequence[int]], Trajectory]
    mapped: slice
    live: slice


DRIVES = {
    "kitti-06": RealDrive(
        "kitti",
        "kitti_odometry/sequences/06",
        "kitti_odometry/poses/06.txt",
        read_kitti_poses,
        slice(0, None, 2),
        slice(1, None, 2),
    ),
    "v1-01": RealDrive(  # of 63 frames, within 110 s, in the same room again and again
        "euroc",
        "euroc/V1_01_easy_sparse",
        "euroc/V1_01_easy_sparse/poses_world_from_rectified_cam0.txt",
        lambda path, _: read_matrix_truth(path),
        slice(0, 31),
        slice(31, None),
    ),
}


@dataclass(frozen=True, slots=True)
class RealPlan:
    """What a real clip shows; see `Plan`.

    Attributes:
        town: key in `DRIVES`.
        part: "mapped"; "there", and back; or "back", and there.
        data: folder of the real data.
    """

    town: str
    part: str
    data: Path

    @property
    def name(self) -> str:
        """Such as ``kitti-06-there``."""
        return f"{self.town}-{self.part}"

    @property
    def rig(self) -> str:
        """Name of the cameras."""
        return DRIVES[self.town].rig

    @property
    def mapped(self) -> bool:
        """Whether the map is made of it."""
        return self.part == "mapped"

    @property
    def reverse(self) -> bool:
        """Never: the cameras keep looking in the same direction."""
        return False

    def read(self) -> Clip:
        """The clip.

        Raises:
            SequenceError: images or truth cannot be used.
        """
        drive = DRIVES[self.town]
        pairs = [one for one in open_drive(self.data / drive.folder) if isinstance(one, StereoPair)]
        truth = drive.read_truth(self.data / drive.truth_file, [one.stamp_ns for one in pairs])
        frames = [(pair, _pose(truth, pair)) for pair in pairs]
        if self.mapped:
            chosen = frames[drive.mapped]
        else:
            there = frames[drive.live]
            chosen = there + there[-2::-1] if self.part == "there" else there[::-1] + there[1:]
        return Clip(self, _restamped([pair for pair, _ in chosen]), [pose for _, pose in chosen])


def _pose(truth: Trajectory, pair: StereoPair) -> SE3:
    world_from_cam = truth.at(pair.stamp_ns)
    if world_from_cam is None:
        raise SequenceError(f"the frame at {pair.stamp_ns} ns has no true pose; each needs one")
    return world_from_cam


def _restamped(pairs: Sequence[StereoPair]) -> list[StereoPair]:
    """The pairs as far apart in time as they were, one after the other also where time ran back."""
    gaps_ns = (abs(b.stamp_ns - a.stamp_ns) for a, b in pairwise(pairs))
    stamps_ns = accumulate(gaps_ns, initial=pairs[0].stamp_ns)
    return [replace(pair, stamp_ns=at) for pair, at in zip(pairs, stamps_ns, strict=True)]


def real_plans() -> list[RealPlan]:
    """The clips of the drives that are below the folder of ENGRAM_DATA; none without it."""
    named = os.environ.get("ENGRAM_DATA")
    if not named:
        return []
    data = Path(named)
    there = [town for town, drive in DRIVES.items() if (data / drive.folder).is_dir()]
    return [RealPlan(town, part, data) for town in there for part in ("mapped", "there", "back")]
