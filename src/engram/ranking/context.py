"""The ranking policy protocol, its input, and reasons for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Protocol, runtime_checkable

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.geometry.cameras import CameraId, StereoCamera
from engram.graph.basin import MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import PathId, Session, SessionId, path_id
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import Attempts, PathMemory
from engram.places.words import NodeWords
from engram.ranking.recent import Observations, RunAttempts

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


# Match probability of a node without evidence.
UNKNOWN_BASE = 0.4


@dataclass(frozen=True, slots=True)
class LessonsConfig:
    """How past drives' attempts count for a node. Source: `lab/reports/ranking-policies.md`."""

    pool_m: Annotated[
        float,
        Meta(
            gt=0,
            description="m along the drive over which evidence of another node of the experience "
            "decays e-fold: nodes are a metre apart, and a drive attempts some of them",
        ),
    ] = 3.0
    pool_reach_m: Annotated[float, Meta(ge=0, description="m at which that evidence ends")] = 4.0
    pool_nodes: Annotated[
        int, Meta(ge=0, description="most nodes before and after that share their evidence")
    ] = 8
    saving_counts: Annotated[
        float,
        Meta(
            ge=0,
            description="successes counted for the drive that saved a node, which would surely "
            "have matched it",
        ),
    ] = 2.0
    unknown_base: Annotated[
        float, Meta(gt=0, lt=1, description="match probability of a node without evidence")
    ] = UNKNOWN_BASE
    base_attempts: Annotated[
        float, Meta(gt=0, description="weight of that probability, in attempts")
    ] = 2.0

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class Lessons:
    """Probability that each node matches if its offset does not prevent it.

    Attributes:
        base: (N,) float64, that probability by all past drives; without nodes saved since the
            map was opened.
    """

    base: NDArray[np.float64]
    unknown: float = UNKNOWN_BASE
    _log_odds: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        base = np.append(self.base, self.unknown)
        object.__setattr__(self, "_log_odds", np.log(base / (1 - base)))

    @staticmethod
    def none() -> Lessons:
        """Lessons of an empty map."""
        return Lessons(np.zeros(0))

    def log_odds_of(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(Y,) float64: log odds of the probabilities of nodes, (Y,) dense indices."""
        return self._log_odds[np.minimum(nodes, len(self.base))]

    @staticmethod
    def learnt(
        graph: ExperienceGraph,
        path_memory: PathMemory,
        viewers: Sequence[PathId],
        attempts: Attempts,
        rates: NDArray[np.float64],
        config: LessonsConfig = LessonsConfig(),
    ) -> Lessons:
        """Learns from the drives of a map.

        A success counts 1, a failure as much as its success rate g. A drive without remembered
        attempts counts as having matched the nodes on its path. Evidence is shared along an
        experience, as nodes a metre apart match alike.

        Args:
            viewers: V drives, by their paths.
            attempts: their attempts; `session` indexes `viewers`.
            rates: (A,) float64, success rate g at the predicted offset of each attempt.
            config: how they count.
        """
        sharing = _sharing(graph, config)
        good, bad = _counts(graph, path_memory, viewers, attempts, rates)
        known = set(viewers)
        saved = [path_id(graph.session(number)) in known for number in range(graph.session_count)]
        good += config.saving_counts * np.array(saved, np.bool_)[graph.sessions]
        good, bad = sharing @ good, sharing @ bad
        prior, unknown = config.base_attempts, config.unknown_base
        return Lessons((good + prior * unknown) / (good + bad + prior), unknown)


def _counts(
    graph: ExperienceGraph,
    path_memory: PathMemory,
    viewers: Sequence[PathId],
    attempts: Attempts,
    rates: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N,) float64 each: successes and weighted failures of each node."""
    count = len(graph)
    good, bad = np.zeros((2, count))
    np.add.at(good, attempts.node, attempts.accepted)
    np.add.at(bad, attempts.node, np.where(attempts.accepted, 0.0, rates))
    spoke = set(np.unique(attempts.session).tolist())
    silent = [viewer for number, viewer in enumerate(viewers) if number not in spoke]
    walked = [graph.index(one.node) for path in silent for one in path_memory.entries(path)]
    np.add.at(good, np.array(walked, np.int64), 1.0)
    return good, bad


def _sharing(graph: ExperienceGraph, config: LessonsConfig) -> csr_matrix:
    """(N, N) weight of each node's evidence at the other nodes of its experience."""
    from scipy.sparse import coo_matrix

    count = len(graph)
    driven_m, experiences = graph.driven_m, graph.experiences
    in_line = np.lexsort((np.arange(count), driven_m, experiences))
    rows, columns, weights = [np.arange(count)], [np.arange(count)], [np.ones(count)]
    for step in range(1, config.pool_nodes + 1):
        a, b = in_line[:-step], in_line[step:]
        apart_m = driven_m[b] - driven_m[a]
        near = (experiences[a] == experiences[b]) & (apart_m <= config.pool_reach_m)
        if not near.any():
            break
        weight = np.exp(-apart_m[near] / config.pool_m)
        rows += [a[near], b[near]]
        columns += [b[near], a[near]]
        weights += [weight, weight]
    at = (np.concatenate(rows), np.concatenate(columns))
    return coo_matrix((np.concatenate(weights), at), (count, count)).tocsr()


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
    lessons: Lessons = field(default_factory=Lessons.none)
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
            if it never was.
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
