"""Readers of ground truth: KITTI's, that of a frame log, and matrices by stamp."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.errors import SequenceError
from engram.geometry.se3 import SE3
from engram.sequences.listing import nanoseconds
from engram.sequences.motion_files import (
    Trajectory,
    finite,
    known_stamp,
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


def read_kitti_poses(path: str | Path, stamps_ns: Sequence[int] | NDArray[np.int64]) -> Trajectory:
    """KITTI odometry's `poses/NN.txt`: line i is camera 0 of frame i in that of frame 0, 3×4.

    Args:
        stamps_ns: (N,) int64 stamps of the frames, ns, one per line; the file has none.
    """
    poses = read_rows(path, _matrix_pose)
    if len(poses) != len(stamps_ns):
        raise SequenceError(f"{path}: {len(poses)} poses for {len(stamps_ns)} stamps")
    return trajectory_of(path, zip(stamps_ns, poses, strict=True))


def read_matrix_truth(path: str | Path) -> Trajectory:
    """Lines `stamp_ns` and 12 numbers: world_from_cam, 3×4 by rows."""

    def stamped(fields: list[str]) -> tuple[int, SE3]:
        return known_stamp(nanoseconds(fields[0])), _matrix_pose(fields[1:])

    return trajectory_of(path, read_rows(path, stamped))


def _matrix_pose(fields: list[str]) -> SE3:
    return SE3.from_matrix(np.array(finite(fields, 12)).reshape(3, 4))
