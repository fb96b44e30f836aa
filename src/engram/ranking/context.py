"""What a ranking policy gets to see, and what it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.experience.basin import MatchBasin
from engram.experience.graph import ExperienceGraph
from engram.experience.model import PathId
from engram.experience.neighbourhood import Neighbourhood
from engram.experience.path_memory import PathMemory
from engram.ranking.recent import Observations


@dataclass(frozen=True, slots=True, eq=False)
class Foreseen:
    """What attempting each candidate would come to.

    Attributes:
        accepted: (Y,) bool, whether it would be a success.
        inliers: (Y,) int64, inliers of the match, 0 if there were none.
    """

    accepted: NDArray[np.bool_]
    inliers: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class RankingContext:
    """One live frame's situation.

    Attributes:
        neighbourhood: the candidates Y.
        graph: the graph that they are in.
        path_memory: all paths of the map.
        basin: the live camera's match basin.
        observations: W and z, the recent attempts.
        reference: dense index of the node k in which the robot is localised, or was last; None
            if it never was.
        own_path: the live session's path, which counts neither in Z nor in N; None if it has none.
        stamp_ns: the live frame's stamp, ns.
        seed: of policies that draw at random.
        foresee: makes every attempt to see how it ends; only the oracle, the bound of all
            policies, asks (SPEC §4). None where it cannot be known.
    """

    neighbourhood: Neighbourhood
    graph: ExperienceGraph
    path_memory: PathMemory
    basin: MatchBasin
    observations: Observations
    reference: int | None
    own_path: PathId | None
    stamp_ns: int
    seed: int = 0
    foresee: Callable[[], Foreseen] | None = None


class RankingPolicy(Protocol):
    """Orders the candidates of one live frame by how likely they are to match it."""

    @property
    def name(self) -> str:
        """Its name in `POLICIES`."""
        ...

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """(Y,) int64: the rows of the neighbourhood, most promising first; each row once."""
        ...


def order_by(context: RankingContext, *keys: NDArray[np.generic]) -> NDArray[np.int64]:
    """Rows by the keys, (Y,) each, smallest first; ties by distance, then by UUID (SPEC §4)."""
    neighbourhood = context.neighbourhood
    values = (np.ascontiguousarray(key, dtype=np.float64) for key in keys)
    uuid_words = context.graph.uuid_words
    return _core.order_rows(neighbourhood.nodes, uuid_words, *values, neighbourhood.distance_m)
