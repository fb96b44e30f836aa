"""Trajectories as text: KITTI poses, EuRoC truth, and TUM, which evo reads and we write."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, SequenceError
from engram.geometry import SE3
from engram.sequences.stamps import nanoseconds, read_text, seconds_as_ns

# Frame logs have their truth beside them: NAME.framelog, NAME.truth.txt.
TRUTH_SUFFIX = ".truth.txt"


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of one camera over time.

    Attributes:
        stamps_ns: (N,) int64, rising.
        world_from_cam: N poses of the camera, metres.

    Raises:
        InputError: the two have different lengths, or the stamps do not rise.
    """

    stamps_ns: NDArray[np.int64]
    world_from_cam: Sequence[SE3]

    def __post_init__(self) -> None:
        if self.stamps_ns.shape != (len(self.world_from_cam),):
            raise InputError(
                f"a trajectory of {len(self.world_from_cam)} poses has stamps of shape "
                f"{self.stamps_ns.shape}"
            )
        if (np.diff(self.stamps_ns) <= 0).any():
            raise InputError("a trajectory's stamps must rise")

    def __len__(self) -> int:
        return len(self.world_from_cam)

    def at(self, stamp_ns: int, tolerance_ns: int = 0) -> SE3 | None:
        """The pose with the nearest stamp; None if none lies within the tolerance."""
        if not len(self):
            return None
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        index = min(
            (index for index in (after - 1, after) if 0 <= index < len(self)),
            key=lambda index: abs(int(self.stamps_ns[index]) - stamp_ns),
        )
        near = abs(int(self.stamps_ns[index]) - stamp_ns) <= tolerance_ns
        return self.world_from_cam[index] if near else None


def read_kitti_poses(path: str | Path, stamps_ns: Sequence[int] | NDArray[np.int64]) -> Trajectory:
    """KITTI odometry's `poses/NN.txt`: line i is camera 0 of frame i in that of frame 0, 3×4.

    Args:
        path: the file.
        stamps_ns: stamps of the frames (the file has none), one a line.

    Raises:
        SequenceError: a line is no pose, or there are more or fewer of them than stamps.
    """
    path = Path(path)
    poses = [_matrix_pose(path, number, fields) for number, fields in _rows(path)]
    if len(poses) != len(stamps_ns):
        raise SequenceError(f"{path}: {len(poses)} poses for {len(stamps_ns)} stamps")
    return _trajectory(path, list(stamps_ns), poses)


def read_matrix_truth(path: str | Path) -> Trajectory:
    """Lines `stamp_ns` and 12 numbers: world_from_cam, 3×4 by rows.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """
    path = Path(path)
    stamps_ns, poses = [], []
    for number, fields in _rows(path):
        stamps_ns.append(_stamp(path, number, nanoseconds(fields[0])))
        poses.append(_matrix_pose(path, number, fields[1:]))
    return _trajectory(path, stamps_ns, poses)


def read_euroc_truth(path: str | Path, body_from_cam: SE3) -> Trajectory:
    """EuRoC's `state_groundtruth_estimate0/data.csv`: stamp_ns, position, quaternion wxyz, ….

    Args:
        path: the file; its poses are of the body.
        body_from_cam: mounting of the camera whose trajectory is wanted, such as the inverse of
            `StereoCamera.cam_from_rig`.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """
    path = Path(path)
    stamps_ns, poses = [], []
    for number, fields in _rows(path, delimiter=","):
        values = _floats(path, number, fields[1:8], 7)
        stamps_ns.append(_stamp(path, number, nanoseconds(fields[0].strip())))
        poses.append(_quaternion_pose(path, number, values[3:], values[:3]) @ body_from_cam)
    return _trajectory(path, stamps_ns, poses)


def read_tum(path: str | Path) -> Trajectory:
    """TUM format: lines `seconds x y z qx qy qz qw`; lines that begin with # are comments.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """
    path = Path(path)
    stamps_ns, poses = [], []
    for number, fields in _rows(path):
        stamps_ns.append(_stamp(path, number, seconds_as_ns(fields[0])))
        x, y, z, qx, qy, qz, qw = _floats(path, number, fields[1:], 7)
        poses.append(_quaternion_pose(path, number, [qw, qx, qy, qz], [x, y, z]))
    return _trajectory(path, stamps_ns, poses)


def write_tum(path: str | Path, trajectory: Trajectory, comments: Sequence[str] = ()) -> None:
    """Write TUM format, nanoseconds kept; an existing file is replaced in one step.

    Args:
        path: the file.
        trajectory: what to write.
        comments: lines for the head of the file; evo passes over them.

    Raises:
        SequenceError: the file cannot be written.
    """
    path = Path(path)
    lines = [f"# {line}" for comment in comments for line in comment.splitlines()]
    lines.append("# seconds x y z qx qy qz qw (world_from_cam, metres)")
    for stamp_ns, pose in zip(trajectory.stamps_ns, trajectory.world_from_cam, strict=True):
        seconds, nanos = divmod(abs(int(stamp_ns)), 1_000_000_000)
        sign = "-" if stamp_ns < 0 else ""
        w, x, y, z = pose.quaternion_wxyz()
        numbers = " ".join(f"{value:.9f}" for value in (*pose.translation, x, y, z, w))
        lines.append(f"{sign}{seconds}.{nanos:09d} {numbers}")
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")
        draft.replace(path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise SequenceError(f"{path}: cannot be written: {error.strerror}") from error


def truth_path(framelog: str | Path) -> Path:
    """Where the truth of a frame log stands: NAME.truth.txt beside NAME.framelog."""
    return Path(framelog).with_suffix(TRUTH_SUFFIX)


def read_truth(framelog: str | Path) -> Trajectory | None:
    """The truth beside a frame log, TUM format; None if there is none.

    Raises:
        SequenceError: the file is there and malformed.
    """
    path = truth_path(framelog)
    return read_tum(path) if path.exists() else None


def _rows(path: Path, delimiter: str | None = None) -> Iterator[tuple[int, list[str]]]:
    """Numbered rows of fields, without comments and empty lines."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            yield number, line.split(delimiter)


def _trajectory(path: Path, stamps_ns: list[int], poses: list[SE3]) -> Trajectory:
    try:
        return Trajectory(np.array(stamps_ns, dtype=np.int64), poses)
    except InputError as error:
        raise SequenceError(f"{path}: {error}") from error


def _stamp(path: Path, number: int, stamp_ns: int | None) -> int:
    if stamp_ns is None:
        raise SequenceError(f"{path}: line {number} does not begin with a stamp")
    return stamp_ns


def _floats(path: Path, number: int, fields: Sequence[str], count: int) -> list[float]:
    try:
        values = [float(field) for field in fields]
    except ValueError as error:
        raise SequenceError(f"{path}: line {number}: {error}") from None
    if len(values) != count or not np.isfinite(values).all():
        raise SequenceError(
            f"{path}: line {number} must have {count} finite numbers for the pose, has "
            f"{len(values)}"
        )
    return values


def _matrix_pose(path: Path, number: int, fields: Sequence[str]) -> SE3:
    values = np.array(_floats(path, number, fields, 12)).reshape(3, 4)
    try:
        return SE3.from_matrix(values)
    except InputError as error:
        raise SequenceError(f"{path}: line {number}: {error}") from error


def _quaternion_pose(
    path: Path, number: int, wxyz: Sequence[float], translation: Sequence[float]
) -> SE3:
    try:
        return SE3.from_quaternion(wxyz, translation)
    except InputError as error:
        raise SequenceError(f"{path}: line {number}: {error}") from error
