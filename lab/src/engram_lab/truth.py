"""Readers of ground truth: that of a frame log, and matrices by stamp."""

from __future__ import annotations

from pathlib import Path

from engram.geometry.se3 import SE3
from engram.sequences.listing import nanoseconds
from engram.sequences.motion_files import (
    Trajectory,
    known_stamp,
    matrix_pose,
    read_rows,
    read_tum,
    trajectory_of,
)

# Ground truth of a frame log is beside it: NAME.framelog, NAME.truth.txt.
TRUTH_SUFFIX = ".truth.txt"


def truth_path(framelog: str | Path) -> Path:
    """Path of a frame log's ground truth: NAME.truth.txt next to NAME.framelog."""
    return Path(framelog).with_suffix(TRUTH_SUFFIX)


def read_truth(framelog: str | Path) -> Trajectory | None:
    """The ground truth next to a frame log, in TUM format; None if there is none."""
    path = truth_path(framelog)
    return read_tum(path) if path.exists() else None


def read_matrix_truth(path: str | Path) -> Trajectory:
    """Lines `stamp_ns` and 12 numbers: world_from_cam, 3×4 by rows."""

    def stamped(fields: list[str]) -> tuple[int, SE3]:
        return known_stamp(nanoseconds(fields[0])), matrix_pose(fields[1:])

    return trajectory_of(path, read_rows(path, stamped))
