"""The two protocols of all data sources, and the identity of a drive."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from engram.errors import InputError
from engram.frontend import Frame, StereoPair
from engram.geometry import StereoCamera
from engram.graph.model import LONGEST_NAME, Clock, Session, session_id
from engram.odometry import OdometryStep

# Robot name of a drive if neither source nor caller gives one.
UNNAMED_ROBOT = "robot"


@dataclass(frozen=True, slots=True)
class SequenceInfo:
    """Facts of a drive known before its first image is decoded.

    Attributes:
        name: short display name, from the path.
        format: the layout's name, such as "kitti".
        clock: meaning of the stamps.
        robot: name of the robot, if the source gives one.
        longitude_deg, zone: where the drive was, if known (method §2.8).
    """

    name: str
    format: str
    clock: Clock
    robot: str | None = None
    longitude_deg: float | None = None
    zone: str | None = None


@runtime_checkable
class StereoSequence(Protocol):
    """A drive as rectified stereo pairs, in the order of time."""

    @property
    def info(self) -> SequenceInfo:
        """Facts about the drive as a whole."""
        ...

    @property
    def camera(self) -> StereoCamera:
        """The one camera of the drive."""
        ...

    @property
    def skipped(self) -> int:
        """Pairs left out so far under `skip_bad`."""
        ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[StereoPair]:
        """Decodes one pair at a time.

        Raises:
            SequenceError: an image is missing, unreadable or of the wrong size, and `skip_bad`
                is not set.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LoggedFrame:
    """One entry of a frame log: a frame and the odometry since the frame before."""

    frame: Frame
    odometry: OdometryStep


class FrameSequence(Protocol):
    """A drive as frames with odometry: a frame log, or a stereo sequence run through both."""

    @property
    def info(self) -> SequenceInfo:
        """Facts about the drive as a whole."""
        ...

    @property
    def camera(self) -> StereoCamera:
        """The one camera of the drive."""
        ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[LoggedFrame]: ...


def first_pair_hash(pair: StereoPair) -> str:
    """Hash of a pair's pixels, 32 hexadecimal digits; part of a session's id (method §2.7)."""
    digest = hashlib.sha256(f"{pair.left.shape}{pair.right.shape}".encode())
    digest.update(np.ascontiguousarray(pair.left).data)
    digest.update(np.ascontiguousarray(pair.right).data)
    return digest.hexdigest()[:32]


def check_name(robot: str) -> str:
    """The name of a robot, as maps store it.

    Raises:
        InputError: it is empty, too long, or not Unicode text.
    """
    try:
        if robot and robot.encode() and len(robot) <= LONGEST_NAME:
            return robot
    except (AttributeError, UnicodeEncodeError, TypeError):
        pass
    raise InputError(
        f"the robot's name is {robot!r:.60}, must be Unicode text of 1 to {LONGEST_NAME} "
        "characters, such as r1"
    )


def session_of(
    info: SequenceInfo, camera: StereoCamera, start_ns: int, first_pair_hash: str
) -> Session:
    """The session of a drive; equal for equal frames.

    Args:
        info: facts of the drive.
        camera: its camera.
        start_ns: stamp of the first used pair, ns.
        first_pair_hash: `first_pair_hash` of that pair; a frame log has it as a property.

    Raises:
        InputError: the robot's name is invalid; see `check_name`.
    """
    robot = check_name(info.robot or UNNAMED_ROBOT)
    return Session(
        id=session_id(robot, camera.id, start_ns, first_pair_hash),
        robot=robot,
        camera=camera.id,
        start_ns=start_ns,
        clock=info.clock,
        longitude_deg=info.longitude_deg,
        zone=info.zone,
    )
