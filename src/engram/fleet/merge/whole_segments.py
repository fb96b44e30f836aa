"""Decides on whole segments, as [G16] Fig. 4 draws it, where `MergeOptions.unit` asks for it."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

from engram.robot import Robot
from engram.sequences import LoggedFrame


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
        frames: of the segment, in the order of time.
        least_share: share of the frames that must localise, in [0, 1].
    """
    found = [robot.step(logged).localised for logged in frames]
    return sum(found) >= least_share * len(found)
