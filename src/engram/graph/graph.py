"""The graph of a map: nodes, edges and components, also while it grows."""

from __future__ import annotations

import operator
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import InputError
from engram.geometry.se3 import SE3
from engram.graph.basin import ChainError, edge_error_rows, error_rows_of
from engram.graph.model import Edge, EdgeKind, Node, NodeId, SessionId
from engram.graph.neighbourhood import Neighbourhood, Search

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


EDGE_KINDS = tuple(EdgeKind)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeTable(Sequence[Edge]):
    """Edges between nodes of a list, each key (a, b, kind) once.

    Attributes:
        nodes: the nodes.
        ends: (E, 2) int32, places of a and b in `nodes`.
        kinds: (E,) uint8, index into `EDGE_KINDS`.
        poses: (E, 12) float64, ``a_from_b``: rotation in row-major order, then translation in m.
        covariances: (E, 6, 6) float64 of ``a_from_b``, left perturbation, m and rad.
    """

    nodes: Sequence[Node]
    ends: NDArray[np.int32]
    kinds: NDArray[np.uint8]
    poses: NDArray[np.float64]
    covariances: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ends)

    @overload
    def __getitem__(self, index: int) -> Edge: ...
    @overload
    def __getitem__(self, index: slice) -> list[Edge]: ...
    def __getitem__(self, index: int | slice) -> Edge | list[Edge]:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        a, b = self.ends[index].tolist()
        pose = self.poses[index]
        return Edge(
            self.nodes[a].id,
            self.nodes[b].id,
            EDGE_KINDS[self.kinds[index]],
            SE3(pose[:9].reshape(3, 3), pose[9:]),
            self.covariances[index],
        )


class EdgeRecords(Sequence[Edge]):
    """The edges of a graph: those of tables, made on first use and kept, and others."""

    def __init__(self) -> None:
        self._tables: list[tuple[int, EdgeTable]] = []
        self._known: list[Edge | None] = []

    def add_table(self, table: EdgeTable) -> None:
        """Adds the edges of a table."""
        self._tables.append((len(self._known), table))
        self._known += [None] * len(table)

    def append(self, edge: Edge) -> None:
        """Adds an edge."""
        self._known.append(edge)

    def extend(self, edges: Sequence[Edge]) -> None:
        """Adds edges."""
        self._known.extend(edges)

    def __len__(self) -> int:
        return len(self._known)

    def __setitem__(self, index: int, edge: Edge) -> None:
        self._known[index] = edge

    @overload
    def __getitem__(self, index: int) -> Edge: ...
    @overload
    def __getitem__(self, index: slice) -> list[Edge]: ...
    def __getitem__(self, index: int | slice) -> Edge | list[Edge]:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        known = self._known[index]
        if known is None:
            index %= len(self._known)
            first, table = self._tables[bisect_right(self._tables, index, key=_first) - 1]
            known = self._known[index] = table[index - first]
        return known


def _first(table: tuple[int, EdgeTable]) -> int:
    return table[0]


Scalar = TypeVar("Scalar", bound=np.generic)


class Column(Generic[Scalar]):
    """Rows of one shape and dtype that can be appended to.

    `rows` is a view. A view taken before an append keeps its length, and may keep showing the old
    rows after the storage has moved.
    """

    __slots__ = ("_count", "_storage")

    def __init__(
        self, dtype: type[Scalar], row_shape: tuple[int, ...] = (), *, count: int = 0
    ) -> None:
        # Zeros that nobody has written or read take no memory.
        room = 16 if count == 0 else count + 2**16
        self._storage: NDArray[Scalar] = np.zeros((room, *row_shape), dtype=dtype)
        self._count = count

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> NDArray[Scalar]:
        """All rows, (N, *row_shape)."""
        return self._storage[: self._count]

    def clear(self) -> None:
        """Removes all rows."""
        self._count = 0

    def append(self, row: Any) -> None:
        """Add one row."""
        if self._count == len(self._storage):
            grown = np.zeros((2 * self._count, *self._storage.shape[1:]), self._storage.dtype)
            grown[: self._count] = self._storage
            self._storage = grown
        self._storage[self._count] = row
        self._count += 1

    def extend(self, rows: NDArray[Scalar]) -> None:
        """Add (M, *row_shape) rows."""
        count = self._count + len(rows)
        if count > len(self._storage):
            room = max(count, 2 * len(self._storage))
            grown = np.zeros((room, *self._storage.shape[1:]), self._storage.dtype)
            grown[: self._count] = self.rows
            self._storage = grown
        self._storage[self._count : count] = rows
        self._count = count


