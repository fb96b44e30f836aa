"""Trajectories and their text format, that of TUM."""

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
from engram.sequences.listing import seconds_as_ns
from engram.untrusted import read_text

T = TypeVar("T")


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


def read_tum(path: str | Path) -> Trajectory:
    """TUM format: lines `seconds x y z qx qy qz qw`; lines that begin with # are comments.

    Raises:
        SequenceError: a line is something else, or the stamps do not rise.
    """
    return trajectory_of(path, read_poses(path))


def read_poses(path: str | Path) -> list[tuple[int, SE3]]:
    """Stamps, ns, and poses of a file in TUM format, in any order.

    Raises:
        SequenceError: a line is something else.
    """

    def stamped(fields: list[str]) -> tuple[int, SE3]:
        stamp_ns = known_stamp(seconds_as_ns(fields[0]))
        x, y, z, qx, qy, qz, qw = finite(fields[1:], 7)
        return stamp_ns, SE3.from_quaternion([qw, qx, qy, qz], [x, y, z])

    return read_rows(path, stamped)


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


def read_rows(
    path: str | Path, row: Callable[[list[str]], T], delimiter: str | None = None
) -> list[T]:
    """The parsed rows of a text file; comments and empty lines are skipped.

    Args:
        path: the file.
        row: parses the fields of a line.
        delimiter: between fields; None for white space.

    Raises:
        SequenceError: a line cannot be parsed.
    """
    found = []
    for number, line in enumerate(read_text(Path(path)).splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            try:
                found.append(row(line.split(delimiter)))
            except (InputError, ValueError) as error:
                raise SequenceError(f"{path}: line {number}: {error}") from error
    return found


def trajectory_of(path: str | Path, poses: Iterable[tuple[int, SE3]]) -> Trajectory:
    """The trajectory of a file's stamps, ns, and ``world_from_cam``.

    Raises:
        SequenceError: the stamps do not rise.
    """
    listed = list(poses)
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in listed], dtype=np.int64)
    try:
        return Trajectory(stamps_ns, [pose for _, pose in listed])
    except InputError as error:
        raise SequenceError(f"{path}: {error}") from error


def known_stamp(stamp_ns: int | None) -> int:
    """The stamp of a row that must have one, ns; see `read_rows`."""
    if stamp_ns is None:
        raise ValueError("does not begin with a stamp")
    return stamp_ns


def finite(fields: Sequence[str], count: int) -> list[float]:
    """A given number of finite numbers of a row; see `read_rows`."""
    values = [float(field) for field in fields]
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"must have {count} finite numbers for the pose, has {len(values)}")
    return values
