"""How maps are merged: policy, budget, and what counts as known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec

from engram.config import check_bounds
from engram.errors import ConfigError
from engram.fleet.merge.whole_segments import SeedFrom, Unit
from engram.localiser import RELOCALISERS, Budget
from engram.ranking import check_for_robot


@dataclass(frozen=True, slots=True)
class MergeOptions:
    """How maps are merged.

    Attributes:
        policy: key of `POLICIES`.
        lanes, rounds: the budget of each replayed frame, lost or not: a count, so that the same
            input gives the same map.
        relocaliser: key of `RELOCALISERS`, for segments without a known neighbour; None for none.
        author: who merges; None for the robots whose drives bring something new.
        sure_inliers, unit, segment_share, seed: see their descriptions.
    """

    policy: str = "recall"
    lanes: int = 2
    rounds: int = 4
    relocaliser: str | None = "fabmap"
    author: str | None = None
    sure_inliers: Annotated[
        int,
        msgspec.Meta(
            ge=0,
            description="inliers needed before omitting a node: frames that match the node need "
            "not match another that the node itself barely matches. 0 omits on every match, as "
            "[G16] does",
        ),
    ] = 60
    unit: Annotated[
        Unit,
        msgspec.Meta(
            description="what is omitted or taken at once: each frame, or a whole segment, as "
            "[G16] Fig. 4 draws it"
        ),
    ] = Unit.FRAME
    segment_share: Annotated[
        float,
        msgspec.Meta(
            ge=0,
            le=1,
            description="unit segment: share of its frames that must localise for it to be "
            "omitted; [G16] gives none",
        ),
    ] = 0.5
    seed: Annotated[
        SeedFrom,
        msgspec.Meta(
            description="where the replay of a segment starts: at a neighbour that the fleet map "
            "knows, or always by place recognition, as [G16] §V-A does"
        ),
    ] = SeedFrom.NEIGHBOUR

    def __post_init__(self) -> None:
        check_bounds(self)
        check_for_robot(self.policy)
        Budget(self.lanes, self.rounds)  # refuses an invalid budget
        if self.relocaliser is not None and self.relocaliser not in RELOCALISERS:
            raise ConfigError(
                f"relocaliser {self.relocaliser!r} is unknown; known: {', '.join(RELOCALISERS)}"
            )
