"""How a drive is opened: what its files do not state, declared once.

`engram.open_drive` takes all of it as keywords, a settings file in its table `drive`, and the
command line as options where it is usual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

from engram.config import PUBLIC

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime
    from pathlib import Path

    # What people write in Python besides text; a settings file and a command line have text only.
    File = str | Path
    Time = str | int | datetime
    Moment = Time | float
    Files = Sequence[str | Path]
else:
    # Seconds need no decimal point there: 2 is 2.0.
    File, Time, Moment, Files = str, str | int, str | float, tuple[str, ...]

# Software-triggered pairs stay below it, and it is half of the frame interval at 100 Hz.
PAIR_TOLERANCE_NS = 5_000_000


def _option(metavar: str, description: str, *, rare: bool = False) -> Meta:
    """Of a field that the command line takes as an option, too."""
    return Meta(description=description, extra={"metavar": metavar, "rare": rare})


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOptions:
    """How to open a drive, as people write it; `OpenOptions.of` checks and reads it.

    Attributes:
        from_, to: seconds from the first frame (12.5), or a time as in `recorded_at`.
        recorded_at: ISO 8601 (UTC unless it has an offset), a `datetime`, or ns since 1970 (int).
    """

    format: Annotated[
        str | None, Meta(description="layout of the drive; none: recognised by its files"), PUBLIC
    ] = None
    rig: Annotated[str, Meta(description="KITTI's cameras: grey or colour"), PUBLIC] = "grey"
    channel: Annotated[
        str, Meta(description="taken of colour images: grey, red, green or blue"), PUBLIC
    ] = "grey"
    frames: Annotated[str | None, _option("START:STOP:STEP", "Only these frames: 0:100:2.")] = None
    from_: Annotated[
        Moment | None,
        Meta(description="begin here: seconds into the drive, or ISO 8601, UTC"),
        PUBLIC,
    ] = None
    to: Annotated[Moment | None, Meta(description="end here, included"), PUBLIC] = None
    skip_bad: Annotated[
        bool, Meta(description="leave out unreadable images, and count them"), PUBLIC
    ] = False
    pair_tolerance_ns: Annotated[
        int, Meta(ge=0, description="largest difference of stamps within a pair, ns")
    ] = PAIR_TOLERANCE_NS
    robot: Annotated[str | None, _option("NAME", "Name of the robot [default: the drive's].")] = (
        None
    )
    recorded_at: Annotated[
        Time | None, _option("TIME", "Start of the drive in ISO 8601, UTC.", rare=True)
    ] = None
    longitude_deg: Annotated[
        float | None, Meta(description="degrees east, for solar time"), PUBLIC
    ] = None
    zone: Annotated[
        str | None, _option("ZONE", "Time zone of the drive: Europe/London."), PUBLIC
    ] = None
    calibration: Annotated[
        File | None, _option("FILE", "TOML, Kalibr, ROS or OpenCV file."), PUBLIC
    ] = None
    field_of_view_deg: Annotated[
        float | None,
        Meta(description="of the rectified images, degrees; none: the widest"),
        PUBLIC,
    ] = None
    mask: Annotated[
        File | None, Meta(description="image that is black where the robot sees itself"), PUBLIC
    ] = None
    left: Annotated[
        str | None, _option("TOPIC", "Topic of a bag's left images.", rare=True), PUBLIC
    ] = None
    right: Annotated[
        str | None, _option("TOPIC", "Topic of a bag's right images.", rare=True), PUBLIC
    ] = None
    motion: Annotated[
        Files, _option("TOPIC|FILE", "Wheel odometry or gyroscope; repeatable.", rare=True), PUBLIC
    ] = ()
