"""What past drives learnt at each node: how often it matched, and how often in vain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix

from engram.graph.attempts import Attempts
from engram.graph.graph import ExperienceGraph
from engram.graph.model import PathId, path_id
from engram.graph.paths import PathMemory

# A node of the same experience tells as much less as it is farther along the drive: e-fold per
# 3 m, nothing beyond 4 m. The chains are sampled every metre, and a drive attempts some of them.
_POOL_M, _POOL_REACH_M = 3.0, 4.0
_POOL_NODES = 8
# The drive that saved a node would have matched it with certainty.
_SAVING_COUNTS = 2.0
# How likely anybody matches a node of which nothing is known, and how many attempts that is worth.
UNKNOWN_BASE = 0.4
_BASE_ATTEMPTS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Lessons:
    """How likely each node is matched where offsets do not prevent it.

    Attributes:
        base: (N,) float64, by all past drives; nodes saved since the map was opened are missing.
    """

    base: NDArray[np.float64]
    _and_unknown: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_and_unknown", np.append(self.base, UNKNOWN_BASE))

    @staticmethod
    def none() -> Lessons:
        """Of an empty map."""
        return Lessons(np.zeros(0))

    def of(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(Y,) the base of some nodes; 0.4 where it is missing."""
        return self._and_unknown[np.minimum(nodes, len(self.base))]

    @staticmethod
    def learnt(
        graph: ExperienceGraph,
        path_memory: PathMemory,
        viewers: Sequence[PathId],
        attempts: Attempts,
        rates: NDArray[np.float64],
    ) -> Lessons:
        """What the drives of a map teach.

        A success counts one, a failure as much as a match was likely; a drive of which no attempt
        is remembered is taken to have matched the nodes on its path. Evidence is shared along an
        experience: what happened a metre before happens here.

        Args:
            graph: the nodes.
            path_memory: the paths.
            viewers: (V,) the drives.
            attempts: what they attempted; sessions are places in `viewers`.
            rates: (A,) g at the predicted offset of each.
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
    """(N,) successes and weighted failures of each node."""
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
    """(N, N) how much each node's evidence counts at another of its experience."""
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
