"""Path memory: the paths that drives took through the graph, and their attempts to match."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.geometry.se3 import SE3
from engram.graph.basin import BIN_M, MatchBasin
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Attempt, NodeId, PathEntry, PathEntryKind, PathId
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.pages import PAGE

ENTRY_KINDS = tuple(PathEntryKind)
ALL_KINDS = frozenset(PathEntryKind)
# [L15 §IV]'s text records matches only (method §4).
MATCHES_ONLY = frozenset({PathEntryKind.MATCHED, PathEntryKind.REPLAYED})
# Of bits that are read by pages: above it `trim` drops them.
_MOST_BYTES = 16 * 2**20


class PathPages(Protocol):
    """Where a path memory reads which nodes are on which paths; its answers never change."""

    @property
    def paths(self) -> Sequence[PathId]:
        """All paths by number."""
        ...

    def visits(
        self, first: int, end: int
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.uint8]]:
        """Nodes (V,), numbers of paths (V,) and kinds (V,), indices into `ENTRY_KINDS`.

        Args:
            first, end: dense indices of the first node and of that after the last.

        Raises:
            MapCorruptError: a row of these is damaged.
        """
        ...


class PathMemory:
    """All paths of a map, each an ordered sequence of entries, and which nodes share paths.

    Each node has a bitset over paths, updated with each entry, so that the number of paths that
    hold two nodes is a popcount. The thread rule of `ExperienceGraph` applies.

    Args:
        graph: the graph that gives the dense indices.
        kinds: kinds of entry that count a node as on a path. Entries of other kinds are stored
            only.
        pages: paths of a map, of which the bits of nodes are read when they are requested, and
            entries are not held; None for a memory of what is added.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        kinds: Collection[PathEntryKind] = ALL_KINDS,
        pages: PathPages | None = None,
    ) -> None:
        self._graph = graph
        self.kinds = frozenset(kinds)
        self._pages = pages
        self._paths: list[PathId] = [] if pages is None else list(pages.paths)
        self._entries: list[list[PathEntry]] = [[] for _ in self._paths]
        self._number = {path: number for number, path in enumerate(self._paths)}
        self._bits = np.zeros((16, 1), dtype=np.uint64)
        if pages is not None:  # zeros that nobody has written or read take no memory
            self._bits = np.zeros((len(graph) + 2**16, len(self._paths) // 64 + 1), np.uint64)
        self._read: set[int] = set()
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
            other = self._counting[wanted] = PathMemory(self._graph, wanted, self._pages)
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
            self._want(np.array([node], np.int32))
            self._bits[node, number // 64] |= np.uint64(1 << (number % 64))
            self._observed.add(node, number)
        for other in self._counting.values():
            other.add(entry)

    def add_all(self, entries: Sequence[PathEntry]) -> None:
        """Add many entries, in this order; see `add`."""
        if self._counting or self._pages is not None:
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
        self._set_bits(np.array(nodes, np.int64), np.array(numbers, np.int64))

    def trim(self) -> None:
        """Drops what was read by pages if it takes too much memory; call it between frames."""
        if len(self._read) * PAGE * self._bits.shape[1] * 8 <= _MOST_BYTES:
            return
        self._read.clear()
        self._bits, self._view = np.zeros(self._bits.shape, np.uint64), None
        for number, entries in enumerate(self._entries):
            counted = [one.node for one in entries if one.kind in self.kinds]
            nodes = np.array([self._graph.index(one) for one in counted], np.int64)
            self._set_bits(nodes, np.full(len(nodes), number))

    def on_paths(self, paths: Sequence[PathId], nodes: NDArray[np.int32]) -> NDArray[np.bool_]:
        """(P, N) bool: whether each path holds each node; unknown paths hold none.

        Args:
            paths: P paths.
            nodes: (N,) int32, dense node indices.
        """
        self._want(nodes)
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
        self._want(a, b)
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
        self._want(observed, np.array([] if reference is None else [reference], np.int32))
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
        self._want(candidates)
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
        self._want(neighbourhood.nodes)
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

    def _want(self, *nodes: NDArray[np.int32]) -> None:
        """Brings the bits of nodes into memory."""
        self._make_room()
        if self._pages is None:
            return
        for page in np.unique(np.concatenate(nodes) // PAGE).tolist():
            if page not in self._read:
                self._read.add(page)
                on, paths, kinds = self._pages.visits(page * PAGE, (page + 1) * PAGE)
                counts = np.array([kind in self.kinds for kind in ENTRY_KINDS])[kinds]
                self._set_bits(on[counts], paths[counts].astype(np.int64))

    def _set_bits(self, nodes: NDArray[np.integer], numbers: NDArray[np.int64]) -> None:
        bits = np.uint64(1) << (numbers % 64).astype(np.uint64)
        np.bitwise_or.at(self._bits, (nodes, numbers // 64), bits)

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


_FLOATS = ("along_m", "across_m", "yaw_rad", "sigma_m", "sigma_yaw_rad")


@dataclass(frozen=True, slots=True, eq=False)
class Attempts:
    """Remembered attempts as a struct of arrays, in order of session and iteration.

    Attributes:
        session: (A,) int32, index into a list of sessions.
        iteration: (A,) int64, iteration of the session's localiser.
        reference, node: (A,) int32, indices into a list of nodes; for a map, dense graph indices.
            In the map's file (A,) int64, keys of their rows.
        along_m, across_m, yaw_rad, sigma_m, sigma_yaw_rad: (A,) float32, as in `Attempt`.
        accepted: (A,) bool, whether the match was accepted.
        inliers: (A,) int32, inliers of the match.
        rank: (A,) int32, place in the ranked order, at most 255.
        policy: (A,) int32, index into `policies`.
        policies: names of the ranking policies.
    """

    session: NDArray[np.int32]
    iteration: NDArray[np.int64]
    reference: NDArray[np.int32] | NDArray[np.int64]
    node: NDArray[np.int32] | NDArray[np.int64]
    along_m: NDArray[np.float32]
    across_m: NDArray[np.float32]
    yaw_rad: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    sigma_yaw_rad: NDArray[np.float32]
    accepted: NDArray[np.bool_]
    inliers: NDArray[np.int32]
    rank: NDArray[np.int32]
    policy: NDArray[np.int32]
    policies: tuple[str, ...]

    @staticmethod
    def of(made: Sequence[Attempt]) -> tuple[Attempts, list[NodeId]]:
        """One session's records as columns, and the list of nodes that they index."""
        ids = list(dict.fromkeys(node for one in made for node in (one.reference, one.node)))
        place = {node: at for at, node in enumerate(ids)}
        policies = tuple(dict.fromkeys(one.policy for one in made))

        def column(name: str, kind: Any) -> NDArray[Any]:
            return np.array([getattr(one, name) for one in made], kind)

        attempts = Attempts(
            session=np.zeros(len(made), np.int32),
            iteration=column("iteration", np.int64),
            reference=np.array([place[one.reference] for one in made], np.int32),
            node=np.array([place[one.node] for one in made], np.int32),
            **{name: column(name, np.float32) for name in _FLOATS},
            accepted=column("accepted", np.bool_),
            inliers=column("inliers", np.int32),
            rank=column("rank", np.int32),
            policy=np.array([policies.index(one.policy) for one in made], np.int32),
            policies=policies,
        )
        return attempts, ids

    @staticmethod
    def none() -> Attempts:
        """No attempts."""
        return Attempts.of([])[0]

    @staticmethod
    def joined(parts: Sequence[Attempts]) -> Attempts:
        """All attempts in order, with one sorted list of policies."""
        parts = parts or [Attempts.none()]
        policies = tuple(sorted({name for one in parts for name in one.policies}))
        if len(parts) == 1 and parts[0].policies == policies:
            return parts[0]
        columns = {name: np.concatenate([getattr(one, name) for one in parts]) for name in _COLUMNS}
        place = {name: at for at, name in enumerate(policies)}
        known = [np.array([place[name] for name in one.policies], np.int32) for one in parts]
        columns["policy"] = np.concatenate(
            [named[one.policy] for named, one in zip(known, parts, strict=True)]
        )
        return Attempts(**columns, policies=policies)

    def __len__(self) -> int:
        return len(self.node)

    def rows(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Attempts:
        """A selection of the attempts: (A,) bool mask, or (K,) row numbers in the wanted order."""
        columns = {name: getattr(self, name)[rows] for name in _COLUMNS}
        return Attempts(**columns, policies=self.policies)

    def moved_to(self, equivalent_from_node: Sequence[SE3 | None]) -> Attempts:
        """The attempts as if made on the equivalents of the attempted nodes.

        An equivalent shows the place as the node does, so that evidence for one holds for the
        other. The predicted offset becomes that from the equivalent; heights are ignored.

        Args:
            equivalent_from_node: for each node its camera in its equivalent's camera frame; None
                without an equivalent.

        Returns:
            The attempts between nodes that have equivalents, with unchanged indices.
        """
        known = np.array([one is not None for one in equivalent_from_node], np.bool_)
        made = self.rows(known[self.reference] & known[self.node])
        moves = [one or SE3.identity() for one in equivalent_from_node]
        rotations = np.array([one.rotation for one in moves]).reshape(-1, 3, 3)
        offsets = np.array([one.translation for one in moves]).reshape(-1, 3)
        rotation, offset = rotations[made.node], offsets[made.node]
        x_m, z_m = made.across_m.astype(np.float64), made.along_m.astype(np.float64)
        turn = np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2])
        across_m = rotation[:, 0, 0] * x_m + rotation[:, 0, 2] * z_m + offset[:, 0]
        along_m = rotation[:, 2, 0] * x_m + rotation[:, 2, 2] * z_m + offset[:, 2]
        return replace(
            made,
            across_m=across_m.astype(np.float32),
            along_m=along_m.astype(np.float32),
            yaw_rad=_wrapped(made.yaw_rad + turn).astype(np.float32),
        )

    def lacking(self, remembered: Attempts) -> NDArray[np.intp]:
        """Rows of the attempts that are missing from the remembered ones.

        Two attempts are equal if they agree in all that `moved_to` keeps: session, iteration,
        rank, uncertainty of the prediction, outcome and policy. Iteration and rank alone do not
        suffice: ranks above 255 are stored as 255, and two fleet maps that replay one drive use
        the same iteration numbers. Equal attempts are compared by their number.

        Args:
            remembered: the known attempts; `session` indexes the same list.

        Returns:
            (K,) intp, row numbers.
        """
        known = remembered._by_session()
        found = [np.empty(0, np.intp)]
        # One session at a time: a fleet map remembers millions.
        for session, rows in self._by_session().items():
            ours = remembered.rows(known.get(session, np.empty(0, np.intp)))
            found.append(rows[_lacking_in_session(self.rows(rows), ours)])
        return np.sort(np.concatenate(found))

    def _by_session(self) -> dict[int, NDArray[np.intp]]:
        """Rows of each session's attempts, in order."""
        order = np.argsort(self.session, kind="stable")
        ends = np.flatnonzero(np.diff(self.session[order])) + 1
        return {int(self.session[rows[0]]): rows for rows in np.split(order, ends) if len(rows)}

    def _identities(self, policies: Sequence[str]) -> NDArray[np.int64]:
        """(A, 7) int64, identity of each attempt within its session, independent of its nodes."""
        policy = np.array([policies.index(name) for name in self.policies], np.int64)
        columns: list[NDArray[Any]] = [
            self.iteration,
            self.rank,
            self.sigma_m.view(np.int32),  # bit for bit
            self.sigma_yaw_rad.view(np.int32),
            self.accepted,
            self.inliers,
            policy[self.policy],
        ]
        return np.stack(columns, axis=1, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """How past drives fared with the nodes of a map in a range of dense indices.

    Attributes:
        nodes: (n,) int32, dense indices, rising.
        driven_m: (n,) float64, metres.
        links: (L, 2) int32, rows of the nodes that an odometry edge of one drive joins.
        good, bad: (n,) float64, number of successes and sum of the weights of failures.
    """

    nodes: NDArray[np.int32]
    driven_m: NDArray[np.float64]
    links: NDArray[np.int32]
    good: NDArray[np.float64]
    bad: NDArray[np.float64]


_COLUMNS = tuple(one.name for one in fields(Attempts) if one.name != "policies")


def _lacking_in_session(made: Attempts, remembered: Attempts) -> NDArray[np.intp]:
    policies = list(dict.fromkeys((*remembered.policies, *made.policies)))
    keys = np.concatenate([one._identities(policies) for one in (remembered, made)])
    _, named = np.unique(keys, axis=0, return_inverse=True)
    named = named.reshape(-1)
    known, new = named[: len(remembered)], named[len(remembered) :]
    order = np.argsort(new, kind="stable")
    ranked = new[order]
    # Number of equal attempts before each: the n-th is known if n + 1 equal ones are remembered.
    before = np.arange(len(ranked)) - np.searchsorted(ranked, ranked)
    counts = np.bincount(known, minlength=int(named.max()) + 1)
    return order[before >= counts[ranked]]


def _wrapped(angle_rad: NDArray[Any]) -> NDArray[np.float64]:
    """In (-π, π]."""
    return np.asarray(np.pi - (np.pi - angle_rad.astype(np.float64)) % (2 * np.pi))
