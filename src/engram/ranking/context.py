"""What a ranking policy gets to see, and what it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.graph.basin import MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import PathId
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import PathMemory
from engram.ranking.background import Background
from engram.ranking.recent import Observations
from engram.ranking.run import RunAttempts


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
        run: this run's attempts, with where they were made and how likely they were.
        hour: hour of day of the live frame in [0, 24); None where it is not known.
        day: its date, days since 1970; None where its clock is not UTC.
        background: what is known of the map's sessions and nodes.
        live_words: gives the distinct words (n,) int32 of the live frame, rising; None where
            there is no vocabulary. Costs time only when called.
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
    run: RunAttempts = field(default_factory=RunAttempts.none)
    hour: float | None = None
    day: float | None = None
    background: Background = field(default_factory=Background)
    live_words: Callable[[], NDArray[np.int32]] | None = None

    @property
    def sessions(self) -> NDArray[np.int32]:
        """(Y,) int32: for each candidate the number of the session that saved it."""
        return self.graph.sessions_of(self.neighbourhood.nodes)

    def success_rates(self) -> NDArray[np.float64]:
        """(Y,) float64: g(d) of each candidate, appearance being compatible (SPEC §3.1)."""
        near = self.neighbourhood
        return self.basin.success_rate(near.along_m, near.across_m)


class RankingPolicy(Protocol):
    """Orders the candidates of one live frame by how likely they are to match it."""

    @property
    def name(self) -> str:
        """Its name in `POLICIES`."""
        ...

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """(Y,) int64: the rows of the neighbourhood, most promising first; each row once.

        Raises:
            ConfigError: the policy needs to know what the context cannot tell.
        """
        ...


def uses_words(policy: RankingPolicy) -> bool:
    """Whether a policy looks at visual words: a localiser then has them read before it sets off.

    It says so by an attribute of this name that is true.
    """
    return bool(getattr(policy, "uses_words", False))


def looks_ahead(policy: RankingPolicy) -> bool:
    """Whether a policy asks `RankingContext.foresee`, as its attribute of this name says."""
    return bool(getattr(policy, "looks_ahead", False))


def order_by(context: RankingContext, *keys: NDArray[np.generic]) -> NDArray[np.int64]:
    """Rows by the keys, (Y,) each, smallest first; ties by distance, then by UUID (SPEC §4)."""
    neighbourhood = context.neighbourhood
    values = (np.ascontiguousarray(key, dtype=np.float64) for key in keys)
    uuid_words = context.graph.uuid_words_of(neighbourhood.nodes)
    return _core.order_rows(uuid_words, *values, neighbourhood.distance_m)
