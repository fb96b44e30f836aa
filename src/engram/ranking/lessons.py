"""What past drives learnt at each node: who matched it, and who tried and failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix

from engram import _core
from engram.experience.graph import ExperienceGraph
from engram.experience.model import PathId, path_id
from engram.experience.path_memory import PathMemory

# A node of the same experience tells as much less as it is farther along the drive: e-fold per
# 3 m, nothing beyond 4 m. The chains are sampled every metre, and a drive attempts some of them.
_POOL_M, _POOL_REACH_M = 3.0, 4.0
_POOL_NODES = 8
# The drive that saved a node would have matched it with certainty.
_SAVING_COUNTS = 2.0
# Drives remembered at each node, the newest: more cost time on every frame.
_MOST_VIEWERS = 64
# How likely anybody matches a node of which nothing is known, and how many attempts that is worth.
UNKNOWN_BASE = 0.4
_BASE_ATTEMPTS = 2.0
# What a drive did at a node, against what others did, with that many attempts of theirs.
_OWN_ATTEMPTS = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class PastAttempts:
    """Remembered attempts of all past drives (SPEC §3.5), as a struct of arrays.

    Attributes:
        viewers: (A,) int32, number of the drive that made each.
        nodes: (A,) int32, dense indices of the nodes attempted.
        rates: (A,) float64, g at the predicted offset.
        accepted: (A,) bool.
    """

    viewers: NDArray[np.int32]
    nodes: NDArray[np.int32]
    rates: NDArray[np.float64]
    accepted: NDArray[np.bool_]

    @staticmethod
    def none() -> PastAttempts:
        """Nothing remembered."""
        nothing = np.zeros(0, np.int32)
        return PastAttempts(nothing, nothing, np.zeros(0), np.zeros(0, np.bool_))


@dataclass(frozen=True, slots=True, eq=False)
class Lessons:
    """How likely each past drive matches each node: a sparse table, a row of entries per node.

    Attributes:
        viewers: the drives by number, oldest first, each named by its path.
        hours: (V,) float64, hour of day at which each began; NaN where unknown.
        starts: (N + 1,) int64, the entries of node n are ``starts[n]`` up to ``starts[n + 1]``.
        entry_viewers: (E,) int32, drive of each entry, rising within a row.
        rates: (E,) float32, how likely the drive matches the node where offsets do not prevent it.
        base: (N,) float64, how likely anybody does.
        table: the same for the core.
    """

    viewers: tuple[PathId, ...]
    hours: NDArray[np.float64]
    starts: NDArray[np.int64]
    entry_viewers: NDArray[np.int32]
    rates: NDArray[np.float32]
    base: NDArray[np.float64]
    table: _core.RecallLessons = field(init=False, repr=False)
    _numbers: dict[PathId, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        of_all = np.repeat(self.base, np.diff(self.starts))
        rates = self.rates.astype(np.float64)
        table = _core.RecallLessons(
            self.starts,
            self.entry_viewers,
            self.rates,
            np.log(rates / of_all).astype(np.float32),
            np.log((1 - rates) / (1 - of_all)).astype(np.float32),
            self.base,
            len(self.viewers),
        )
        object.__setattr__(self, "table", table)
        numbers = {viewer: number for number, viewer in enumerate(self.viewers)}
        object.__setattr__(self, "_numbers", numbers)

    def number(self, viewer: PathId | None) -> int | None:
        """Number of a drive; None if it taught nothing."""
        return None if viewer is None else self._numbers.get(viewer)

    @staticmethod
    def none() -> Lessons:
        """Of an empty map."""
        return Lessons(
            (),
            np.zeros(0),
            np.zeros(1, np.int64),
            np.zeros(0, np.int32),
            np.zeros(0, np.float32),
            np.zeros(0),
        )

    @staticmethod
    def learnt(
        graph: ExperienceGraph,
        path_memory: PathMemory,
        viewers: Sequence[PathId],
        hours: NDArray[np.float64],
        attempts: PastAttempts,
    ) -> Lessons:
        """What the drives of a map teach.

        A success counts one, a failure as much as a match was likely; a drive of which no attempt
        is remembered is taken to have matched the nodes on its path. Evidence is shared along an
        experience: what happened a metre before happens here.

        Args:
            graph: the nodes.
            path_memory: the paths.
            viewers: (V,) the drives, oldest first.
            hours: (V,) their hours of day; NaN where unknown.
            attempts: what they attempted.
        """
        successes, failures = _counts(graph, path_memory, viewers, attempts)
        sharing = _sharing(graph)
        a, b = sharing @ successes, sharing @ failures
        base = _of_all(a, b)
        return _table(tuple(viewers), np.asarray(hours, np.float64), a, b, base)


def _counts(
    graph: ExperienceGraph,
    path_memory: PathMemory,
    viewers: Sequence[PathId],
    attempts: PastAttempts,
) -> tuple[csr_matrix, csr_matrix]:
    """Successes and weighted failures (N, V) by node and drive."""
    shape = (len(graph), len(viewers))
    number = {viewer: at for at, viewer in enumerate(viewers)}
    silent = set(range(len(viewers))) - set(np.unique(attempts.viewers).tolist())
    walked = [
        (graph.index(entry.node), at)
        for at in sorted(silent)
        for entry in path_memory.entries(viewers[at])
    ]
    saver_of = np.array([number.get(path, -1) for path in _saving_paths(graph)], np.int64)
    savers = saver_of[graph.sessions] if len(graph) else np.zeros(0, np.int64)
    saved = np.flatnonzero(savers >= 0)
    walked_nodes, walkers = np.array(walked, np.int64).reshape(-1, 2).T
    nodes = np.concatenate([attempts.nodes, walked_nodes, saved])
    drives = np.concatenate([attempts.viewers, walkers, savers[saved]])
    good = np.concatenate(
        [attempts.accepted, np.ones(len(walkers)), np.full(len(saved), _SAVING_COUNTS)]
    )
    bad = np.zeros(len(nodes))
    bad[: len(attempts.nodes)] = np.where(attempts.accepted, 0.0, attempts.rates)
    return (
        coo_matrix((good.astype(np.float64), (nodes, drives)), shape).tocsr(),
        coo_matrix((bad, (nodes, drives)), shape).tocsr(),
    )


def _saving_paths(graph: ExperienceGraph) -> list[PathId]:
    """The path of each session of the graph, by number."""
    return [path_id(graph.session(number)) for number in range(graph.session_count)]


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


def _of_all(a: csr_matrix, b: csr_matrix) -> NDArray[np.float64]:
    """(N,) how likely anybody matches each node."""
    good, bad = (np.asarray(counts.sum(axis=1)).reshape(-1) for counts in (a, b))
    return np.asarray((good + _BASE_ATTEMPTS * UNKNOWN_BASE) / (good + bad + _BASE_ATTEMPTS))


def _table(
    viewers: tuple[PathId, ...],
    hours: NDArray[np.float64],
    a: csr_matrix,
    b: csr_matrix,
    base: NDArray[np.float64],
) -> Lessons:
    total = (a + b).tocsr()
    total.sort_indices()
    nodes = np.repeat(np.arange(len(base)), np.diff(total.indptr))
    newest = np.arange(total.nnz) >= total.indptr[nodes + 1] - _MOST_VIEWERS
    nodes, drives = nodes[newest], total.indices[newest]
    good = np.asarray(a[nodes, drives]).reshape(-1)
    rates = (good + _OWN_ATTEMPTS * base[nodes]) / (total.data[newest] + _OWN_ATTEMPTS)
    kept = np.bincount(nodes, minlength=len(base))
    return Lessons(
        viewers,
        hours,
        np.concatenate([[0], np.cumsum(kept)]).astype(np.int64),
        drives.astype(np.int32),
        np.clip(rates, 1e-3, 1 - 1e-3).astype(np.float32),
        base,
    )
