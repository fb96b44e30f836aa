"""Motion from outside for a drive: odometry and gyroscope topics of a bag, TUM and CSV files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, SequenceError
from engram.geometry.se3 import SE3
from engram.monitor import write_whole
from engram.odometry.outside import MotionSource, OutsideMotion
from engram.sequences.clocks import StampReport, SteadyClock, in_time
from engram.sequences.listing import nanoseconds, seconds_as_ns
from engram.untrusted import read_text

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of one camera over time.

    Attributes:
        stamps_ns: (N,) int64, rising.
        world_from_cam: N poses of the camera in the world frame, metres.
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
    """TUM format: lines `seconds x y z qx qy qz qw`; lines that begin with # are comments."""
    return trajectory_of(path, read_poses(path))


def read_poses(path: str | Path) -> list[tuple[int, SE3]]:
    """Stamps, ns, and poses of a file in TUM format, in any order."""

    def stamped(fields: list[str]) -> tuple[int, SE3]:
        stamp_ns = known_stamp(seconds_as_ns(fields[0]))
        x, y, z, qx, qy, qz, qw = finite(fields[1:], 7)
        return stamp_ns, SE3.from_quaternion([qw, qx, qy, qz], [x, y, z])

    return read_rows(path, stamped)


def read_kitti_poses(path: str | Path, stamps_ns: Sequence[int] | NDArray[np.int64]) -> Trajectory:
    """KITTI's format: line i is the (3, 4) pose of the left camera at frame i, by rows.

    Args:
        stamps_ns: (N,) int64 stamps of the frames, ns, one per line; the file has none.
    """
    poses = read_rows(path, matrix_pose)
    if len(poses) != len(stamps_ns):
        raise SequenceError(f"{path}: {len(poses)} poses for {len(stamps_ns)} stamps")
    return trajectory_of(path, zip(stamps_ns, poses, strict=True))


def matrix_pose(fields: list[str]) -> SE3:
    """The pose of the 12 numbers of a (3, 4) matrix, by rows; see `read_rows`."""
    return SE3.from_matrix(np.array(finite(fields, 12)).reshape(3, 4))


def write_tum(path: str | Path, trajectory: Trajectory, comments: Sequence[str] = ()) -> None:
    """Writes TUM format with stamps to the nanosecond; replaces an existing file atomically."""
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
        delimiter: between fields; None for white space.
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
    """The trajectory of a file's stamps, ns, and ``world_from_cam``."""
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


Vector = NDArray[np.float64]

# Samples hold for half a second: wheels come at 10 Hz and more.
_HOLDS_NS = 500_000_000
# How cameras look on most robots: forward, level; x forward, y left, z up (REP 103) in the rig.
FORWARD = SE3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
# Mountings turned by less: the rig's axes are a camera's, x right, y down, z forward.
_LIKE_A_CAMERA_RAD = float(np.deg2rad(45.0))
_GYRO = re.compile(r"w_RS_S_[xyz]|gyro_[xyz]|g[xyz]\b|angular_velocity[_.][xyz]")
_WHEELS = ("forward_m_s", "left_m_s", "turn_rad_s")


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """A measurement, which holds from the one before until its stamp.

    Attributes:
        velocity_m_s: (3,) of the rig in its own axes; None from a gyroscope.
        rates_rad_s: (3,) turn rates in the axes of rig or gyroscope.
    """

    stamp_ns: int
    velocity_m_s: Vector | None
    rates_rad_s: Vector


@runtime_checkable
class MovedSequence(Protocol):
    """A drive that may contain its motion from outside."""

    def motion(self) -> MotionSource | None:
        """A new pass through the motion from outside; None without one."""
        ...


