"""The ranking policy protocol, its input, and reasons for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.geometry.cameras import CameraId, StereoCamera
from engram.graph.basin import MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import PathId, Session, SessionId
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import PathMemory
from engram.places.words import NodeWords
from engram.ranking.lessons import Lessons, PagedLessons
from engram.ranking.recent import Observations, RunAttempts


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """Data about a map that some policies use. Any of it may be missing.

    Attributes:
        sessions: the drives by id, with their start times.
        lessons: how likely each node matches, by past drives.
        words: the visual words of nodes and frames; None without a vocabulary.
        cameras: of the drives, by id.
    """

    sessions: Mapping[SessionId, Session] = field(default_factory=dict)
    lessons: Lessons | PagedLessons = field(default_factory=Lessons.none)
    words: NodeWords | None = None
    cameras: Mapping[CameraId, StereoCamera] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Foreseen:
    """The outcome of attempting each candidate.

    Attributes:
        accepted: (Y,) bool, whether it is a success.
        inliers: (Y,) int64, inliers of the match, 0 without one.
    """

    accepted: NDArray[np.bool_]
    inliers: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class RankingContext:
    """The input of a policy for one live frame.

    Attributes:
        neighbourhood: the candidates Y.
        graph: their graph.
        path_memory: all paths of the map.
        basin: the live camera's match basin.
        observations: W and z, the recent attempts.
        reference: dense index of the node k in which the robot is or was last localised; None
            if it was not yet, or its position was supplied since, and no match has confirmed it.
        own_path: the live session's path, excluded from Z and N; None if it has none.
        stamp_ns: the live frame's stamp, ns.
        seed: seed for policies that draw at random.
        foresee: makes every attempt; only for the oracle, the upper bound of all policies (method
            §4). None if unavailable.
        run: this run's attempts, with their distances and success rates.
        hour: hour of day of the live frame in [0, 24); None if unknown.
        day: its date, days since 1970; None if its clock is not UTC.
        background: data about the map's sessions and nodes.
        seen: the candidates as seen by one lens; None if the lenses are equal.
        live_words: computes the distinct words of the live frame, (n,) int32, increasing; None
            without a vocabulary.
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
    seen: Neighbourhood | None = None
    live_words: Callable[[], NDArray[np.int32]] | None = None

    @property
    def as_seen(self) -> Neighbourhood:
        """The candidates with offsets that compare over lenses."""
        return self.seen or self.neighbourhood

    @property
    def sessions(self) -> NDArray[np.int32]:
        """(Y,) int32: number of the session that saved each candidate."""
        return self.graph.sessions_of(self.neighbourhood.nodes)

    def success_rates(self) -> NDArray[np.float64]:
        """(Y,) float64: success rate g(d) of each candidate if it looks alike (method §3.1)."""
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
            ConfigError: the policy needs data that the context does not have.
        """
        ...


def uses_words(policy: RankingPolicy) -> bool:
    """Whether a policy uses visual words, which are then read before the drive.

    A policy states it by a true attribute of this name.
    """
    return bool(getattr(policy, "uses_words", False))


def looks_ahead(policy: RankingPolicy) -> bool:
    """Whether a policy calls `RankingContext.foresee`, by its attribute of this name."""
    return bool(getattr(policy, "looks_ahead", False))


def order_by(context: RankingContext, *keys: NDArray[np.generic]) -> NDArray[np.int64]:
    """(Y,) int64: rows by the keys, (Y,) each, smallest first; ties by distance, then UUID."""
    neighbourhood = context.neighbourhood
    values = (np.ascontiguousarray(key, dtype=np.float64) for key in keys)
    uuid_words = context.graph.uuid_words_of(neighbourhood.nodes)
    return _core.order_rows(uuid_words, *values, neighbourhood.distance_m)


@dataclass(frozen=True, slots=True, eq=False)
class Reasons:
    """The parts of a policy's order.

    Attributes:
        terms: name → (Y,) float64, scores by row of the neighbourhood.
        chances: (Y,) float64, probability of success; None if the policy estimates none.
        by_turn: (Y,) bool, whether a candidate's place is by rotation, not by its score; None if
            the policy has no rotation.
        rule: description of how the terms give the order.
    """

    terms: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    meaning: dict[str, str] = field(default_factory=dict)
    chances: NDArray[np.float64] | None = None
    by_turn: NDArray[np.bool_] | None = None
    rule: str = ""


@runtime_checkable
class Explains(Protocol):
    """A policy that can explain its order."""

    def reasons(self, context: RankingContext) -> Reasons:
        """The parts of the order of this context's candidates."""
        ...


def reasons_of(policy: RankingPolicy, context: RankingContext) -> Reasons:
    """A policy's reasons; empty ones if it explains nothing."""
    return policy.reasons(context) if isinstance(policy, Explains) else Reasons()
