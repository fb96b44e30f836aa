"""Readers of ground truth: KITTI, EuRoC, TUM-VI, Oxford RobotCar, and that of a frame log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, SequenceError
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
from engram.untrusted import read_text

# Ground truth of a frame log is beside it: NAME.framelog, NAME.truth.txt.
TRUTH_SUFFIX = ".truth.txt"


def truth_path(framelog: str | Path) -> Path:
    """Path of a frame log's ground truth: NAME.truth.txt next to NAME.framelog."""
    return Path(framelog).with_suffix(TRUTH_SUFFIX)


def read_truth(framelog: str | Path) -> Trajectory | None:
    """The ground truth next to a frame log, in TUM format; None if there is none.

    Raises:
        SequenceError: the file is malformed.
    """
    path = truth_path(framelog)
    return read_tum(path) if path.exists() else None


def read_kitti_poses(path: str | Path, stamps_ns: Sequence[int] | NDArray[np.int64]) -> Trajectory:
    """KITTI odometry's `poses/NN.txt`: line i is camera 0 of frame i in that of frame 0, 3×4.

    Args:
        path: the file.
        stamps_ns: (N,) int64 stamps of the frames, ns, one per line; the file has none.

    Raises:
        SequenceError: a line is not a pose, or the number of poses and stamps differs.
    """
    poses = read_rows(path, _matrix_pose)
    if len(poses) != len(stamps_ns):
        raise SequenceError(f"{path}: {len(poses)} poses for {len(stamps_ns)} stamps")
    return trajectory_of(path, zip(stamps_ns, poses, strict=True))


def read_matrix_truth(path: str | Path) -> Trajectory:
    """Lines `stamp_ns` and 12 numbers: world_from_cam, 3×4 by rows.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """

    def stamped(fields: list[str]) -> tuple[int, SE3]:
        return known_stamp(nanoseconds(fields[0])), _matrix_pose(fields[1:])

    return trajectory_of(path, read_rows(path, stamped))


def read_euroc_truth(path: str | Path, body_from_cam: SE3) -> Trajectory:
    """EuRoC's `state_groundtruth_estimate0/data.csv`: stamp_ns, position, quaternion wxyz, ….

    Args:
        path: the file; its poses are of the body.
        body_from_cam: pose of the wanted camera in the body frame, metres, such as the inverse
            of `StereoCamera.cam_from_rig`.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """

    def stamped(fields: list[str]) -> tuple[int, SE3]:
        values = finite(fields[1:8], 7)
        world_from_body = SE3.from_quaternion(values[3:], values[:3])
        return known_stamp(nanoseconds(fields[0].strip())), world_from_body @ body_from_cam

    return trajectory_of(path, read_rows(path, stamped, delimiter=","))


def read_mocap_truth(path: str | Path) -> Trajectory:
    """TUM-VI's `mav0/mocap0/data.csv`: stamp_ns, position, quaternion wxyz of the IMU.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """
    return read_euroc_truth(path, SE3.identity())


def read_ins_truth(path: Path) -> Trajectory:
    """`gps/ins.csv` or `rtk.csv` as truth: the INS in northing, easting, down from its first row.

    Its columns are taken by name: timestamp (µs), northing, easting, down (m), roll, pitch, yaw
    (rad). The pose is of the INS, not of the camera; shift it by the kit's `extrinsics/ins.txt`.

    Raises:
        SequenceError: a column is missing, or a row is malformed.
    """
    columns = ("timestamp", "northing", "easting", "down", "roll", "pitch", "yaw")

    def pose(values: list[float]) -> SE3:
        roll, pitch, yaw = values[3:]
        rotation = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
        return SE3(rotation, np.array(values[:3]))

    absolute = _csv_trajectory(path, columns, 1_000, pose)
    if not len(absolute):
        raise SequenceError(f"{path}: holds no row")
    # Coordinates of millions of metres would cost digits.
    origin = SE3(np.eye(3), -absolute.world_from_cam[0].translation)
    return Trajectory(absolute.stamps_ns, [origin @ one for one in absolute.world_from_cam])


def _about(axis: int, angle_rad: float) -> NDArray[np.float64]:
    vector = np.zeros(6)
    vector[3 + axis] = angle_rad
    return SE3.exp(vector).rotation


def _csv_trajectory(
    path: Path, columns: Sequence[str], ns_per_unit: int, pose: Callable[[list[float]], SE3]
) -> Trajectory:
    """A trajectory from a CSV file whose first line names its columns.

    Args:
        path: the file.
        columns: names of the stamp and of the values.
        ns_per_unit: unit of the stamps, which are whole numbers.
        pose: makes world_from_cam of the values.

    Raises:
        SequenceError: a column is missing, a row is malformed, or the stamps do not rise.
    """
    lines = read_text(path).splitlines()
    names = [name.strip().lstrip("#").strip() for name in lines[0].split(",")] if lines else []
    missing = [name for name in columns if name not in names]
    if missing:
        raise SequenceError(f"{path}: has no column {', '.join(missing)}; it has {names}")
    places = [names.index(name) for name in columns]
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        fields = line.split(",")
        try:
            values = finite([fields[place] for place in places[1:]], len(places) - 1)
            rows.append(
                (known_stamp(nanoseconds(fields[places[0]].strip())) * ns_per_unit, pose(values))
            )
        except (InputError, ValueError, IndexError) as error:
            raise SequenceError(f"{path}: line {number}: {error}") from error
    return trajectory_of(path, rows)


def _matrix_pose(fields: list[str]) -> SE3:
    return SE3.from_matrix(np.array(finite(fields, 12)).reshape(3, 4))
