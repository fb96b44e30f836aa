"""Inputs of a localiser: map parts and the drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from uuid import uuid5

from engram.graph.basin import MatchBasin
from engram.graph.clock import Clocked
from engram.graph.graph import ExperienceGraph
from engram.graph.model import ENGRAM_NAMESPACE, LandmarkSource, SessionId
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import PathMemory
from engram.localiser.localisation import Budget
from engram.localiser.settings import LocaliserConfig
from engram.ranking import Background

# For a drive without an id: equal input still gives equal results.
UNNAMED_LIVE_SESSION = SessionId(uuid5(ENGRAM_NAMESPACE, "live"))


@dataclass(frozen=True, slots=True)
class MapParts:
    """What a localiser reads of a map; graph and paths may grow.

    Attributes:
        graph: the experience graph.
        paths: the path memory.
        frames: where the landmarks of nodes come from.
        background: what policies may use of the map beyond its graph and paths.
        search: stands for the graph's own `neighbourhood`, such as one with a cache that the
            localisers of one drive on a fixed graph share; None for that itself. It is not asked
            where the settings want another search.
    """

    graph: ExperienceGraph
    paths: PathMemory
    frames: LandmarkSource
    background: Background = field(default_factory=Background)
    search: Callable[..., Neighbourhood] | None = None


@dataclass(frozen=True, slots=True)
class InForce:
    """By what a localiser localises.

    Attributes:
        policy: name of the ranking policy.
        budget: attempts per frame.
        config: its settings; neighbourhood, path entries and memory as its parts have them.
    """

    policy: str
    budget: Budget
    config: LocaliserConfig


@dataclass(frozen=True, slots=True)
class LiveDrive:
    """The drive whose frames are localised.

    Attributes:
        basin: the match basin of its camera.
        live: its session; the UUID seeds the matcher, so that the same drive gives the same
            results.
        saves: whether it is being mapped: then its own recent nodes are not candidates.
        clock: time zone and location of its stamps; None if unknown.
    """

    basin: MatchBasin
    live: SessionId = UNNAMED_LIVE_SESSION
    saves: bool = False
    clock: Clocked | None = None