class RigMotion:
    """A `MotionSource` over samples in the order of time.

    Args:
        wheels: samples of odometry; None for none.
        gyro: samples of a gyroscope, which replace the turn rates of the wheels.
        cam_from_rig: mounting of the camera; None for one that looks forward.
        rig_from_gyro: (3, 3) rotation of the gyroscope's axes to the rig's.
        shift_ns: what is added to the samples' stamps, ns.
    """

    def __init__(
        self,
        wheels: Iterator[Sample] | None,
        gyro: Iterator[Sample] | None,
        cam_from_rig: SE3 | None,
        rig_from_gyro: NDArray[np.float64] | None = None,
        shift_ns: int = 0,
    ) -> None:
        self._wheels = None if wheels is None else _Held(wheels)
        self._gyro = None if gyro is None else _Held(gyro)
        self._cam_from_rig = _mounted(cam_from_rig)
        self._rig_from_gyro = np.eye(3) if rig_from_gyro is None else rig_from_gyro
        self._shift_ns = shift_ns

    def between(self, start_ns: int, end_ns: int) -> OutsideMotion | None:
        """The motion between two stamps; see `MotionSource`."""
        at_ns, end_ns = start_ns - self._shift_ns, end_ns - self._shift_ns
        seconds = (end_ns - at_ns) / 1e9
        if seconds <= 0:
            return None
        pose, turned_rad = SE3.identity(), np.zeros(3)
        while at_ns < end_ns:
            wheels = None if self._wheels is None else self._wheels.at(at_ns)
            gyro = None if self._gyro is None else self._gyro.at(at_ns)
            held = [stream for stream in (wheels, gyro) if stream is not None]
            if len(held) < (self._wheels is not None) + (self._gyro is not None):
                return None
            until_ns = min([end_ns, *(sample.stamp_ns for sample in held)])
            step_s, at_ns = (until_ns - at_ns) / 1e9, until_ns
            velocity = np.zeros(3)
            if wheels is not None and wheels.velocity_m_s is not None:
                velocity = wheels.velocity_m_s
            if gyro is not None:
                rates = self._rig_from_gyro @ gyro.rates_rad_s
                turned_rad = turned_rad + rates * step_s
            else:
                assert wheels is not None
                rates = wheels.rates_rad_s
            pose = pose @ SE3.exp(np.r_[velocity, rates] * step_s)
        cam = self._cam_from_rig
        raw = None
        if self._gyro is not None:
            raw = cam.rotation @ turned_rad / seconds
        return OutsideMotion(cam @ pose @ cam.inverse(), seconds, self._wheels is not None, raw)


def _mounted(cam_from_rig: SE3 | None) -> SE3:
    """cam_from_rig of a rig with x forward; KITTI's rig, for one, has the axes of a camera."""
    if cam_from_rig is None:
        return FORWARD
    return cam_from_rig @ FORWARD if cam_from_rig.angle_rad < _LIKE_A_CAMERA_RAD else cam_from_rig


class _Held:
    """The sample that holds at a time; times rise from call to call."""

    def __init__(self, samples: Iterator[Sample]) -> None:
        self._samples = samples
        self._next: Sample | None = next(samples, None)

    def at(self, stamp_ns: int) -> Sample | None:
        """The first sample later than a stamp; None if it is too far away."""
        while self._next is not None and self._next.stamp_ns <= stamp_ns:
            self._next = next(self._samples, None)
        if self._next is None or self._next.stamp_ns - stamp_ns > _HOLDS_NS:
            return None
        return self._next


def motion_of_files(
    names: tuple[str, ...], cam_from_rig: SE3 | None, shift_ns: int = 0
) -> RigMotion | None:
    """The motion of files: poses in TUM format (.tum, .txt), or speeds or rates in CSV.

    Args:
        names: at most one file of odometry and one of a gyroscope.
        shift_ns: what is added to the stamps, ns.
    """
    if not names:
        return None
    wheels: list[Sample] | None = None
    gyro: list[Sample] | None = None
    for name in names:
        samples = read_samples(Path(name))
        is_gyro = samples[0].velocity_m_s is None
        if (gyro if is_gyro else wheels) is not None:
            kind = "gyroscope" if is_gyro else "odometry"
            raise SequenceError(f"--motion {name}: is a second {kind}; give one of each kind")
        if is_gyro:
            gyro = samples
        else:
            wheels = samples
    return RigMotion(
        None if wheels is None else iter(wheels),
        None if gyro is None else iter(gyro),
        cam_from_rig,
        shift_ns=shift_ns,
    )


