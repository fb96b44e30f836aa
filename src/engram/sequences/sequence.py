"""Stereo sequences, frames with odometry, and options for opening a drive."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from msgspec import Meta

from engram.config import check_bounds
from engram.drive_options import PAIR_TOLERANCE_NS, DriveOptions
from engram.errors import ConfigError, InputError
from engram.frontend.frame import Frame, StereoPair
from engram.geometry.cameras import StereoCamera
from engram.graph.clock import check_longitude, check_zone
from engram.graph.model import LONGEST_NAME, Clock, Session, session_id
from engram.odometry.step import OdometryStep

if TYPE_CHECKING:
    from engram.drive_options import Moment

# Robot name of a drive if neither source nor caller gives one.
UNNAMED_ROBOT = "robot"


@dataclass(frozen=True, slots=True)
class SequenceInfo:
    """Facts of a drive known before its first image is decoded.

    Attributes:
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


def first_pair_hash(pair: StereoPair) -> str:
    """Hash of a pair's pixels, 32 hexadecimal digits; part of a session's id (method §2.7)."""
    digest = hashlib.sha256(f"{pair.left.shape}{pair.right.shape}".encode())
    digest.update(np.ascontiguousarray(pair.left).data)
    digest.update(np.ascontiguousarray(pair.right).data)
    return digest.hexdigest()[:32]


def check_name(robot: str) -> str:
    """The name of a robot, as maps store it."""
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
        start_ns: stamp of the first used pair, ns.
        first_pair_hash: `first_pair_hash` of that pair; a frame log has it as a property.
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


T = TypeVar("T")
E = TypeVar("E", bound=StrEnum)

_PART = re.compile(r"[0-9]{1,9}")
_SECONDS = re.compile(r"[0-9]{1,9}(\.[0-9]{0,9})?")
_MICROSECOND = timedelta(microseconds=1)
_SPELLINGS = {"color": "colour", "gray": "grey"}


class Rig(StrEnum):
    """Which of a robot's two stereo rigs; layouts with one rig only have `GREY`."""

    GREY = "grey"
    COLOUR = "colour"


class Channel(StrEnum):
    """How a colour image becomes grey: its luma, or one channel."""

    GREY = "grey"
    RED = "red"
    GREEN = "green"
    BLUE = "blue"


@dataclass(frozen=True, slots=True)
class FrameRange:
    """Frames `start`, `start + step`, … below `stop`, counted from 0 in the layout's own order.

    Bad frames keep their numbers, so that a range names the same frames with and
    without `skip_bad`.

    Attributes:
        start: first frame, >= 0.
        stop: end, not included; None for all the rest.
        step: distance of successive frames, >= 1.
    """

    start: int = 0
    stop: int | None = None
    step: int = 1

    def __post_init__(self) -> None:
        if self.start < 0 or (self.stop is not None and self.stop < 0) or self.step < 1:
            raise ConfigError(
                f"frames {self}: start and stop must be >= 0 and step >= 1 "
                "(counting from the end is not supported)"
            )
        if self.stop is not None and self.stop <= self.start:
            raise ConfigError(f"frames {self}: holds no frame, stop must be larger than start")

    @staticmethod
    def parse(text: str) -> FrameRange:
        """Read START:STOP:STEP, the words of a Python slice; any part may be missing.

        A single number N means the one frame N.
        """
        parts = [part.strip() for part in text.split(":")]
        if len(parts) > 3 or text.strip() == "":
            raise ConfigError(f"frames {text!r}: write START:STOP:STEP, such as 0:100:2")
        for part in parts:
            if part and not _PART.fullmatch(part):
                why = "is not valid" if part[0] != "-" else "counts from the end: not supported"
                raise ConfigError(
                    f"frames {text!r}: {part!r} {why}; each part is a whole number >= 0 or missing"
                )
        start = int(parts[0] or 0)
        if len(parts) == 1:
            return FrameRange(start, start + 1)
        stop = int(parts[1]) if parts[1] else None
        return FrameRange(start, stop, int(parts[2]) if len(parts) == 3 and parts[2] else 1)

    def __str__(self) -> str:
        return f"{self.start}:{'' if self.stop is None else self.stop}:{self.step}"

    def indices(self, length: int) -> range:
        """The frames of a drive of `length` frames that are in the range."""
        return range(length)[self.start : self.stop : self.step]

    def of(self, items: Sequence[T]) -> list[T]:
        """The members of `items` that are in the range."""
        return [items[index] for index in self.indices(len(items))]


