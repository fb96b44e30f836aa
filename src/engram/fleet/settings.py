"""The fleet's tables of a settings file: `merge`, `build` and `download`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from engram.config import PUBLIC, check_bounds
from engram.fleet.download.mission import DownloadSettings
from engram.fleet.merge.merge_settings import MergeSettings
from engram.measures import Estimator

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
