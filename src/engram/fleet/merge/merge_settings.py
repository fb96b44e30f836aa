"""How maps are merged: policy, budget, and what counts as known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Annotated

from msgspec import Meta

from engram.config import PUBLIC, check_bounds
from engram.localiser.localisation import Budget
from engram.localiser.relocalisation import check_relocaliser
from engram.ranking.policies import check_for_robot
from engram.robot.robot import Robot
from engram.sequences.sequence import LoggedFrame


class Unit(StrEnum):
    """What MERGE omits or takes at once."""

    FRAME = "frame"
    SEGMENT = "segment"


class SeedFrom(StrEnum):
    """Where the replay of a segment starts."""

    NEIGHBOUR = "neighbour"
    PLACES = "places"


def localises_well(robot: Robot, frames: Iterable[LoggedFrame], least_share: float) -> bool:
    """Whether a segment localises in the fleet map as it is.

    Args:
        robot: placed at the segment's start, if that is known.
        least_share: share of the frames that must localise, in [0, 1].
    """
    localised = [robot.step(logged).localised for logged in frames]
    return sum(localised) >= least_share * len(localised)


NO_RELOCALISER = "none"


@dataclass(frozen=True, slots=True)
class MergeSettings:
    """How what robots hand in is replayed: the table `merge` of a settings file.

    Attributes:
        lanes, rounds: the budget of each replayed frame, lost or not: a count, so that the same
            input gives the same map.
    """

    ranking: Annotated[str, Meta(description="as drive.ranking"), PUBLIC] = "recall"
    lanes: Annotated[int, Meta(ge=1, description="attempts in parallel, Np"), PUBLIC] = 2
    rounds: Annotated[int, Meta(ge=1, description="rounds of attempts for a frame, Nr"), PUBLIC] = 4
    relocaliser: Annotated[
        str,
        Meta(description="places segments without a known neighbour, as drive.relocaliser"),
        PUBLIC,
    ] = "fabmap"
    sure_inliers: Annotated[
        int,
        Meta(ge=0, description="inliers needed to drop a node; 0: any match. Source: [G16] §V-A"),
        PUBLIC,
    ] = 45
    unit: Annotated[
        Unit,
        Meta(
            description="what is omitted or taken at once: frame or segment. Source: [G16] Fig. 4"
        ),
        PUBLIC,
    ] = Unit.FRAME
    segment_share: Annotated[
        float,
        Meta(ge=0, le=1, description="share of a segment that must localise to omit it"),
        PUBLIC,
    ] = 0.5
    seed: Annotated[
        SeedFrom,
        Meta(description="start of a segment's replay: neighbour or places. Source: [G16] §V-A"),
        PUBLIC,
    ] = SeedFrom.NEIGHBOUR

    @property
    def relocaliser_name(self) -> str | None:
        """One of `relocaliser_names()`; None for none."""
        return None if self.relocaliser == NO_RELOCALISER else self.relocaliser

    def __post_init__(self) -> None:
        check_bounds(self)
        check_for_robot(self.ranking)
        Budget(self.lanes, self.rounds)  # refuses an invalid budget
        if self.relocaliser != NO_RELOCALISER:
            check_relocaliser(self.relocaliser)


@dataclass(frozen=True, slots=True)
class MergeOptions(MergeSettings):
    """The settings of a merge, and who merges.

    Attributes:
        author: who merges; None for the robots whose drives bring something new.
    """

    author: str | None = None

    @classmethod
    def of(cls, settings: MergeSettings, author: str | None = None) -> MergeOptions:
        """These settings, with the author of the merge."""
        values = {field.name: getattr(settings, field.name) for field in fields(MergeSettings)}
        return cls(**values, author=author)
