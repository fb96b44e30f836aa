"""An experience graph that is read by pages: no more of a map than what a robot comes near."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import InputError, MapCorruptError
from engram.geometry.cameras import CameraId
from engram.geometry.se3 import SE3
from engram.graph.basin import error_rows_of
from engram.graph.graph import (
    EDGE_KINDS,
    Column,
    EdgeRecords,
    EdgeTable,
    ExperienceGraph,
    HalfEdges,
)
from engram.graph.model import Edge, EdgeKind, Node, NodeId, SessionId

# Nodes of a page: what a search turns to next mostly lies in the same one.
PAGE = 64
# Of an edge in memory, with its covariance, and of the half edges that it has.
_EDGE_BYTES = 600
DEFAULT_BUDGET_BYTES = 48 * 2**20

# Pages that the search for one node reads at most: some 4,000 nodes around.
_FAR_PAGES = 64

EdgeKey = tuple[int, int, EdgeKind]


@dataclass(frozen=True, slots=True, eq=False)
class GraphPage:
    """The nodes with dense indices `number` · PAGE to `number` · PAGE + PAGE - 1, and their edges.

    Attributes:
        number: of the page.
        nodes: (n,) int32, dense indices of its nodes, rising.
        uuids: (n, 16) uint8, their UUIDs.
        sessions: (n,) int32, numbers of their sessions.
        cameras: n ids of their cameras.
        stamps_ns: (n,) int64.
        driven_m: (n,) float64, metres.
        ends: (E, 2) int32, dense indices of the ends of all edges at its nodes, oldest edge first.
        kinds: (E,) uint8, index into `EDGE_KINDS`.
        poses: (E, 12) float64, transforms ``a_from_b`` as in `EdgeTable`.
        covariances: (E, 6, 6) float64, m and rad, as in `EdgeTable`.
    """

    number: int
    nodes: NDArray[np.int32]
    uuids: NDArray[np.uint8]
    sessions: NDArray[np.int32]
    cameras: Sequence[CameraId]
    stamps_ns: NDArray[np.int64]
    driven_m: NDArray[np.float64]
    ends: NDArray[np.int32]
    kinds: NDArray[np.uint8]
    poses: NDArray[np.float64]
    covariances: NDArray[np.float64]

    def with_edges(self, edges: dict[EdgeKey, Edge]) -> GraphPage:
        """The page with these edges, which supersede those of the same key."""
        if not edges:
            return self
        keys = zip(*self.ends.T.tolist(), self.kinds.tolist(), strict=True)
        row_of = {(a, b, EDGE_KINDS[kind]): row for row, (a, b, kind) in enumerate(keys)}
        new = [key for key in edges if key not in row_of]
        row_of |= {key: len(self.ends) + at for at, key in enumerate(new)}
        found = replace(
            self,
            ends=np.concatenate(
                [self.ends, np.array([key[:2] for key in new], np.int32).reshape(-1, 2)]
            ),
            kinds=np.concatenate(
                [self.kinds, np.array([EDGE_KINDS.index(key[2]) for key in new], np.uint8)]
            ),
            poses=np.concatenate([self.poses, np.zeros((len(new), 12))]),
            covariances=np.concatenate([self.covariances, np.zeros((len(new), 6, 6))]),
        )
        for key, edge in edges.items():
            row = row_of[key]
            found.poses[row, :9] = edge.a_from_b.rotation.ravel()
            found.poses[row, 9:] = edge.a_from_b.translation
            found.covariances[row] = edge.covariance
        return found


class GraphPages(Protocol):
    """Where the pages of a graph come from; its answers never change."""

    @property
    def end(self) -> int:
        """No node of it has this dense index or a larger one."""
        ...

    @property
    def sessions(self) -> Sequence[SessionId]:
        """Its sessions by number."""
        ...

    def page(self, number: int) -> GraphPage:
        """The page of this number.

        Raises:
            MapCorruptError: a row of it is damaged.
        """
        ...

    def find(self, node: NodeId) -> int | None:
        """Dense index of a node; None if it is not in the graph."""
        ...

    def session_of(self, index: int) -> SessionId:
        """The session that saved a node, without reading its page.

        Raises:
            MapCorruptError: there is no such node.
        """
        ...

    def ids(self, first: int, end: int) -> Iterator[NodeId | None]:
        """The nodes from a dense index up to another one; None for one that belongs to no node."""
        ...

    def experiences(self, nodes: NDArray[np.int32]) -> NDArray[np.int32]:
        """(Y,) int32: equal for nodes, (Y,) dense indices, of one chain of odometry edges.

        Each is the dense index of a node of the chain.
        """
        ...

    def unused(self, end: int) -> Iterator[int]:
        """Dense indices below `end` that belong to no node."""
        ...

    def edges(self) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Ends (E, 2) and transforms (E, 12) of all edges, as in `GraphPage`."""
        ...

    def edges_at(self, some: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """As `edges`, ends (E, 2) and transforms (E, 12), rotation and metres, of those at nodes.

        Args:
            some: (S,) dense indices of the nodes.
        """
        ...


def _refused(name: str) -> Any:
    def asked(_graph: PagedGraph) -> Any:
        raise TypeError(f"{name}: a graph that is read by pages cannot list them; see Map.graph")

    return property(asked)


class _TooFarError(Exception):
    """A search has read as many pages as it may."""


class PagedGraph(ExperienceGraph):
    """A graph of which only some pages are in memory, and all that was added to it.

    Dense indices are those of the pages, in the order of saving; some may be unused. What is added
    follows after them, and stays in memory. Pages are read as searches and questions come to them.
    What lists the whole graph, such as `nodes`, is refused.

    Args:
        pages: what is read.
        budget_bytes: memory of pages; above it `trim` drops them.
    """

    def __init__(self, pages: GraphPages, budget_bytes: int = DEFAULT_BUDGET_BYTES) -> None:
        super().__init__()
        self._pages, self._end = pages, pages.end
        self._budget_bytes, self._needed_bytes = budget_bytes, 0
        self._left: int | None = None  # how many pages the question may still read
        self._sessions = list(pages.sessions)
        self._session_index = {one: number for number, one in enumerate(self._sessions)}
        self._node_sessions = Column(np.int32, count=self._end)
        self._driven_m = Column(np.float64, count=self._end)
        self._uuid_words = Column(np.uint64, (2,), count=self._end)
        self._first_half = Column(np.int32, count=self._end)
        self._first_half.rows.fill(_core.NOT_LOADED)
        self._loaded: dict[int, GraphPage] = {}
        self._read: dict[bytes, int] = {}
        self._records: dict[int, Node] = {}
        # Edges that were added: by the pages of their ends, and the numbers of those between nodes
        # of which at least one was added, too.
        self._added_at: defaultdict[int, dict[EdgeKey, Edge]] = defaultdict(dict)
        self._added: list[int] = []
        # Of experiences that added edges have joined: the one whose number is used for both.
        self._joined: dict[int, int] = {}
        self._halves_of_map: tuple[float, HalfEdges] | None = None

    nodes = _refused("nodes")
    edges = _refused("edges")
    experiences = _refused("experiences")

    def __len__(self) -> int:
        return self._end + len(self._nodes)

    def __contains__(self, node: NodeId) -> bool:
        return self._find(node) is not None

    def trim(self) -> None:
        """Drops the pages if they take more memory than they may.

        Not less than twice what the last search after that needed: a crowded place must not be
        read again for each frame.
        """
        taken_bytes = _EDGE_BYTES * (len(self._edges) - len(self._added))
        if not self._needed_bytes:
            self._needed_bytes = taken_bytes
        if taken_bytes > max(self._budget_bytes, 2 * self._needed_bytes):
            self._drop()
            self._needed_bytes = 0

    # -- building

    def add_edges(self, edges: Sequence[Edge]) -> None:
        """See `ExperienceGraph`."""
        ends = [(self.index(edge.a), self.index(edge.b)) for edge in edges]
        self._want(np.array(ends, np.int32).ravel())
        before = len(self._edges)
        super().add_edges(edges)
        self._added += range(before, len(self._edges))
        for (a, b), edge in zip(ends, edges, strict=True):
            for end in (a, b):
                if end < self._end:
                    self._added_at[end // PAGE][a, b, edge.kind] = edge

    def _join_experiences(self, a: int, b: int) -> None:
        one, other = self.experiences_of(np.array([a, b], np.int32)).tolist()
        if one != other:
            self._joined[max(one, other)] = min(one, other)

    # -- reading

    def index(self, node: NodeId) -> int:
        """See `ExperienceGraph`."""
        found = self._find(node)
        if found is None:
            raise InputError(f"node {node} is not in the graph")
        return found

    def is_only_of(self, session: SessionId) -> bool:
        """See `ExperienceGraph`."""
        own = self._session_index.get(session)
        pages = (self._pages.page(number) for number in range(-(-self._end // PAGE)))
        kept = all((page.sessions == own).all() for page in pages)
        return kept and all(node.session == session for node in self._nodes)

    def experiences_of(self, nodes: NDArray[np.int32]) -> NDArray[np.int32]:
        """See `ExperienceGraph`."""
        labels, kept = nodes.copy(), nodes < self._end
        if kept.any():
            labels[kept] = self._pages.experiences(nodes[kept])
        return np.array([self._label(one) for one in labels.tolist()], np.int32)

    def _label(self, experience: int) -> int:
        while (same := self._joined.get(experience)) is not None:
            experience = same
        return experience

    def node(self, index: int) -> Node:
        """See `ExperienceGraph`."""
        if index >= self._end:
            return self._nodes[index - self._end]
        known = self._records.get(index)
        if known is None:
            known = self._records[index] = self._record(index)
        return known

    def session_of(self, index: int) -> SessionId:
        """See `ExperienceGraph`; reads no page."""
        if self._first_half.rows[index] == _core.NOT_LOADED:
            return self._pages.session_of(index)
        return super().session_of(index)

    def _find(self, node: NodeId) -> int | None:
        found = self._index.get(node)
        if found is None:
            found = self._read.get(node.bytes)
        if found is None and (found := self._pages.find(node)) is not None:
            self._load_page(found // PAGE)
            found = self._read.get(node.bytes)
        return found

    def _record(self, index: int) -> Node:
        self._want(np.array([index], np.int32))
        page = self._loaded[index // PAGE]
        at = int(np.searchsorted(page.nodes, index))
        if at == len(page.nodes) or page.nodes[at] != index:
            raise MapCorruptError(
                f"node {index + 1} is missing, though others refer to it; run engram check"
            )
        return Node(
            NodeId(UUID(bytes=page.uuids[at].tobytes())),
            self._sessions[page.sessions[at]],
            int(page.stamps_ns[at]),
            page.cameras[at],
            float(page.driven_m[at]),
        )

    def half_edges(self, reach_m: float) -> HalfEdges:
        """See `ExperienceGraph`: those of the whole map, read at the first question."""
        if self._halves_of_map is None or self._halves_of_map[0] != reach_m:
            self._halves_of_map = reach_m, HalfEdges.between(*self._pages.edges(), reach_m)
        added = np.array(self._added, np.int64)
        ends = self._target.rows.reshape(-1, 2)[added, ::-1]
        return self._halves_of_map[1].and_those_of(
            HalfEdges.between(ends, self._a_from_b.rows[added], reach_m)
        )

    def half_edges_from(self, nodes: NDArray[np.int64], reach_m: float) -> HalfEdges:
        """See `ExperienceGraph`: nodes far from each other bring no pages into memory."""
        pages = nodes // PAGE
        near = (nodes >= self._end) | np.isin(pages, [*self._loaded, *self._added_at])
        found = super().half_edges_from(nodes[near], reach_m)
        if near.all():
            return found
        ends, poses = self._pages.edges_at(nodes[~near])
        more = HalfEdges.between(ends, poses, reach_m)
        return found.and_those_of(more.rows(np.isin(more.sources, nodes[~near])))

    @property
    def edge_count(self) -> int:
        """See `ExperienceGraph`; only those that were added are counted."""
        return len(self._added)

    def holds(self, index: int) -> bool:
        """See `ExperienceGraph`."""
        if not 0 <= index < self._end:
            return super().holds(index)
        self._want(np.array([index], np.int32))
        return index in self._loaded[index // PAGE].nodes

    @property
    def paged(self) -> int:
        """See `ExperienceGraph`."""
        return self._end

    def unused(self, end: int) -> Iterator[int]:
        """See `ExperienceGraph`."""
        return self._pages.unused(min(end, self._end))

    def ids(self, first: int, end: int | None = None) -> Iterator[NodeId | None]:
        """See `ExperienceGraph`."""
        end = len(self) if end is None else end
        yield from self._pages.ids(first, min(end, self._end)) if first < self._end else ()
        added = slice(max(first - self._end, 0), max(end - self._end, 0))
        yield from (node.id for node in self._nodes[added])

    def predict(self, reference: int, node: int) -> tuple[SE3, NDArray[np.float64]] | None:
        """See `ExperienceGraph`; None, too, for nodes so far apart that no pose is certain."""
        self._left = _FAR_PAGES
        try:
            return super().predict(reference, node)
        except _TooFarError:
            return None
        finally:
            self._left = None

    # -- pages

    def _want(self, nodes: NDArray[np.int32]) -> None:
        absent = nodes[self._first_half.rows[nodes] == _core.NOT_LOADED]
        if len(absent):
            self._load(absent)

    def _load(self, nodes: NDArray[np.int32]) -> None:
        for number in np.unique(nodes // PAGE).tolist():
            if self._left is not None:
                if self._left == 0:
                    raise _TooFarError
                self._left -= 1
            self._load_page(number)

    def _load_page(self, number: int) -> None:
        if number in self._loaded:
            return
        page = self._pages.page(number)
        first, end = number * PAGE, min((number + 1) * PAGE, self._end)
        self._loaded[number] = page
        self._node_sessions.rows[page.nodes] = page.sessions
        self._driven_m.rows[page.nodes] = page.driven_m
        uuids = page.uuids.tobytes()
        self._uuid_words.rows[page.nodes] = np.frombuffer(uuids, ">u8").reshape(-1, 2)
        self._read.update(
            (uuids[16 * at : 16 * at + 16], index) for at, index in enumerate(page.nodes.tolist())
        )
        self._first_half.rows[first:end] = -1
        whole = page.with_edges(self._added_at.get(number, {}))
        errors = error_rows_of(whole.poses, whole.covariances)
        self._edges.add_table(
            EdgeTable(_Records(self), whole.ends, whole.kinds, whole.poses, whole.covariances)
        )
        self._link_all(whole.ends, whole.kinds, whole.poses, errors, (first, end))

    def _drop(self) -> None:
        """Forgets all pages."""
        added = np.array(self._added, np.int64)
        ends = self._target.rows.reshape(-1, 2)[added, ::-1]
        kinds, poses = self._kinds.rows[added], self._a_from_b.rows[added]
        errors = self._errors.rows[added]
        records = [self._edges[number] for number in self._added]
        self._bound = None
        for column in (self._kinds, self._a_from_b, self._errors, self._next_half, self._target):
            column.clear()
        for number in self._loaded:
            self._first_half.rows[number * PAGE : min((number + 1) * PAGE, self._end)] = (
                _core.NOT_LOADED
            )
        self._first_half.rows[self._end :] = -1
        self._loaded.clear()
        self._read.clear()
        self._records.clear()
        self._edges = EdgeRecords()
        self._edges.extend(records)
        self._link_all(ends, kinds, poses, errors, (self._end, len(self)))
        self._added = list(range(len(added)))


class _Records(Sequence[Node]):
    """The nodes of a graph by dense index, made where they are requested."""

    def __init__(self, graph: ExperienceGraph) -> None:
        self._graph = graph

    def __len__(self) -> int:
        return len(self._graph)

    def __getitem__(self, index: Any) -> Any:
        return self._graph.node(index)
