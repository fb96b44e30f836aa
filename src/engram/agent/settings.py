"""Limits of an agent, and when it falls back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

from msgspec import Meta

from engram.config import check_bounds


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """Limits of the link and the disk, and what is downloaded.

    Attributes:
        download: options of ``engram download``, by the names of `DownloadOptions`.
    """

    download: dict[str, Any] = field(default_factory=dict)
    bytes_per_s: (
        Annotated[float, Meta(gt=0, description="bandwidth limit; none: no limit")] | None
    ) = None
    outbox_bytes: Annotated[
        int, Meta(ge=0, description="disk for hand-ins that the centre has not stored yet, bytes")
    ] = 10 * 2**30
    first_retry_s: Annotated[float, Meta(gt=0, description="wait after a failure, s")] = 2.0
    longest_retry_s: Annotated[
        float, Meta(gt=0, description="each wait is twice the one before, up to this, s")
    ] = 600.0
    idle_s: Annotated[float, Meta(gt=0, description="pause between rounds without work, s")] = 30.0
    judged_m: Annotated[
        float, Meta(ge=0, description="a new map is judged after driving this far, m")
    ] = 50.0
    least_share: Annotated[
        float,
        Meta(ge=0, le=1, description="share of frames localised below which the last map returns"),
    ] = 0.2

    def __post_init__(self) -> None:
        check_bounds(self)