@dataclass(frozen=True, slots=True)
class TimeRange:
    """A stretch of a drive in time.

    Attributes:
        start, stop: its ends, both included; seconds from the drive's first frame (float), or ns
            since 1970 (int); None for the drive's own ends.
    """

    start: float | int | None = None
    stop: float | int | None = None

    def __post_init__(self) -> None:
        start, stop = self.start, self.stop
        if start is not None and stop is not None and type(start) is type(stop) and stop < start:
            raise ConfigError(f"from_ {start} is after to {stop}: no frame lies between")

    @staticmethod
    def parse(start: Moment | None, stop: Moment | None) -> TimeRange:
        """Reads seconds such as 12.5, or times such as 2026-03-01T09:30:00Z (UTC)."""
        return TimeRange(_moment("from_", start), _moment("to", stop))

    @property
    def is_all(self) -> bool:
        """Whether it is the whole drive."""
        return self.start is None and self.stop is None

    def holds(self, stamp_ns: int, first_ns: int) -> bool:
        """Whether a stamp of a drive that begins at `first_ns` is inside."""
        return not (self.is_before(stamp_ns, first_ns) or self.is_after(stamp_ns, first_ns))

    def is_before(self, stamp_ns: int, first_ns: int) -> bool:
        """Whether a stamp lies before the range."""
        return self.start is not None and stamp_ns < _as_ns(self.start, first_ns)

    def is_after(self, stamp_ns: int, first_ns: int) -> bool:
        """Whether a stamp lies after the range."""
        return self.stop is not None and stamp_ns > _as_ns(self.stop, first_ns)


def _as_ns(moment: float | int, first_ns: int) -> int:
    return moment if isinstance(moment, int) else first_ns + round(moment * 1e9)


def _moment(option: str, given: Moment | None) -> float | int | None:
    if isinstance(given, float):
        return given
    if isinstance(given, str) and _SECONDS.fullmatch(given.strip()):
        return float(given)
    try:
        return parse_time(option, given)
    except ConfigError:
        raise ConfigError(
            f"{option} {given!r}: write seconds from the drive's start, such as 12.5, or a time "
            "such as 2026-03-01T09:30:00Z"
        ) from None


@dataclass(frozen=True, slots=True)
class OpenOptions:
    """How to open a drive, read from `DriveOptions`.

    Raises:
        ConfigError: the longitude is outside ±180°, the zone is unknown, the tolerance negative.
    """

    rig: Rig = Rig.GREY
    channel: Channel = Channel.GREY
    frames: FrameRange = field(default_factory=FrameRange)
    skip_bad: bool = False
    pair_tolerance_ns: Annotated[int, Meta(ge=0)] = PAIR_TOLERANCE_NS
    robot: str | None = None
    recorded_at_ns: int | None = None
    longitude_deg: float | None = None
    zone: str | None = None
    times: TimeRange = field(default_factory=TimeRange)
    calibration: Path | None = None
    field_of_view_deg: Annotated[float | None, Meta(ge=10, le=170)] = None
    mask: Path | None = None
    left: str | None = None
    right: str | None = None
    motion: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.frames, FrameRange):
            raise ConfigError(f"frames is {self.frames!r}, must be text such as 0:100:2")
        if self.robot is not None:
            check_name(self.robot)
        check_longitude(self.longitude_deg)
        check_zone(self.zone)
        check_bounds(self)

    @classmethod
    def of(cls, given: DriveOptions) -> Self:
        """The options as people wrote them.

        Raises:
            ConfigError: one of them is malformed or out of range.
        """
        return cls(
            rig=parse_choice(Rig, given.rig),
            channel=parse_choice(Channel, given.channel),
            frames=FrameRange() if given.frames is None else FrameRange.parse(given.frames),
            times=TimeRange.parse(given.from_, given.to),
            skip_bad=given.skip_bad,
            pair_tolerance_ns=given.pair_tolerance_ns,
            robot=given.robot,
            recorded_at_ns=parse_time("recorded_at", given.recorded_at),
            longitude_deg=given.longitude_deg,
            zone=given.zone,
            calibration=None if given.calibration is None else Path(given.calibration),
            field_of_view_deg=given.field_of_view_deg,
            mask=None if given.mask is None else Path(given.mask),
            left=given.left,
            right=given.right,
            motion=tuple(map(str, given.motion)),
        )


def parse_choice(kind: type[E], text: str) -> E:
    """A `Rig` or `Channel` by name, in British or American spelling."""
    try:
        return kind(_SPELLINGS.get(text, text))
    except ValueError:
        raise ConfigError(
            f"{kind.__name__.lower()} {text!r} is unknown; known: {', '.join(kind)}"
        ) from None


def parse_time(name: str, given: str | datetime | int | None) -> int | None:
    """A time as ns since 1970: an ISO 8601 text, a `datetime`, or the ns themselves.

    A time without an offset is taken as UTC.

    Args:
        given: the time; None gives None.
    """
    if given is None:
        return None
    time = given
    if isinstance(time, str):
        try:
            time = datetime.fromisoformat(time)
        except ValueError:
            raise ConfigError(
                f"{name} {given!r} is not an ISO 8601 time such as 2011-09-26T13:02:25Z"
            ) from None
    if isinstance(time, datetime):
        aware = time if time.tzinfo else time.replace(tzinfo=UTC)
        # Whole microseconds: `timestamp()` is a float and would lose the last digits.
        time = (aware - datetime(1970, 1, 1, tzinfo=UTC)) // _MICROSECOND * 1000
    if not 0 <= time < 2**63:
        raise ConfigError(f"{name} is {time} ns since 1970, must be between 1970 and 2262")
    return time
