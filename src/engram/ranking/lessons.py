"""What past drives teach about the nodes of a map: how likely each matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.graph.graph import ExperienceGraph, labels_of
from engram.graph.model import PathId, path_id
from engram.graph.pages import PAGE
from engram.graph.paths import Attempts, Evidence, PathMemory

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
        good, bad = _counts(graph, path_memory, viewers, attempts, rates)
        known = set(viewers)
        saved = [path_id(graph.session(number)) in known for number in range(graph.session_count)]
        good += config.saving_counts * np.array(saved, np.bool_)[graph.sessions]
        base = _shared(graph.driven_m, graph.experiences, good, bad, config)
        return Lessons(base, config.unknown_base)


class PagedLessons:
    """The lessons of a map, learnt page by page as nodes are requested.

    Evidence is shared along the nodes that were saved one after another; see `Lessons`.

    Args:
        evidence: of the nodes from a dense index up to another one; its answers never change.
        end: no node with evidence has this dense index or a larger one.
        config: how they count.
    """

    def __init__(
        self,
        evidence: Callable[[int, int], Evidence],
        end: int,
        config: LessonsConfig = LessonsConfig(),
    ) -> None:
        self._evidence, self._end, self._config = evidence, end, config
        # Zeros that nobody has written or read take no memory.
        pages = end // PAGE + 1
        self._log_odds = np.zeros(pages * PAGE)
        self._is_learnt = np.zeros(pages, np.bool_)

    def log_odds_of(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(Y,) float64: log odds of the probabilities of nodes, (Y,) dense indices."""
        known = np.minimum(nodes, self._end)
        pages = known // PAGE
        if not self._is_learnt[pages].all():
            for page in np.unique(pages[~self._is_learnt[pages]]).tolist():
                self._log_odds[page * PAGE : (page + 1) * PAGE] = self._learnt(page)
                self._is_learnt[page] = True
        return self._log_odds[known]

    def _learnt(self, page: int) -> NDArray[np.float64]:
        """(PAGE,) float64: the log odds of the nodes of a page."""
        config, first = self._config, page * PAGE
        around = self._evidence(max(first - config.pool_nodes, 0), first + PAGE + config.pool_nodes)
        good = around.good + config.saving_counts
        experiences = labels_of(around.links, len(around.nodes))
        learnt = _shared(around.driven_m, experiences, good, around.bad, config)
        base = np.full(PAGE, config.unknown_base)
        here = (around.nodes >= first) & (around.nodes < first + PAGE)
        base[around.nodes[here] - first] = learnt[here]
        return np.asarray(np.log(base / (1 - base)))


def _shared(
    driven_m: NDArray[np.float64],
    experiences: NDArray[np.integer],
    good: NDArray[np.float64],
    bad: NDArray[np.float64],
    config: LessonsConfig,
) -> NDArray[np.float64]:
    """(N,) float64: probability by successes and failures, (N,) each, shared along experiences."""
    in_line = np.lexsort((np.arange(len(driven_m)), driven_m, experiences))
    own = np.stack([good, bad])
    shared = own.copy()
    for step in range(1, config.pool_nodes + 1):
        a, b = in_line[:-step], in_line[step:]
        apart_m = driven_m[b] - driven_m[a]
        near = (experiences[a] == experiences[b]) & (apart_m <= config.pool_reach_m)
        if not near.any():
            break
        a, b, weight = a[near], b[near], np.exp(-apart_m[near] / config.pool_m)
        shared[:, a] += weight * own[:, b]
        shared[:, b] += weight * own[:, a]
    prior, unknown = config.base_attempts, config.unknown_base
    return np.asarray((shared[0] + prior * unknown) / (shared[0] + shared[1] + prior))


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
