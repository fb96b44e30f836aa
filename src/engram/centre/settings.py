"""Limits and times of a centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from engram.config import check_bounds

DAY_NS = 86_400_000_000_000
_GIB = 2**30


@dataclass(frozen=True, slots=True)
class CentreSettings:
    """Limits and deadlines of a centre."""

    token_s: Annotated[int, Meta(ge=10, description="life of a robot's token, s")] = 900
    nonce_s: Annotated[
        int, Meta(ge=1, description="time to sign the nonce of a token request, s")
    ] = 60
    code_days: Annotated[int, Meta(ge=1, description="life of an enrolment code, days")] = 7
    bytes_a_day: Annotated[int, Meta(ge=0, description="upload limit of a robot, bytes a day")] = (
        20 * _GIB
    )
    handin_bytes: Annotated[int, Meta(ge=0, description="size limit of one hand-in, bytes")] = (
        8 * _GIB
    )
    open_handins: Annotated[
        int, Meta(ge=1, description="incomplete hand-ins of a robot at once")
    ] = 8
    handin_days: Annotated[int, Meta(ge=1, description="life of an incomplete hand-in, days")] = 14
    kept_days: Annotated[
        int,
        Meta(ge=0, description="life of unused parts, days"),
    ] = 14
    artifact_days: Annotated[int, Meta(ge=1, description="life of an unused download, days")] = 30
    sweep_h: Annotated[float, Meta(gt=0, description="time between sweeps, h")] = 24.0
    merge_tries: Annotated[
        int, Meta(ge=1, description="times that a worker may die while merging one hand-in")
    ] = 3
    admission_bytes: Annotated[int, Meta(ge=2**28, description="memory of admission, bytes")] = (
        4 * _GIB
    )
    admission_s: Annotated[int, Meta(ge=1, description="processor time of admission, s")] = 600
    poll_s: Annotated[float, Meta(gt=0, description="a worker looks for work this often, s")] = 0.25

    def __post_init__(self) -> None:
        check_bounds(self)
