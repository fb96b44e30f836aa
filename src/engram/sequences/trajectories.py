"""Text formats of trajectories: reads KITTI poses, EuRoC ground truth and TUM; writes TUM."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, SequenceError
from engram.geometry import SE3
from engram.monitor import write_whole
from engram.sequences.listing import nanoseconds, seconds_as_ns
from engram.untrusted import read_text

T = TypeVar("T")

# Ground truth of a frame log is beside it: NAME.framelog, NAME.truth.txt.
TRUTH_SUFFIX = ".truth.txt"


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of one camera over time.

    Attributes:
        stamps_ns: (N,) int64, rising.
        world_from_cam: N poses of the camera in the world frame, metres.

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
            raise InputError("a trajectory's stamps must increase")

    def __len__(self) -> int:
        return len(self.world_from_cam)

    def at(self, stamp_ns: int, tolerance_ns: int = 0) -> SE3 | None:
        """``world_from_cam`` at the nearest stamp; None if none is within the tolerance (ns)."""
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
        stamps_ns: (N,) int64 stamps of the frames, ns, one per line; the file has none.

    Raises:
        SequenceError: a line is not a pose, or the number of poses and stamps differs.
    """
    poses = _read(path, _matrix_pose)
    if len(poses) != len(stamps_ns):
        raise SequenceError(f"{path}: {len(poses)} poses for {len(stamps_ns)} stamps")
    return _trajectory(path, zip(stamps_ns, poses, strict=True))


def read_matrix_truth(path: str | Path) -> Trajectory:
    """Lines `stamp_ns` and 12 numbers: world_from_cam, 3×4 by rows.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """

    def stamped(fields: list[str]) -> tuple[int, SE3]:
        return _stamp(nanoseconds(fields[0])), _matrix_pose(fields[1:])

    return _trajectory(path, _read(path, stamped))


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
        values = _floats(fields[1:8], 7)
        world_from_body = SE3.from_quaternion(values[3:], values[:3])
        return _stamp(nanoseconds(fields[0].strip())), world_from_body @ body_from_cam

    return _trajectory(path, _read(path, stamped, delimiter=","))


def read_mocap_truth(path: str | Path) -> Trajectory:
    """TUM-VI's `mav0/mocap0/data.csv`: stamp_ns, position, quaternion wxyz of the IMU.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """
    return read_euroc_truth(path, SE3.identity())


def csv_trajectory(
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
            values = _floats([fields[place] for place in places[1:]], len(places) - 1)
            rows.append(
                (_stamp(nanoseconds(fields[places[0]].strip())) * ns_per_unit, pose(values))
            )
        except (InputError, ValueError, IndexError) as error:
            raise SequenceError(f"{path}: line {number}: {error}") from error
    return _trajectory(path, rows)


def read_tum(path: str | Path) -> Trajectory:
    """TUM format: lines `seconds x y z qx qy qz qw`; lines that begin with # are comments.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """

    def stamped(fields: list[str]) -> tuple[int, SE3]:
        stamp_ns = _stamp(seconds_as_ns(fields[0]))
        x, y, z, qx, qy, qz, qw = _floats(fields[1:], 7)
        return stamp_ns, SE3.from_quaternion([qw, qx, qy, qz], [x, y, z])

    return _trajectory(path, _read(path, stamped))


def write_tum(path: str | Path, trajectory: Trajectory, comments: Sequence[str] = ()) -> None:
    """Writes TUM format with stamps to the nanosecond; replaces an existing file atomically.

    Args:
        path: the file.
        trajectory: what to write.
        comments: lines for the head of the file; evo skips them.

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
    try:
        with write_whole(path) as draft:
            draft.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise SequenceError(f"{path}: cannot be written: {error.strerror}") from error


def truth_path(framelog: str | Path) -> Path:
    """Path of a frame log's ground truth: NAME.truth.txt beside NAME.framelog."""
    return Path(framelog).with_suffix(TRUTH_SUFFIX)


def read_truth(framelog: str | Path) -> Trajectory | None:
    """The ground truth beside a frame log, in TUM format; None if there is none.

    Raises:
        SequenceError: the file is malformed.
    """
    path = truth_path(framelog)
    return read_tum(path) if path.exists() else None


def _read(path: str | Path, row: Callable[[list[str]], T], delimiter: str | None = None) -> list[T]:
    """The parsed rows; comments and empty lines are skipped."""
    found = []
    for number, line in enumerate(read_text(Path(path)).splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            try:
                found.append(row(line.split(delimiter)))
            except (InputError, ValueError) as error:
                raise SequenceError(f"{path}: line {number}: {error}") from error
    return found


def _trajectory(path: str | Path, poses: Iterable[tuple[int, SE3]]) -> Trajectory:
    listed = list(poses)
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in listed], dtype=np.int64)
    try:
        return Trajectory(stamps_ns, [pose for _, pose in listed])
    except InputError as error:
        raise SequenceError(f"{path}: {error}") from error


def _stamp(stamp_ns: int | None) -> int:
    if stamp_ns is None:
        raise ValueError("does not begin with a stamp")
    return stamp_ns


def _floats(fields: Sequence[str], count: int) -> list[float]:
    values = [float(field) for field in fields]
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"must have {count} finite numbers for the pose, has {len(values)}")
    return values


def _matrix_pose(fields: list[str]) -> SE3:
    return SE3.from_matrix(np.array(_floats(fields, 12)).reshape(3, 4))
