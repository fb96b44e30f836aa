"""Evidence of past drives for each node: how often it matched, and how often it failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from engram.graph.attempts import Attempts
from engram.graph.graph import ExperienceGraph
from engram.graph.model import PathId, path_id
from engram.graph.paths import PathMemory

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# Evidence of another node of the experience decays e-fold per 3 m along the drive and ends at 4 m:
# nodes are a metre apart, and a drive attempts only some of them.
_POOL_M, _POOL_REACH_M = 3.0, 4.0
_POOL_NODES = 8
# Successes counted for the drive that saved a node, which would surely have matched it.
_SAVING_COUNTS = 2.0
# Match probability of a node without evidence, and the weight of it in attempts.
UNKNOWN_BASE = 0.4
_BASE_ATTEMPTS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Lessons:
    """Probability that each node matches if its offset does not prevent it.

    Attributes:
        base: (N,) float64, that probability by all past drives; without nodes saved since the
            map was opened.
    """

    base: NDArray[np.float64]
    _and_unknown: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_and_unknown", np.append(self.base, UNKNOWN_BASE))

    @staticmethod
    def none() -> Lessons:
        """Lessons of an empty map."""
        return Lessons(np.zeros(0))

    def of(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(Y,) float64: the probabilities of nodes, (Y,) dense indices; 0.4 if missing."""
        return self._and_unknown[np.minimum(nodes, len(self.base))]

    @staticmethod
    def learnt(
        graph: ExperienceGraph,
        path_memory: PathMemory,
        viewers: Sequence[PathId],
        attempts: Attempts,
        rates: NDArray[np.float64],
    ) -> Lessons:
        """Learns from the drives of a map.

        A success counts 1, a failure as much as its success rate g. A drive without remembered
        attempts counts as having matched the nodes on its path. Evidence is shared along an
        experience, as nodes a metre apart match alike.

        Args:
            graph: the nodes.
            path_memory: the paths.
            viewers: V drives, by their paths.
            attempts: their attempts; `session` indexes `viewers`.
            rates: (A,) float64, success rate g at the predicted offset of each attempt.
        """
        sharing = _sharing(graph)
        good, bad = (
            sharing @ counts for counts in _counts(graph, path_memory, viewers, attempts, rates)
        )
        return Lessons((good + _BASE_ATTEMPTS * UNKNOWN_BASE) / (good + bad + _BASE_ATTEMPTS))


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
    known = set(viewers)
    saved = [path_id(graph.session(number)) in known for number in range(graph.session_count)]
    good += _SAVING_COUNTS * np.array(saved, np.bool_)[graph.sessions]
    return good, bad


def _sharing(graph: ExperienceGraph) -> csr_matrix:
    """(N, N) weight of each node's evidence at the other nodes of its experience."""
    from scipy.sparse import coo_matrix

    count = len(graph)
    driven_m, experiences = graph.driven_m, graph.experiences
    in_line = np.lexsort((np.arange(count), driven_m, experiences))
    rows, columns, weights = [np.arange(count)], [np.arange(count)], [np.ones(count)]
    for step in range(1, _POOL_NODES + 1):
        a, b = in_line[:-step], in_line[step:]
        apart_m = driven_m[b] - driven_m[a]
        near = (experiences[a] == experiences[b]) & (apart_m <= _POOL_REACH_M)
        if not near.any():
            break
        weight = np.exp(-apart_m[near] / _POOL_M)
        rows += [a[near], b[near]]
        columns += [b[near], a[near]]
        weights += [weight, weight]
    at = (np.concatenate(rows), np.concatenate(columns))
    return coo_matrix((np.concatenate(weights), at), (count, count)).tocsr()
