"""Times of drives: the hour of day, and the height of the sun."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime
from functools import lru_cache
from typing import Protocol
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engram.errors import ConfigError
from engram.graph.model import Clock, Session

_NS_PER_HOUR = 3_600_000_000_000
_HOURS_PER_DAY = 24
# What the IANA database may ever call a zone; the longest name today has 32 characters.
_ZONE = re.compile(r"(?=.{1,64}\Z)[A-Za-z0-9_+-]+(/[A-Za-z0-9_+-]+)*")
_SHOWN_CHARACTERS = 40


class Clocked(Protocol):
    """Anything with a clock and a location on Earth, such as a session or a sequence."""

    @property
    def clock(self) -> Clock:
        """The clock of the stamps."""
        ...

    @property
    def longitude_deg(self) -> float | None:
        """East positive, degrees; None if unknown."""
        ...

    @property
    def zone(self) -> str | None:
        """IANA time zone; None if unknown."""
        ...


def hour_of_day(source: Clocked, stamp_ns: int) -> float | None:
    """Hour of day in [0, 24) at a stamp; None if unknown.

    Mean solar time (UTC + longitude / 15) if a longitude is known, else civil time of the zone.
    None for a clock that is not UTC, and without longitude or a zone known to this machine:
    drives come from machines with a newer database.

    Source: method §2.8.
    """
    if source.clock is not Clock.UTC:
        return None
    stamp_ns += _shift_ns(source)
    if source.longitude_deg is not None:
        hour = stamp_ns / _NS_PER_HOUR + source.longitude_deg / 15
    elif (zone := known_zone(source.zone)) is not None:
        # Zones' offsets are whole seconds; the nanoseconds are added afterwards.
        seconds, nanos = divmod(stamp_ns, 1_000_000_000)
        offset = datetime.fromtimestamp(seconds, UTC).astimezone(zone).utcoffset()
        if offset is None:
            return None
        hour = (seconds + offset.total_seconds()) / 3600 + nanos / _NS_PER_HOUR
    else:
        return None
    wrapped = hour % _HOURS_PER_DAY
    # A tiny negative hour rounds up to 24.0 itself.
    return 0.0 if wrapped >= _HOURS_PER_DAY else wrapped


def day_of(source: Clocked, stamp_ns: int) -> float | None:
    """Days since 1970 at a stamp, with their fraction; None for a clock that is not UTC."""
    if source.clock is not Clock.UTC:
        return None
    return (stamp_ns + _shift_ns(source)) / (_HOURS_PER_DAY * _NS_PER_HOUR)


def _shift_ns(source: Clocked) -> int:
    return source.shift_ns if isinstance(source, Session) else 0


def check_longitude(longitude_deg: float | None) -> None:
    """Refuse an invalid longitude.

    Raises:
        ConfigError: it is not a number in [-180, 180].
    """
    if longitude_deg is not None and not (
        math.isfinite(longitude_deg) and -180 <= longitude_deg <= 180
    ):
        raise ConfigError(f"longitude is {longitude_deg}, must be in [-180, 180] degrees east")


def known_zone(zone: str | None) -> ZoneInfo | None:
    """The time zone of a name; None for None, and for a zone unknown to this machine."""
    return _looked_up(zone) if zone is not None and is_zone_name(zone) else None


@lru_cache
def _looked_up(name: str) -> ZoneInfo | None:
    try:
        return ZoneInfo(name)
    except (KeyError, ValueError, OSError):  # not found; malformed; a folder of the database
        return None


def is_zone_name(text: str) -> bool:
    """Whether a text may name a zone of the IANA database, known to this machine or not."""
    return _ZONE.fullmatch(text) is not None


def zone_note(source: Clocked) -> str:
    """Why hours are unknown though a zone is given; empty where that is not so."""
    unplaced = source.clock is Clock.UTC and source.longitude_deg is None
    if not unplaced or source.zone is None or known_zone(source.zone) is not None:
        return ""
    return (
        f"time zone {_shown(source.zone)} is unknown to this machine: update its time zone "
        "database, or correct the zone with engram amend"
    )


def _shown(zone: str) -> str:
    return repr(zone if len(zone) <= _SHOWN_CHARACTERS else f"{zone[:_SHOWN_CHARACTERS]}…")


def check_zone(zone: str | None) -> None:
    """Refuse a name that is not a time zone of the IANA database.

    Raises:
        ConfigError: the zone is unknown on this machine.
    """
    if zone is not None and known_zone(zone) is None:
        raise ConfigError(
            f"time zone {_shown(zone)} is unknown; give an IANA name such as Europe/Berlin"
        )


_TROPIC_DEG = 23.44
_YEAR_DAYS = 365.2425
# From the winter solstice to the first of January.
_SOLSTICE_DAYS = 10.0


def sun_height_deg(day: ArrayLike, hour: ArrayLike, latitude_deg: float) -> NDArray[np.float64]:
    """Height of the sun over the horizon, degrees; negative at night.

    Accurate to 2°, as mean solar time leaves out the equation of time.

    Args:
        day: float or (N,) float64, days since 1 January 0:00 of any year.
        hour: float or (N,) float64, hour of day, mean solar time (method §2.8).
        latitude_deg: latitude, degrees, north positive.

    Returns:
        (N,) float64, or one if both are; degrees.

    Source: Cooper, "The absorption of radiation in solar stills", 1969 (declination).
    """
    turned = 2 * np.pi * (np.asarray(day, np.float64) + _SOLSTICE_DAYS) / _YEAR_DAYS
    declination = np.deg2rad(-_TROPIC_DEG * np.cos(turned))
    angle = np.deg2rad(15 * (np.asarray(hour, np.float64) - 12))
    latitude = np.deg2rad(latitude_deg)
    up = np.sin(latitude) * np.sin(declination)
    up = up + np.cos(latitude) * np.cos(declination) * np.cos(angle)
    return np.asarray(np.rad2deg(np.arcsin(np.clip(up, -1.0, 1.0))), np.float64)


def day_of_year(stamp_ns: int) -> float:
    """Days since 1 January 0:00 UTC, accurate to a day, for a year of mean length."""
    return stamp_ns / 86_400e9 % _YEAR_DAYS
