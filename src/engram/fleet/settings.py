"""The fleet's tables of a settings file: `merge`, `build` and `download`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from engram.config import PUBLIC, check_bounds
from engram.fleet.merge.merge_settings import MergeSettings
from engram.measures import Estimator

if TYPE_CHECKING:
    from engram.fleet.download.mission import DownloadOptions

__all__ = ["BuildSettings", "DownloadSettings", "MergeSettings"]


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """How `build` judges orders of merging."""

    max_gap_m: Annotated[
        float,
        Meta(ge=0, description="m; the best order has the fewest longer gaps. Source: [G16] §VI"),
        PUBLIC,
    ] = 10.0
    estimator: Annotated[
        Estimator,
        Meta(description="what failures are counted over: route, gap, lost, reacquired ([G16])"),
        PUBLIC,
    ] = Estimator.ROUTE

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True)
class DownloadSettings:
    """Settings of the selections of `download`."""

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
        PUBLIC,
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
        float, Meta(ge=0, description="m along the edges around --near and --route"), PUBLIC
    ] = 20.0

    def __post_init__(self) -> None:
        check_bounds(self)

    def options(self, select: str, **mission: Any) -> DownloadOptions:
        """What to download by these settings; see `DownloadOptions` for what a mission is."""
        from engram.fleet.download.mission import DownloadOptions

        own = {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}
        return DownloadOptions(select, **{**own, **mission})
