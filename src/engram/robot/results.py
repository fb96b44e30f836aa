"""What a drive came to: its path by odometry, and the file that ``localise --json`` prints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from engram.doctor.table import Finding
from engram.errors import InputError
from engram.geometry.se3 import SE3
from engram.localiser.localisation import Localisation, LocalisationStatus
from engram.monitor import QUIET, Monitor
from engram.robot.front import Front, arriving, stamp_of
from engram.robot.robot import DisplayPose
from engram.robot.settings import Settings
from engram.robot.starting import measured
from engram.sequences.motion_files import Trajectory, trajectory_of
from engram.sequences.opening import Drive
from engram.untrusted import read_bytes

# A drive of a day at 10 Hz has 900,000 frames, of 800 bytes each.
_MAX_BYTES = 1_000_000_000


class ResultFrame(msgspec.Struct, frozen=True, kw_only=True):
    """One frame of a localised drive, as `docs/json.md` describes it."""

    stamp_ns: int
    status: LocalisationStatus
    step_m: float = 0.0
    map_from_live: list[float] | None = None
    node: str | None = None
    node_stamp_ns: int | None = None
    inliers: int = 0
    confidence: float | None = None
    attempts: int = 0

    def pose(self) -> SE3 | None:
        """``map_from_live``; None where the robot did not know where it was.

        Raises:
            InputError: the numbers are not a rigid transform.
        """
        if self.map_from_live is None:
            return None
        if len(self.map_from_live) != 16:
            raise InputError(f"map_from_live has {len(self.map_from_live)} numbers, must have 16")
        return SE3.from_matrix(np.array(self.map_from_live).reshape(4, 4))


class DriveSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What people look at of a drive's summary; see `engram.robot.starting.summarise`."""

    frames: int
    share_localised: float
    statuses: dict[str, int]
    driven_m: float
    longest_gap_m: float
    p_no_match_10m: float
    attempts_per_frame: float
    withdrawn: int = 0
    unusable_frames: int = 0
    stages_ms: dict[str, dict[str, float]] = {}  # Msgspec copies it
    findings: list[Finding] = []
    trusted: bool = True


class DriveResult(msgspec.Struct, frozen=True, kw_only=True):
    """A localised drive.

    Attributes:
        map, drive: the paths as they were typed; empty in files of earlier versions.
        frames: one per frame, in order.
    """

    map: str = ""
    drive: str = ""
    summary: DriveSummary
    frames: list[ResultFrame]

    def trajectory(self, name: str = "the result") -> Trajectory:
        """Where the robot took itself to be, in the map frame: frames with a pose.

        Raises:
            InputError: a pose is damaged, or the stamps do not increase.
        """
        poses = [(one.stamp_ns, pose) for one in self.frames if (pose := one.pose()) is not None]
        return trajectory_of(name, poses)

    def driven_m(self) -> NDArray[np.float64]:
        """(F,) distance driven at each frame, metres."""
        return np.cumsum([one.step_m for one in self.frames])


class ResultRecords:
    """Collects the records of a drive's frames, frame by frame.

    Args:
        display: places the robot in the map frame; used by nothing else.
    """

    def __init__(self, display: DisplayPose) -> None:
        self._display = display
        self._poses: list[SE3 | None] = []

    def see(self, found: Localisation) -> None:
        """Notes where the robot is, at the next frame."""
        self._poses.append(self._display.after(found))

    def frames(self, results: Sequence[Localisation]) -> list[dict[str, Any]]:
        """The records of all frames seen."""
        steps_m = measured(results).step_m.tolist()
        return [
            {
                **result.to_dict(),
                "step_m": step_m,
                "map_from_live": None if pose is None else pose.matrix().ravel().tolist(),
            }
            for result, step_m, pose in zip(results, steps_m, self._poses, strict=True)
        ]


def read_result(path: Path) -> DriveResult:
    """A file that ``engram localise --json`` printed.

    Raises:
        InputError: it is something else, or damaged.
    """
    try:
        found = msgspec.json.decode(read_bytes(path, _MAX_BYTES, InputError), type=DriveResult)
    except (msgspec.DecodeError, RecursionError) as error:
        raise InputError(
            f"{path}: is not a result of engram localise MAP DRIVE --json: {error}"
        ) from error
    if not all(math.isfinite(one.step_m) for one in found.frames):
        raise InputError(f"{path}: a step_m is not finite")
    return found


def odometry_trajectory(
    sequence: Drive, settings: Settings | None = None, monitor: Monitor = QUIET
) -> tuple[Trajectory, NDArray[np.int64]]:
    """The path of a drive by odometry alone, with its gaps filled, from its first usable frame.

    Returns:
        ``first_from_cam`` at each usable frame, and (F,) int64 the stamps of all frames, ns.
    """
    front, source = Front(settings or Settings(), sequence.camera), sequence.motion()
    first_from_cam, stamps_ns = SE3.identity(), list[int]()
    poses: list[tuple[int, SE3]] = []
    with closing(arriving(sequence)) as frames:
        for arrived in frames:
            monitor.check()
            stamp_ns = stamp_of(arrived)
            outside = None
            if source is not None and stamps_ns:
                outside = source.between(stamps_ns[-1], stamp_ns)
            _, motion = front.take(arrived, outside)
            stamps_ns.append(stamp_ns)
            if motion.prev_from_curr is not None:
                first_from_cam = (first_from_cam @ motion.prev_from_curr).renormalised()
            if motion.usable:
                poses.append((stamp_ns, first_from_cam))
            monitor.advance("driven")
    return trajectory_of(sequence.info.name, poses), np.array(stamps_ns, np.int64)
