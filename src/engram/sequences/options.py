"""What a caller may say about a drive that its files do not say."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum

from engram.errors import ConfigError
from engram.graph.clock import check_longitude, check_zone
from engram.sequences.frame_range import FrameRange
from engram.sequences.images import Channel

_MICROSECOND = timedelta(microseconds=1)


class Rig(StrEnum):
    """Which of two stereo rigs of one robot; layouts with one rig only know `GREY`."""

    GREY = "grey"
    COLOUR = "colour"


@dataclass(frozen=True, slots=True)
class OpenOptions:
    """How to open a drive.

    Attributes:
        rig: which rig, where the layout has two.
        channel: what is taken of colour images.
        frames: which frames are used.
        skip_bad: leave bad pairs out and count them, instead of failing.
        pair_tolerance_ns: largest difference of stamps within a pair, where a layout pairs by
            stamp. Default 5 ms: software-triggered pairs stay below it, and at 100 Hz it is
            still only half of the distance to the next frame.
        robot: name of the robot; None for what the source says.
        start_ns: absolute time of the drive's first frame, ns since 1970 UTC, for a drive whose
            clock is not UTC.
        longitude_deg, zone: where the drive was; None for what the source says.

    Raises:
        ConfigError: the longitude is outside ±180°, the zone is unknown, the tolerance negative.
    """

    rig: Rig = Rig.GREY
    channel: Channel = Channel.GREY
    frames: FrameRange = field(default_factory=FrameRange)
    skip_bad: bool = False
    pair_tolerance_ns: int = 5_000_000
    robot: str | None = None
    start_ns: int | None = None
    longitude_deg: float | None = None
    zone: str | None = None

    def __post_init__(self) -> None:
        check_longitude(self.longitude_deg)
        check_zone(self.zone)
        if self.pair_tolerance_ns < 0:
            raise ConfigError(f"pair tolerance is {self.pair_tolerance_ns} ns, must be >= 0")


def parse_rig(text: str) -> Rig:
    """Look a rig up by name.

    Raises:
        ConfigError: there is no such rig.
    """
    try:
        return Rig(text)
    except ValueError:
        raise ConfigError(f"rig {text!r} is unknown; known: {', '.join(Rig)}") from None


def parse_start(start: str | datetime | int | None) -> int | None:
    """A start time as ns since 1970: an ISO 8601 text, a `datetime`, or the ns themselves.

    A time without an offset is taken as UTC.

    Raises:
        ConfigError: the text is no ISO 8601 time, or the time lies before 1970.
    """
    if start is None:
        return None
    if isinstance(start, str):
        try:
            start = datetime.fromisoformat(start)
        except ValueError:
            raise ConfigError(
                f"start {start!r} is no ISO 8601 time, such as 2011-09-26T13:02:25Z"
            ) from None
    if isinstance(start, datetime):
        aware = start if start.tzinfo else start.replace(tzinfo=UTC)
        # Whole microseconds: `timestamp()` is a float and would lose the last digits.
        micros = (aware - datetime(1970, 1, 1, tzinfo=UTC)) // _MICROSECOND
        start = micros * 1000
    if not 0 <= start < 2**63:
        raise ConfigError(f"start is {start} ns since 1970, must be between 1970 and 2262")
    return start