def stamp_facts_of_files(names: tuple[str, ...]) -> list[str]:
    """Faults of the stamps of files of motion, for people; empty for sound ones."""
    reports = ((name, timed_samples(Path(name))[1]) for name in names if Path(name).is_file())
    return [fact for name, report in reports for fact in report.texts(f"sample of {name}")]


def read_samples(path: Path) -> list[Sample]:
    """The samples of a file."""
    return timed_samples(path)[0]


def timed_samples(path: Path) -> tuple[list[Sample], StampReport]:
    """The samples of a file by rising time, and the report on their stamps."""
    clock = SteadyClock(waits=True)
    if path.suffix.lower() == ".csv":
        timed = in_time(_csv_samples(path), lambda sample: sample.stamp_ns, clock)
        samples = [replace(sample.item, stamp_ns=sample.time_ns) for sample in timed]
    else:
        samples = _pose_samples(path, clock)
    report = clock.report
    if not samples:
        raise SequenceError(f"{path}: holds no motion")
    if 2 * report.left_out >= report.count:
        facts = "; ".join(report.texts("sample"))
        raise SequenceError(f"{path}: its stamps do not increase: {facts}")
    return samples, report


def _pose_samples(path: Path, clock: SteadyClock) -> list[Sample]:
    """Speeds between the poses of a TUM file: the rig's, in the frame where it began."""
    samples = []
    for before, after in pairwise(in_time(read_poses(path), lambda pose: pose[0], clock)):
        step = before.item[1].inverse() @ after.item[1]
        twist = step.log() / ((after.time_ns - before.time_ns) / 1e9)
        samples.append(Sample(after.time_ns, twist[:3], twist[3:]))
    return samples


def _csv_samples(path: Path) -> list[Sample]:
    """Speeds or rates of a CSV file, by the names of its columns.

    EuRoC's `imu0/data.csv` (timestamp [ns], w_RS_S_x …), or a stamp (`seconds` or `stamp_ns`) with
    forward_m_s, and perhaps left_m_s and turn_rad_s, or with gyro_x, gyro_y, gyro_z.
    """
    lines = read_text(path).splitlines()
    names = [name.strip().lstrip("#").strip() for name in lines[0].split(",")] if lines else []
    gyro = [at for at, name in enumerate(names) if _GYRO.match(name)]
    wheels = {name: names.index(name) for name in _WHEELS if name in names}
    if len(gyro) != 3 and "forward_m_s" not in wheels:
        raise SequenceError(
            f"{path}: its first line must name the columns: a stamp (seconds or stamp_ns) and "
            f"forward_m_s, left_m_s, turn_rad_s, or gyro_x, gyro_y, gyro_z; it has {names}"
        )
    parse = seconds_as_ns if names[0].startswith("second") else nanoseconds
    samples = []
    for number, line in enumerate(lines[1:], start=2):
        fields = [field.strip() for field in line.split(",")]
        try:
            stamp_ns = parse(fields[0])
            values = [float(field) for field in fields[1:]]
            if stamp_ns is None or not np.isfinite(values).all():
                raise ValueError("is not a stamp and finite numbers")
            if len(gyro) == 3:
                rates = np.array([values[at - 1] for at in gyro])
                samples.append(Sample(stamp_ns, None, rates))
            else:
                of = {name: values[at - 1] for name, at in wheels.items()}
                velocity = np.array([of["forward_m_s"], of.get("left_m_s", 0.0), 0.0])
                turn = np.array([0.0, 0.0, of.get("turn_rad_s", 0.0)])
                samples.append(Sample(stamp_ns, velocity, turn))
        except (ValueError, IndexError) as error:
            raise SequenceError(f"{path}: line {number}: {error}") from error
    return samples
