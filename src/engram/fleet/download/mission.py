"""A mission: when and where a robot drives, and how much map it can carry."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from datetime import date
from typing import Annotated, Any

from msgspec import Meta

from engram.config import PUBLIC, bytes_of, check_bounds
from engram.errors import ConfigError

_CLOCK = re.compile(r"(?P<hour>\d{1,2})(:(?P<minute>\d{2}))?", re.ASCII)
_PERCENT = re.compile(r"(?P<number>\d+(\.\d+)?)\s*%", re.ASCII)


@dataclass(frozen=True, slots=True, kw_only=True)
class DownloadSettings:
    """How missions are downloaded: the table `download` of a settings file."""

    window_min: Annotated[
        float,
        Meta(ge=0, le=720, description="tod: minutes around departure. Source: [G16] §VI-D"),
        PUBLIC,
    ] = 180.0
    epoch_min: Annotated[
        float, Meta(ge=1, le=1440, description="paths: length of an epoch, minutes"), PUBLIC
    ] = 60.0
    best_percent: Annotated[
        float,
        Meta(ge=0, le=100, description="paths: share of each epoch's paths. [G16] §VI-D"),
        PUBLIC,
    ] = 50.0
    buffer_min: Annotated[
        float,
        Meta(ge=0, le=720, description="paths: minutes added before and after the mission"),
        PUBLIC,
    ] = 0.0
    widen_min: Annotated[
        float,
        Meta(gt=0, le=720, description="step by which an hour without data is widened, minutes"),
    ] = 60.0
    latitude_deg: (
        Annotated[
            float,
            Meta(ge=-90, le=90, description="degrees north, for the sun; none: estimated"),
            PUBLIC,
        ]
        | None
    ) = None
    radius_m: Annotated[
        float, Meta(ge=0, le=1e6, description="m along the edges around --near and --route"), PUBLIC
    ] = 20.0
    thumbnails: Annotated[
        bool | None,
        Meta(description="send the nodes' small pictures; none: not with budget"),
        PUBLIC,
    ] = None

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True)
class DownloadOptions(DownloadSettings):
    """What to download; stored in the map that is sent.

    Attributes:
        select: key of `SELECTIONS`.
        depart_h, arrive_h: the mission's hours of day; None if not given.
        date: the mission's date, "2026-11-17"; None for that of the fleet map's newest drive. It
            gives the height of the sun at those hours.
        budget_bytes: `budget`: largest size of the file.
        budget_percent: `budget`: the same, in per cent of a file with all nodes around the mission.
        near: `region`, and any selection but `copy` and `route`: beginnings of UUIDs of nodes.
        route: `route`, and any selection but `copy` and `region`: beginning of the UUID of a
            session that drove it.
        strict: whether an hour without data is refused, not widened.
    """

    select: str = "copy"
    depart_h: Annotated[float | None, Meta(ge=0, lt=24)] = None
    arrive_h: Annotated[float | None, Meta(ge=0, lt=24)] = None
    date: str | None = None
    budget_bytes: Annotated[int | None, Meta(gt=0)] = None
    budget_percent: Annotated[float | None, Meta(gt=0, le=100)] = None
    near: tuple[str, ...] = ()
    route: str | None = None
    strict: bool = False

    @classmethod
    def of(cls, settings: DownloadSettings, select: str, **mission: Any) -> DownloadOptions:
        """What to download by these settings."""
        own = {one.name: getattr(settings, one.name) for one in fields(DownloadSettings)}
        return cls(select, **{**own, **mission})

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.date is not None:
            _check_day(self.date)
        if self.budget_bytes is not None and self.budget_percent is not None:
            raise ConfigError(
                f"budget is {self.budget_bytes} bytes and {self.budget_percent:g} per cent of "
                "everything; give one"
            )

    @property
    def with_thumbnails(self) -> bool:
        """Whether thumbnails are sent."""
        return self.select != "budget" if self.thumbnails is None else self.thumbnails


def hour_from_text(text: str | None, name: str) -> float | None:
    """Hour of day of "9", "9:30" or "09:30"; None of None."""
    if text is None:
        return None
    match = _CLOCK.fullmatch(text.strip())
    if match is None or int(match["hour"]) > 23 or int(match["minute"] or 0) > 59:
        raise ConfigError(f"{name} is {text!r}, must be a time of day such as 9:30 or 23:05")
    return int(match["hour"]) + int(match["minute"] or 0) / 60


def budget_from_text(text: str | None, name: str = "budget") -> tuple[int | None, float | None]:
    """Bytes of "200MB", "1.5 GiB" or "4096", or per cent of "25%"; the other is None.

    Both are None if `text` is.
    """
    if text is None:
        return None, None
    if share := _PERCENT.fullmatch(text.strip()):
        return None, float(share["number"])
    if (size := bytes_of(text)) is None:
        raise ConfigError(
            f"{name} is {text!r}, must be a size such as 200MB, 1.5GiB or 4096, or a share of "
            "everything such as 25%"
        )
    return size, None


def _check_day(text: str) -> None:
    try:
        date.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"date is {text!r}, must be a day such as 2026-11-17") from None