Indices = NDArray[np.int64]


def labels_of(ends: NDArray[np.integer], count: int) -> Indices:
    """(N,) int64: the component of each node by (E, 2) ends, numbered by first node.

    Source: Shiloach and Vishkin, An O(log n) parallel connectivity algorithm, 1982. To load that of
    SciPy takes as long as a robot may take to its first step.
    """
    first = np.arange(count)
    while True:
        roots = first[ends]
        joined = roots[roots[:, 0] != roots[:, 1]]
        if not len(joined):
            return np.unique(first, return_inverse=True)[1]
        np.minimum.at(first, joined.max(axis=1), joined.min(axis=1))
        while ((further := first[first]) != first).any():
            first = further


def grouped(labels: NDArray[np.integer]) -> list[Indices]:
    """The indices of each of (N,) labels, increasing; labels in the order of their first index."""
    if not len(labels):
        return []
    order = np.argsort(labels, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    return sorted(groups, key=lambda group: int(group[0]))


# From so many edges on they are linked by arrays; a mapper adds a few at a time.
_BULK = 16
_KIND_NUMBER = {kind: number for number, kind in enumerate(EDGE_KINDS)}


@dataclass(frozen=True, slots=True, eq=False)
class ChainTree:
    """Least uncertain chains from one root to all connected nodes, a struct of arrays.

    Attributes:
        row_of: dense index of a node → its row.
        nodes: (N,) int32, dense indices, least uncertain first; the root is row 0.
        parents: (N,) int32, row of the previous node; -1 for the root.
        half_edges: (N,) int32, edge·2, plus 1 if used from b to a; -1 for the root.
        root_from_node: (N, 12) float64, rotation in row-major order, then translation in metres.
        moments: (N, 6) float64, `ChainError.moments` in the root's frame.
    """

    row_of: dict[int, int]
    nodes: NDArray[np.int32]
    parents: NDArray[np.int32]
    half_edges: NDArray[np.int32]
    root_from_node: NDArray[np.float64]
    moments: NDArray[np.float64]

    def pose(self, node: int) -> SE3:
        """``root_from_node`` of a node that the tree reaches."""
        values = self.root_from_node[self.row_of[node]]
        return SE3(values[:9].reshape(3, 3).copy(), values[9:].copy())

    def error(self, node: int) -> ChainError:
        """Error of ``root_from_node``, in the root's frame."""
        return ChainError(self.moments[self.row_of[node]])


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """Which edges a search may use.

    Attributes:
        edges: (K,) int32, ascending indices in `ExperienceGraph.edges`: always usable.
        closed: (C,) int32, ascending dense indices; other edges are usable unless they touch one
            of these nodes. None if no other edge is usable.
    """

    edges: NDArray[np.int32]
    closed: NDArray[np.int32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class HalfEdges:
    """Every edge both ways, a struct of arrays.

    Attributes:
        sources, targets: (H,) int32, dense indices.
        target_in_source: (H, 3) float64, metres: the target's camera centre in the source's frame.
    """

    sources: NDArray[np.int32]
    targets: NDArray[np.int32]
    target_in_source: NDArray[np.float64]

    @staticmethod
    def between(ends: NDArray[np.int32], poses: NDArray[np.float64], reach_m: float) -> HalfEdges:
        """Those of at most `reach_m`, of edges (E, 2) with transforms ``a_from_b`` (E, 12)."""
        b_in_a = poses[:, 9:]
        a_in_b = -np.einsum("nij,ni->nj", poses[:, :9].reshape(-1, 3, 3), b_in_a)
        short = np.linalg.norm(b_in_a, axis=1) <= reach_m
        a, b = ends[short].T
        return HalfEdges(
            np.concatenate([a, b]),
            np.concatenate([b, a]),
            np.concatenate([b_in_a[short], a_in_b[short]]),
        )

    def and_those_of(self, other: HalfEdges) -> HalfEdges:
        """These and the other half-edges."""
        return HalfEdges(
            np.concatenate([self.sources, other.sources]),
            np.concatenate([self.targets, other.targets]),
            np.concatenate([self.target_in_source, other.target_in_source]),
        )

    def rows(self, rows: NDArray[np.bool_]) -> HalfEdges:
        """The half-edges selected by an (H,) bool mask."""
        return HalfEdges(self.sources[rows], self.targets[rows], self.target_in_source[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """The lightest edge between each pair of joined nodes, a struct of arrays.

    Attributes:
        low, high: (L,) int64, dense indices of its ends, low < high.
        weight: (L,) float64, its weight.
        edge: (L,) int64, its index in `ExperienceGraph.edges`.
    """

    low: NDArray[np.int64]
    high: NDArray[np.int64]
    weight: NDArray[np.float64]
    edge: NDArray[np.int64]

    @staticmethod
    def lightest(ends: NDArray[np.integer], weight: NDArray[np.float64]) -> Links:
        """The lightest of each set of parallel edges; of equal ones the earlier.

        Args:
            ends: (E, 2) int, dense indices of each edge's ends.
            weight: (E,) float64, weight of each edge.
        """
        low, high = ends.min(axis=1), ends.max(axis=1)
        order = np.lexsort((weight, high, low))
        low, high = low[order], high[order]
        first = np.ones(len(order), np.bool_)
        first[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
        order = order[first]
        return Links(
            low[first].astype(np.int64), high[first].astype(np.int64), weight[order], order
        )

    def matrix(self, count: int, rows: NDArray[np.bool_] | slice = slice(None)) -> csr_matrix:
        """(count, count) sparse weights, each link once; only of `rows`, an (L,) bool mask."""
        from scipy.sparse import csr_matrix

        ends = (self.low[rows], self.high[rows])
        return csr_matrix((self.weight[rows], ends), shape=(count, count))


class ExperienceGraph:
    """All nodes and edges of a map; metric over short distances, topological over long ones.

    Nodes have dense indices 0, 1, 2, … in the order of adding. Edges form a forward star over
    growing arrays, and are usable in both directions; of edges with the same (a, b, kind) the last
    one added counts.

    Threads: only the thread that adds may search (localiser and mapper share it). Other threads
    may keep `Node` and `Edge` records, which never change.
    """

    def __init__(self) -> None:
        self._nodes: list[Node] = []
        self._index: dict[NodeId, int] = {}
        self._sessions: list[SessionId] = []
        self._session_index: dict[SessionId, int] = {}
        self._edges = EdgeRecords()
        self._kinds = Column(np.uint8)
        self._node_sessions = Column(np.int32)
        self._driven_m = Column(np.float64)
        self._uuid_words = Column(np.uint64, (2,))
        self._experiences = Column(np.int32)
        self._experience_sizes = Column(np.int32)
        self._first_half = Column(np.int32)
        self._next_half = Column(np.int32)
        self._target = Column(np.int32)
        self._a_from_b = Column(np.float64, (12,))
        self._errors = Column(np.float64, (8,))
        self._bound: _core.GraphArrays | None = None  # until something is added

    def __len__(self) -> int:
        return len(self._nodes)

    def __contains__(self, node: NodeId) -> bool:
        return node in self._index

    # -- building

    def add_node(self, node: Node) -> int:
        """Add a node and return its dense index; a known node keeps its index."""
        known = self._find(node.id)
        if known is not None:
            return known
        self._bound = None
        index = len(self)
        session = self._session_index.setdefault(node.session, len(self._sessions))
        if session == len(self._sessions):
            self._sessions.append(node.session)
        self._nodes.append(node)
        self._index[node.id] = index
        self._node_sessions.append(session)
        self._driven_m.append(node.driven_m)
        self._uuid_words.append((node.id.int >> 64, node.id.int & 0xFFFF_FFFF_FFFF_FFFF))
        self._experiences.append(index)
        self._experience_sizes.append(1)
        self._first_half.append(-1)
        return index

    def add_nodes(self, nodes: Sequence[Node]) -> None:
        """Add many nodes, in this order; see `add_node`."""
        index = {node.id: place for place, node in enumerate(nodes)}
        if len(self) or len(index) < len(nodes):
            for node in nodes:
                self.add_node(node)
            return
        self._bound = None
        self._nodes = list(nodes)
        self._index = index
        self._sessions = list(dict.fromkeys(node.session for node in nodes))
        self._session_index = {one: number for number, one in enumerate(self._sessions)}
        number_of = self._session_index
        self._node_sessions.extend(np.array([number_of[node.session] for node in nodes], np.int32))
        self._driven_m.extend(np.array([node.driven_m for node in nodes], np.float64))
        uuids = np.frombuffer(b"".join(node.id.bytes for node in nodes), ">u8").reshape(-1, 2)
        self._uuid_words.extend(uuids.astype(np.uint64))
        count = np.arange(len(nodes), dtype=np.int32)
        self._experiences.extend(count)
        self._experience_sizes.extend(np.ones_like(count))
        self._first_half.extend(np.full_like(count, -1))

    def add_edge(self, edge: Edge) -> None:
        """Add an edge, or supersede the one with the same (a, b, kind).

        Raises:
            InputError: an end is not in the graph, both ends are the same node, or the covariance
                is invalid.
        """
        self.add_edges([edge])

    def add_edges(self, edges: Sequence[Edge]) -> None:
        """Add many edges, in this order; see `add_edge`. If one is refused, none is added.

        A table of the nodes of a graph without edges is added without making its records.
        """
        if isinstance(edges, EdgeTable) and self._fits(edges):
            self._add_table(edges)
            return
        ends = [(self.index(edge.a), self.index(edge.b)) for edge in edges]
        for (a, b), edge in zip(ends, edges, strict=True):
            if a == b:
                raise InputError(f"an edge joins two nodes; both ends are {edge.a}")
        error_rows = edge_error_rows([(edge.a_from_b, edge.covariance) for edge in edges])
        if len(edges) >= _BULK and self._are_new(ends, edges):
            self._edges.extend(edges)
            poses = np.empty((len(edges), 12))
            poses[:, :9] = np.stack([edge.a_from_b.rotation for edge in edges]).reshape(-1, 9)
            poses[:, 9:] = np.stack([edge.a_from_b.translation for edge in edges])
            kinds = np.array([_KIND_NUMBER[edge.kind] for edge in edges], np.uint8)
            self._link_all(np.array(ends, np.int32), kinds, poses, error_rows)
            self._join_chains(np.array(ends, np.int32), kinds)
            return
        for (a, b), edge, error_row in zip(ends, edges, error_rows, strict=True):
            known = self._numbers(a, b, edge.kind) or [self._link(a, b, edge)]
            for number in known:
                self._edges[number] = edge
                self._a_from_b.rows[number, :9] = edge.a_from_b.rotation.ravel()
                self._a_from_b.rows[number, 9:] = edge.a_from_b.translation
                self._errors.rows[number] = error_row

    def _are_new(self, ends: Sequence[tuple[int, int]], edges: Sequence[Edge]) -> bool:
        """Whether none of these edges supersedes another one of them, or of the graph."""
        keys = {(a, b, edge.kind) for (a, b), edge in zip(ends, edges, strict=True)}
        known = self._edges
        return len(keys) == len(edges) and not (known and any(self._numbers(*key) for key in keys))

    def _numbers(self, a: int, b: int, kind: EdgeKind) -> list[int]:
        """The indices in `edges` of the edge of this key, as its ends have them."""
        number, found = _KIND_NUMBER[kind], []
        for source, target, side in ((a, b, 0), (b, a, 1)):
            halves = list(self._halves(source))  # this may read a page
            kinds, targets = self._kinds.rows, self._target.rows
            for half in halves:
                if half % 2 == side and targets[half] == target and kinds[half // 2] == number:
                    found.append(half // 2)
                    break
        return list(dict.fromkeys(found))

    def _halves(self, node: int) -> Iterator[int]:
        """The half edges of a node, newest key first."""
        half = int(self._first_half.rows[node])
        if half == _core.NOT_LOADED:
            self._load(np.array([node], np.int32))
            half = int(self._first_half.rows[node])
        following = self._next_half.rows
        while half >= 0:
            yield half
            half = int(following[half])

    def _link(self, a: int, b: int, edge: Edge) -> int:
        self._bound = None
        number = len(self._edges)
        self._edges.append(edge)
        self._kinds.append(_KIND_NUMBER[edge.kind])
        self._a_from_b.append(0.0)
        self._errors.append(0.0)
        for half, source, target in ((2 * number, a, b), (2 * number + 1, b, a)):
            self._next_half.append(self._first_half.rows[source])
            self._target.append(target)
            self._first_half.rows[source] = half
        if (
            edge.kind is EdgeKind.ODOMETRY
            and self._node_sessions.rows[a] == (self._node_sessions.rows[b])
        ):
            self._join_experiences(a, b)
        return number

    def _fits(self, table: EdgeTable) -> bool:
        """Whether a table's nodes are those of this graph, which has no edges yet."""
        return (
            not self._edges
            and len(table.nodes) == len(self)
            and all(map(operator.is_, table.nodes, self._nodes))
        )

    def _add_table(self, table: EdgeTable) -> None:
        selfish = np.flatnonzero(table.ends[:, 0] == table.ends[:, 1])
        if selfish.size:
            node = table.nodes[int(table.ends[selfish[0], 0])].id
            raise InputError(f"an edge joins two nodes; both ends are {node}")
        error_rows = error_rows_of(table.poses, table.covariances)
        self._edges.add_table(table)
        self._link_all(table.ends, table.kinds, table.poses, error_rows)
        self._join_chains(table.ends, table.kinds)

    def _link_all(
        self,
        ends: NDArray[np.int32],
        kinds: NDArray[np.uint8],
        poses: NDArray[np.float64],
        error_rows: NDArray[np.float64],
        within: tuple[int, int] | None = None,
    ) -> None:
        """`_link` for many edges, all of whose keys are new: a map being read.

        Args:
            ends: (E, 2), a and b.
            kinds: (E,), index into `EDGE_KINDS`.
            poses: (E, 12).
            error_rows: (E, 8).
            within: only nodes from the first index up to the second get half edges; None for all.
        """
        self._bound = None
        first = len(self._kinds)
        self._kinds.extend(kinds)
        self._a_from_b.extend(poses)
        self._errors.extend(error_rows)
        sources = ends.ravel()  # of half 2e its a, of half 2e + 1 its b
        if within is None:
            order = np.argsort(sources, kind="stable")
        else:
            inside = np.flatnonzero((sources >= within[0]) & (sources < within[1]))
            order = inside[np.argsort(sources[inside], kind="stable")]
        halves = (2 * first + order).astype(np.int32)
        new_source = np.ones(len(order), np.bool_)
        new_source[1:] = sources[order[1:]] != sources[order[:-1]]
        before = np.roll(halves, 1)
        before[new_source] = self._first_half.rows[sources[order[new_source]]]
        next_half = np.full(len(sources), -1, np.int32)
        next_half[order] = before
        self._next_half.extend(next_half)
        self._target.extend(np.ascontiguousarray(ends[:, ::-1]).ravel())
        last = np.roll(new_source, -1)
        self._first_half.rows[sources[order[last]]] = halves[last]

    def _join_chains(self, ends: NDArray[np.int32], kinds: NDArray[np.uint8]) -> None:
        """Joins the experiences at the ends of odometry edges."""
        chained = ends[kinds == _KIND_NUMBER[EdgeKind.ODOMETRY]]
        sessions = self._node_sessions.rows[chained]
        for a, b in chained[sessions[:, 0] == sessions[:, 1]].tolist():
            self._join_experiences(a, b)

    def _join_experiences(self, a: int, b: int) -> None:
        labels, sizes = self._experiences.rows, self._experience_sizes.rows
        kept, dropped = int(labels[a]), int(labels[b])
        if kept == dropped:
            return
        if sizes[kept] < sizes[dropped]:
            kept, dropped = dropped, kept
        if sizes[dropped] == 1:  # the usual case: a chain grows by a new node
            labels[dropped] = kept
        else:
            labels[labels == dropped] = kept
        sizes[kept] += sizes[dropped]
        sizes[dropped] = 0

    # -- reading

    def index(self, node: NodeId) -> int:
        """Dense index of a node.

        Raises:
            InputError: the graph does not contain it.
        """
        try:
            return self._index[node]
        except KeyError:
            raise InputError(f"node {node} is not in the graph of {len(self)} nodes") from None

    def node(self, index: int) -> Node:
        """The record of a node."""
        return self._nodes[index]

    @property
    def nodes(self) -> Sequence[Node]:
        """All nodes, by dense index. Read-only."""
        return self._nodes

    @property
    def edges(self) -> Sequence[Edge]:
        """All edges without superseded ones, oldest key first. Read-only."""
        return self._edges

    @property
    def sessions(self) -> NDArray[np.int32]:
        """(N,) int32: session number of each node (`session_number`). A view."""
        return self._node_sessions.rows

    def session_number(self, session: SessionId) -> int | None:
        """Number of a session in this graph; None if it saved no node."""
        return self._session_index.get(session)

    @property
    def session_count(self) -> int:
        """Number of sessions that saved nodes; session numbers are below it."""
        return len(self._sessions)

    def session(self, number: int) -> SessionId:
        """The session with a number."""
        return self._sessions[number]

    def session_of(self, index: int) -> SessionId:
        """The session that saved a node."""
        return self._sessions[int(self._node_sessions.rows[index])]

    @property
    def driven_m(self) -> NDArray[np.float64]:
        """(N,) float64: odometry distance of each node from its session's start, metres. A view."""
        return self._driven_m.rows

    def is_only_of(self, session: SessionId) -> bool:
        """Whether no other session saved a node."""
        return all(one == session for one in self._sessions)

    def driven_m_of(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(Y,) float64: `driven_m` of nodes, metres, by (Y,) int32 dense indices."""
        self._want(nodes)
        return self._driven_m.rows.take(nodes)

    def experiences_of(self, nodes: NDArray[np.int32]) -> NDArray[np.int32]:
        """(Y,) int32: `experiences` of nodes, given by (Y,) int32 dense indices."""
        return self._experiences.rows.take(nodes)

    def sessions_of(self, nodes: NDArray[np.int32]) -> NDArray[np.int32]:
        """(Y,) int32: the session numbers of nodes, given by (Y,) int32 dense indices."""
        self._want(nodes)
        return self._node_sessions.rows.take(nodes)

    def uuid_words_of(self, nodes: NDArray[np.int32]) -> NDArray[np.uint64]:
        """(Y, 2) uint64: UUIDs of nodes, given by (Y,) int32 dense indices; high word first."""
        self._want(nodes)
        return self._uuid_words.rows.take(nodes, 0)

    @property
    def experiences(self) -> NDArray[np.int32]:
        """(N,) int32: equal for the nodes of one experience, a chain of odometry edges. A view.

        The number is the dense index of one of its nodes; it may change when chains are joined.
        """
        return self._experiences.rows

    def edge(self, number: int) -> Edge:
        """The edge with a number, such as a search gives; it may change between two frames."""
        return self._edges[number]

    def find_edge(self, a: NodeId, b: NodeId, kind: EdgeKind) -> Edge | None:
        """The edge of this key; None if there is none, or an end is not in the graph."""
        if a not in self or b not in self:
            return None
        numbers = self._numbers(self.index(a), self.index(b), kind)
        return self._edges[numbers[0]] if numbers else None

    def components(self) -> NDArray[np.int32]:
        """(N,) int32: the connected component of each node, numbered from 0 by first node."""
        return labels_of(self.edge_ends, len(self)).astype(np.int32)

    @property
    def edge_ends(self) -> NDArray[np.int32]:
        """(E, 2) int32: dense indices of the ends b and a of each edge in `edges`. A view."""
        return self._target.rows.reshape(-1, 2)

    @property
    def edge_errors(self) -> NDArray[np.float64]:
        """(E, 8) float64: errors of `edges`, m and rad as of `edge_error_rows`. A view."""
        return self._errors.rows

    def lightest(self, weight: Callable[[Edge], float]) -> Links:
        """The lightest of each set of parallel edges; of equal ones the earlier."""
        weights = np.array([weight(edge) for edge in self._edges], np.float64)
        return Links.lightest(self.edge_ends, weights)

    def edges_of(self, node: int, kind: EdgeKind | None = None) -> list[Edge]:
        """The edges at a node, newest key first; of one kind, if it is given."""
        edges = [half // 2 for half in self._halves(node)]
        if kind is not None:
            edges = [one for one in edges if self._kinds.rows[one] == _KIND_NUMBER[kind]]
        return [self._edges[one] for one in edges]

    def numbered_edges_of(self, node: int) -> list[tuple[Edge, int]]:
        """The edges at a node, newest key first, each with its index in `edges`."""
        return [(self._edges[half // 2], half // 2) for half in self._halves(node)]

    # -- searching

    def half_edges(self, reach_m: float) -> HalfEdges:
        """All edges both ways, between nodes at most `reach_m` apart."""
        return HalfEdges.between(self.edge_ends[:, ::-1], self._a_from_b.rows, reach_m)

    def half_edges_from(self, nodes: NDArray[np.int64], reach_m: float) -> HalfEdges:
        """As `half_edges`, from some nodes, (S,) int64 dense indices, alone."""
        self._want(nodes.astype(np.int32))
        halves = np.array(
            [half for node in nodes.tolist() for half in self._halves(node)], np.int64
        )
        numbers = np.unique(halves // 2)
        ends = self._target.rows.reshape(-1, 2)[numbers, ::-1]
        found = HalfEdges.between(ends, self._a_from_b.rows[numbers], reach_m)
        return found.rows(np.isin(found.sources, nodes))

    @property
    def edge_count(self) -> int:
        """Number of edges: it shows whether `half_edges` would find others than before."""
        return len(self._edges)

    def neighbourhood(
        self,
        reference: int,
        reference_from_live: SE3,
        covariance: NDArray[np.float64],
        search: Search,
    ) -> Neighbourhood:
        """The candidates Y near the live camera (method §3.1).

        The search follows edges from the reference, least uncertain chain first, through every node
        within `margin_m` beyond the radius (or beyond the reference, if that is farther).
        Breadth-first search ([G16] §III-A) takes the chain with the fewest edges; if a few
        uncertain proximity edges compete with many certain odometry edges, its predictions are as
        bad as the worst edge.

        Certain chains end at the reach; an uncertain one, through a gap of odometry, may wrongly
        lead back into it. For nodes reached by an uncertain chain the search looks for a better
        one that may go `detour_m` farther out.

        Args:
            reference: dense index of the node that the position refers to.
            reference_from_live: pose of the live camera in that node.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation, rotation].
            search: radius and gates.
        """
        question = (
            reference,
            _pose_row(reference_from_live),
            _core.pivoted_error(np.ascontiguousarray(covariance)),
            self._limits(search),
        )
        while True:
            columns, absent = _core.graph_candidates(self._arrays(), *question)
            if columns is not None:
                return Neighbourhood(*columns)
            assert absent is not None
            self._load(absent)

    def _limits(self, search: Search) -> _core.CandidateLimits:
        limits, config = _core.CandidateLimits(), search.config
        limits.radius_m, limits.view_gate_rad = search.radius_m, search.view_gate_rad
        limits.margin_m, limits.slack_m = config.margin_m, config.slack_m
        limits.slack_sigmas = config.slack_sigmas
        limits.vague_m, limits.detour_m = config.vague_m, config.detour_m
        if search.own_session is not None:
            limits.own_session = self._session_index.get(search.own_session, -1)
        limits.own_driven_m = search.own_driven_m
        limits.own_exclusion_m = search.own_exclusion_m
        return limits

    def chains_from(
        self, root: int, *, goals: Sequence[int] = (), passage: Passage | None = None
    ) -> ChainTree:
        """Least uncertain chains from a node to all others, or until all goals are reached.

        Args:
            root: dense index.
            goals: dense indices of the nodes to reach; empty for all nodes.
            passage: which edges to use; None for all.
        """
        lists = () if passage is None else (passage.edges, passage.closed)
        while True:
            columns, absent = _core.graph_chains(
                self._arrays(), root, np.array(goals, np.int32), *lists
            )
            if columns is not None:
                row_of = {int(node): row for row, node in enumerate(columns[0])}
                return ChainTree(row_of, *columns)
            assert absent is not None
            self._load(absent)

    def predict(self, reference: int, node: int) -> tuple[SE3, NDArray[np.float64]] | None:
        """``reference_from_node`` and its (6, 6) covariance along the least uncertain chain.

        None if the two are not connected.
        """
        tree = self.chains_from(reference, goals=[node])
        if node not in tree.row_of:
            return None
        pose = tree.pose(node)
        return pose, tree.error(node).pivoted(pose.translation).covariance()

    # -- what a graph that is read by pages does besides (`engram.graph.pages`)

    def holds(self, index: int) -> bool:
        """Whether a dense index below the length belongs to a node."""
        return 0 <= index < len(self)

    @property
    def paged(self) -> int:
        """Number of dense indices that are keys of a map, less one; what follows was added."""
        return 0

    def unused(self, end: int) -> Iterator[int]:
        """Dense indices below `end` and `paged` that belong to no node."""
        del end  # every one belongs to a node
        return iter(())

    def ids(self, first: int, end: int | None = None) -> Iterator[NodeId | None]:
        """The nodes from a dense index up to another one; None for one that belongs to no node.

        Any thread may ask.
        """
        return (node.id for node in self._nodes[first:end])

    def trim(self) -> None:
        """Gives back memory; only between two frames."""

    def _find(self, node: NodeId) -> int | None:
        """Dense index of a node; None if it is not in the graph."""
        return self._index.get(node)

    def _want(self, nodes: NDArray[np.int32]) -> None:
        """Brings nodes into memory."""

    def _load(self, nodes: NDArray[np.int32]) -> None:
        raise AssertionError(f"{nodes} are not in memory")

    def _arrays(self) -> _core.GraphArrays:
        if self._bound is None:
            self._bound = _core.GraphArrays(
                self._first_half.rows,
                self._next_half.rows,
                self._target.rows,
                self._a_from_b.rows,
                self._errors.rows,
                self._node_sessions.rows,
                self._driven_m.rows,
            )
        return self._bound


def _pose_row(transform: SE3) -> NDArray[np.float64]:
    """(12,) float64: rotation in row-major order, then translation."""
    return np.concatenate([transform.rotation.ravel(), transform.translation])
