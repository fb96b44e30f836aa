"""Path memory: every session's walk through experience space [L15 §IV]."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.graph.basin import BIN_M, MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import PathEntry, PathEntryKind, PathId
from engram.graph.neighbourhood import Neighbourhood

ALL_KINDS = frozenset(PathEntryKind)
# [L15 §IV]'s text records matches only (method §4).
MATCHES_ONLY = frozenset({PathEntryKind.MATCHED, PathEntryKind.REPLAYED})


class PathMemory:
    """All paths of a map, each an ordered sequence of entries, and which nodes share paths.

    Each node has a bitset over paths, updated with each entry, so that the number of paths that
    hold two nodes is a popcount. The thread rule of `ExperienceGraph` applies.

    Args:
        graph: the graph that gives the dense indices.
        kinds: kinds of entry that count a node as on a path. Entries of other kinds are stored
            only.
    """

    def __init__(
        self, graph: ExperienceGraph, kinds: Collection[PathEntryKind] = ALL_KINDS
    ) -> None:
        self._graph = graph
        self.kinds = frozenset(kinds)
        self._entries: list[list[PathEntry]] = []
        self._paths: list[PathId] = []
        self._number: dict[PathId, int] = {}
        self._bits = np.zeros((16, 1), dtype=np.uint64)
        self._observed = _core.ObservedPaths()
        self._counting: dict[frozenset[PathEntryKind], PathMemory] = {}
        # Number of paths and the core's view of the bits; valid until they grow.
        self._view: tuple[int, _core.PathBits] | None = None

    def __len__(self) -> int:
        return len(self._paths)

    @property
    def paths(self) -> Sequence[PathId]:
        """All paths, in the order of their first entries. Read-only."""
        return self._paths

    def entries(self, path: PathId) -> Sequence[PathEntry]:
        """A path's entries by sequence number; none if the path is unknown. Read-only."""
        number = self._number.get(path)
        return () if number is None else self._entries[number]

    def counting(self, kinds: Collection[PathEntryKind]) -> PathMemory:
        """A memory of the same paths that counts only these kinds; it grows with this one."""
        wanted = frozenset(kinds)
        if wanted == self.kinds:
            return self
        if wanted not in self._counting:
            other = self._counting[wanted] = PathMemory(self._graph, wanted)
            for entries in self._entries:
                for entry in entries:
                    other.add(entry)
        return self._counting[wanted]

    def add(self, entry: PathEntry) -> None:
        """Add an entry; an existing one with the same (path, sequence) stays instead.

        Raises:
            InputError: its node is not in the graph.
        """
        node = self._graph.index(entry.node)
        number = self._numbered(entry.path)
        if _insert(self._entries[number], entry) and entry.kind in self.kinds:
            self._make_room()
            self._bits[node, number // 64] |= np.uint64(1 << (number % 64))
            self._observed.add(node, number)
        for other in self._counting.values():
            other.add(entry)

    def add_all(self, entries: Sequence[PathEntry]) -> None:
        """Add many entries, in this order; see `add`."""
        if self._counting:
            for entry in entries:
                self.add(entry)
            return
        nodes, numbers = [], []
        for entry in entries:
            node = self._graph.index(entry.node)
            number = self._numbered(entry.path)
            if _insert(self._entries[number], entry) and entry.kind in self.kinds:
                nodes.append(node)
                numbers.append(number)
                self._observed.add(node, number)
        self._make_room()
        at, bits = np.array(numbers, np.int64), np.uint64(1)
        words = bits << (at % 64).astype(np.uint64)
        np.bitwise_or.at(self._bits, (np.array(nodes, np.int64), at // 64), words)

    def on_paths(self, paths: Sequence[PathId], nodes: NDArray[np.int32]) -> NDArray[np.bool_]:
        """(P, N) bool: whether each path holds each node; unknown paths hold none.

        Args:
            paths: P paths.
            nodes: (N,) int32, dense node indices.
        """
        self._make_room()
        numbers = np.array([self._number.get(path, -1) for path in paths], np.int64)
        words = self._bits[nodes][:, numbers // 64].T
        held = (words >> (numbers % 64).astype(np.uint64)[:, None]) & np.uint64(1)
        return np.asarray((held != 0) & (numbers >= 0)[:, None])

    def co_occurrence(
        self, a: NDArray[np.int32], b: NDArray[np.int32], *, excluded: PathId | None = None
    ) -> NDArray[np.int32]:
        """(A, B) int32: how many paths hold both a[i] and b[j]: Z and N of [L15 §V].

        Args:
            a: (A,) int32, dense node indices.
            b: (B,) int32, dense node indices.
            excluded: a path that does not count, such as the live session's own.
        """
        return _core.co_occurrence(self._bound(), a, b, self._excluded(excluded))

    def evidence(
        self,
        observed: NDArray[np.int32],
        outcomes: NDArray[np.bool_],
        reference: int | None,
        *,
        excluded: PathId | None = None,
        alpha: float = 1.0,
        gamma: float = 1.0,
    ) -> _core.PathEvidence:
        """The evidence that scores candidates: W, z and k of [L15 §V].

        Args:
            observed: (W,) int32, dense indices of the recently attempted nodes, each once.
            outcomes: (W,) bool, z: whether the latest attempt on each succeeded.
            reference: node k in which the robot is localised; None makes the prior uniform.
            excluded: a path that does not count, such as the live session's own.
            alpha: pseudo-count of the likelihood.
            gamma: pseudo-count of the prior.
        """
        return _core.PathEvidence(
            observed,
            outcomes,
            -1 if reference is None else reference,
            self._excluded(excluded),
            alpha,
            gamma,
        )

    def scores(
        self, candidates: NDArray[np.int32], evidence: _core.PathEvidence
    ) -> NDArray[np.float64]:
        """(Y,) float64: log p(y = i | Z, θ, π) of each candidate, up to a common constant.

        Without two observed nodes only the prior counts. Results for the observed nodes are cached
        for the next call.

        Source: method §4, [L15 §V, eqs. (1)–(7)].

        Args:
            candidates: (Y,) int32, dense node indices.
            evidence: made by this path memory.
        """
        return _core.path_scores(self._observed, self._bound(), candidates, evidence)

    def order(
        self,
        neighbourhood: Neighbourhood,
        evidence: _core.PathEvidence,
        basin: MatchBasin,
        level: float,
    ) -> NDArray[np.int64]:
        """(Y,) int64: rows with g >= `level` by `scores`, then the others by distance.

        Ties break by distance, then by UUID.

        Args:
            neighbourhood: the candidates Y.
            evidence: made by this path memory.
            basin: gives g.
            level: threshold of g.
        """
        candidates = _core.PathCandidates(
            neighbourhood.nodes,
            neighbourhood.along_m,
            neighbourhood.across_m,
            neighbourhood.distance_m,
            self._graph.uuid_words_of(neighbourhood.nodes),
        )
        return _core.path_order(
            self._observed, self._bound(), candidates, evidence, basin.rates, BIN_M, level
        )

    def _numbered(self, path: PathId) -> int:
        """Number of a path, which is new if unknown."""
        number = self._number.setdefault(path, len(self._paths))
        if number == len(self._paths):
            self._paths.append(path)
            self._entries.append([])
        return number

    def _bound(self) -> _core.PathBits:
        self._make_room()
        if self._view is None or self._view[0] != len(self._paths):
            self._view = len(self._paths), _core.PathBits(self._bits, len(self._paths))
        return self._view[1]

    def _excluded(self, path: PathId | None) -> int:
        return -1 if path is None else self._number.get(path, -1)

    def _make_room(self) -> None:
        """Make room for all nodes (rows) and paths (words); each doubles when full."""
        rows, words = self._bits.shape
        if len(self._graph) <= rows and len(self._paths) <= 64 * words:
            return
        while rows < len(self._graph):
            rows *= 2
        while 64 * words < len(self._paths):
            words *= 2
        grown = np.zeros((rows, words), dtype=np.uint64)
        grown[: self._bits.shape[0], : self._bits.shape[1]] = self._bits
        self._bits, self._view = grown, None


def _insert(entries: list[PathEntry], entry: PathEntry) -> bool:
    """Insert by sequence number; False if that number is taken."""
    if not entries or entries[-1].sequence < entry.sequence:  # the usual case: in order
        entries.append(entry)
        return True
    place = bisect_left(entries, entry.sequence, key=lambda known: known.sequence)
    if entries[place].sequence == entry.sequence:
        return False
    entries.insert(place, entry)
    return True
