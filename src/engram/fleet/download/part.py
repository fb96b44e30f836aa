"""The records of a fleet map, and which of them go along with the chosen nodes.

Edges across omitted nodes, so that a download stays as connected as the fleet map (method §7).
Every omitted node belongs to the basin of the sent node that reaches it along the chain of least
variance. If two basins touch, the chain between their two sent nodes is a candidate. A spanning
tree of candidates closes every gap. Short candidates are sent as well: two experiences that were
tied every few metres through a third one stay tied every few metres.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.surroundings import Surroundings
from engram.geometry.cameras import CameraId, StereoCamera
from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.clock import hour_of_day, zone_note
from engram.graph.graph import EDGE_KINDS, EdgeTable, ExperienceGraph, Links, labels_of
from engram.graph.model import (
    Amendment,
    Edge,
    EdgeKind,
    Goal,
    Mark,
    Node,
    NodeId,
    Omission,
    PathEntry,
    PathId,
    Placement,
    Session,
    SessionId,
    path_id,
)
from engram.graph.pages import PAGE, GraphPage
from engram.graph.paths import Attempts
from engram.maps.map import Map
from engram.maps.map_frame import ORIGIN
from engram.maps.records import StoredNode
from engram.maps.writer import RevisionWriter
from engram.monitor import Monitor
from engram.places.words import NodeWords, words_of
from engram.robot.anchors import had_goal

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LISTED = 3


class Stock:
    """A fleet map as of one revision, for selections: all of it, or what lies around a mission.

    Args:
        store: the fleet map.
        options: the mission; around its route or region the map is read. None for all of it.
        here: what is read instead, where there is no mission.

    Attributes:
        sessions: that saved, passed or attempted a node of it, in the order of their starts, then
            UUIDs; of the whole map all.
        nodes: by session, then stamp, then UUID.
        node_ids: their UUIDs.
        index: place of each node in `nodes`.
        indices: (N,) int64, their dense indices in the fleet map.
        area: (N,) bool, the nodes of the mission's route or region; all without one.
        seeds: number of nodes that the area was searched from.
        edges: by their ends and kind.
        graph: of these nodes and edges; dense indices are places in `nodes`.
        entries: path entries by path and sequence.
        on_path: (n,) int64 for each path: places of its nodes in order, once per visit.
        attempts: remembered attempts; sessions and nodes are places in `sessions` and `nodes`.
        session_of: (N,) int64, place of each node's session.
        whole: whether it is the whole map.
    """

    def __init__(
        self,
        store: Map,
        options: DownloadOptions | None = None,
        here: Surroundings | None = None,
    ) -> None:
        self.store, self.seeds = store, 0
        seeds = None if options is None else _seeds(store, options)
        if options is not None and seeds is not None:
            runs = store.lookups.runs()
            here = Surroundings.of(store.pages, runs, np.unique(seeds), options.radius_m)
            self.seeds = len(seeds)
        here = here or Surroundings.everything(store.pages)
        self.whole = here.whole
        ranked = sorted(store.sessions.values(), key=lambda session: (session.start_ns, session.id))
        found, order = here.found, self._read_nodes(here.found, ranked)
        self.area: Mask = here.inside[order]
        self._read_edges(found, order)
        self.indices: NDArray[np.int64] = found.nodes[order].astype(np.int64)
        self._read_entries(dict(zip(self.indices.tolist(), self.node_ids, strict=True)))
        made = store.pages.attempts(np.sort(self.indices))
        ids = [store.pages.sessions[at] for at in np.unique(made.session).tolist()]
        used = {node.session for node in self.nodes}.union(ids)
        self.sessions: list[Session] = [
            session
            for session in ranked
            if self.whole or session.id in used or path_id(session.id) in self.on_path
        ]
        place = {session.id: at for at, session in enumerate(self.sessions)}
        self.session_of: NDArray[np.int64] = np.array(
            [place[node.session] for node in self.nodes], np.int64
        )
        self.attempts = self._placed(made, place)

    def _read_nodes(self, found: GraphPage, ranked: Sequence[Session]) -> NDArray[np.intp]:
        """Makes the nodes; returns their rows in `found`."""
        rank = {session.id: at for at, session in enumerate(ranked)}
        sessions = self.store.pages.sessions
        uuids = found.uuids.tobytes()
        records = [
            Node(
                NodeId(UUID(bytes=uuids[16 * at : 16 * at + 16])),
                sessions[session],
                stamp_ns,
                found.cameras[at],
                driven_m,
            )
            for at, (session, stamp_ns, driven_m) in enumerate(
                zip(
                    *(one.tolist() for one in (found.sessions, found.stamps_ns, found.driven_m)),
                    strict=True,
                )
            )
        ]
        order = sorted(
            range(len(records)),
            key=lambda at: (rank[records[at].session], records[at].stamp_ns, records[at].id),
        )
        self.nodes: list[Node] = [records[at] for at in order]
        self.node_ids: list[NodeId] = [node.id for node in self.nodes]
        self.index = {node: at for at, node in enumerate(self.node_ids)}
        return np.array(order, np.intp)

    def _read_edges(self, found: GraphPage, order: NDArray[np.intp]) -> None:
        place = np.empty(len(order), np.int32)
        place[order] = np.arange(len(order))
        ends = place[np.searchsorted(found.nodes, found.ends)]
        by_uuid = np.empty(len(order), np.int64)
        by_uuid[sorted(range(len(order)), key=self.node_ids.__getitem__)] = np.arange(len(order))
        kind_rank = np.argsort(np.argsort([str(kind) for kind in EDGE_KINDS]))
        rows = np.lexsort((kind_rank[found.kinds], by_uuid[ends[:, 1]], by_uuid[ends[:, 0]]))
        self.graph = ExperienceGraph()
        self.graph.add_nodes(self.nodes)
        self.graph.add_edges(
            EdgeTable(
                self.nodes,
                ends[rows],
                found.kinds[rows],
                found.poses[rows],
                found.covariances[rows],
            )
        )
        self.edges = self.graph.edges

    def _read_entries(self, ids: dict[int, NodeId]) -> None:
        """Reads path entries at nodes, given by their dense indices in the map."""
        pages = self.store.pages
        ranges = [(0, pages.end)]
        if not self.whole:
            numbers = sorted({index // PAGE for index in ids})
            ranges = [(number * PAGE, (number + 1) * PAGE) for number in numbers]
        read = (entry for begin, end in ranges for entry in pages.entries(begin, end, ids))
        self.entries: list[PathEntry] = sorted(read, key=lambda one: (one.path, one.sequence))
        visited: dict[PathId, list[int]] = {}
        for entry in self.entries:
            visited.setdefault(entry.path, []).append(self.index[entry.node])
        self.on_path: dict[PathId, NDArray[np.int64]] = {
            path: np.array(nodes, np.int64) for path, nodes in visited.items()
        }

    def _placed(self, made: Attempts, place: Mapping[SessionId, int]) -> Attempts:
        """Attempts whose sessions and nodes are numbered as in the map."""
        keys = self.indices
        sessions = [place.get(session, -1) for session in self.store.pages.sessions]
        order = np.argsort(keys)
        attempts = replace(
            made,
            session=np.array(sessions, np.int32)[made.session],
            reference=order[np.searchsorted(keys[order], made.reference)].astype(np.int32),
            node=order[np.searchsorted(keys[order], made.node)].astype(np.int32),
        )
        return attempts.rows(np.argsort(attempts.session, kind="stable"))

    def __len__(self) -> int:
        return len(self.nodes)

    def everything(self) -> Mask:
        """(N,) bool, all True: every node."""
        return np.ones(len(self), np.bool_)

    @cached_property
    def content_hash(self) -> str:
        """Content hash of the fleet map at this revision."""
        return self.store.content_hash()

    @cached_property
    def cameras(self) -> dict[CameraId, StereoCamera]:
        """Cameras of the sessions and nodes, by id."""
        used = {one.camera for one in self.sessions} | {one.camera for one in self.nodes}
        return {camera: one for camera, one in self.store.cameras.items() if camera in used}

    @cached_property
    def words(self) -> NodeWords | None:
        """Words of the nodes; None while the fleet map is empty."""
        kind = self.store.descriptor
        return None if kind is None else words_of(self.store, kind)

    @cached_property
    def hours(self) -> Array:
        """(N,) hour of day of each node (method §2.8), NaN if unknown."""
        by_id = {session.id: session for session in self.sessions}
        known = (hour_of_day(by_id[node.session], node.stamp_ns) for node in self.nodes)
        return np.array([np.nan if hour is None else hour for hour in known], np.float64)

    def known_hours(self) -> Array:
        """`hours` (N,), at least one of which is known."""
        if not np.isfinite(self.hours).any():
            without = [
                session
                for session in self.sessions
                if hour_of_day(session, session.start_ns) is None
            ]
            listed = ", ".join(
                f"{session.robot} {str(session.id)[:8]}" for session in without[:_LISTED]
            )
            raise InputError(
                f"{_zones_told(without)}no node of {self.store.location} has a known hour of day: "
                f"{len(without)} of {len(self.sessions)} sessions ({listed}…) have no UTC clock or "
                "neither longitude nor time zone; set it with engram amend, or choose --select "
                "copy, region or route"
            )
        return self.hours

    @cached_property
    def partial_paths(self) -> frozenset[PathId]:
        """Paths of which some entries are elsewhere: in the map around, or nowhere in it."""
        counts = {} if self.whole else self.store.lookups.entry_counts(list(self.on_path))
        outside = {path for path, count in counts.items() if count > len(self.on_path[path])}
        return frozenset(outside | self.store.partial_paths)

    @cached_property
    def sizes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(N,) bytes of the landmarks of each node, and (N,) of its thumbnail."""
        sizes = self.store.lookups.blob_sizes(self.node_ids)
        return sizes[:, 0], sizes[:, 1]


def _seeds(store: Map, options: DownloadOptions) -> NDArray[np.int64] | None:
    """Dense indices of the nodes around which a mission's area lies; None without an area."""
    if options.route is not None:
        session = store.named_session(options.route)
        passed = {entry.node for entry in store.lookups.entries(path_id(session.id))}
        if not passed:
            raise InputError(f"session {session.id} of {session.robot} has no node on its path")
        return np.array([one.key - 1 for one in store.lookups.nodes(passed).values()], np.int64)
    if options.near:
        return np.array([_named_node(store, prefix) for prefix in options.near], np.int64)
    return None


def _named_node(store: Map, prefix: str) -> int:
    """Dense index of the one node whose UUID begins with `prefix`."""
    origin = store.origin(prefix)
    held = store.lookups.nodes([origin.node])
    if not held:
        raise InputError(f"node {origin.node} was reverted in revision {origin.told[-1][0]}")
    return held[origin.node].key - 1


def _zones_told(sessions: Sequence[Session]) -> str:
    """Why the hours of these sessions are unknown although they have zones."""
    notes = {note: None for session in sessions if (note := zone_note(session))}
    return "".join(f"{note}; " for note in notes)


# Beyond the reach of a neighbourhood search (`SearchConfig.margin_m`), a bridge shortens nothing.
_NEAR_M = 12.0
# Metres per radian in the cost of a chain: the usual distance of a landmark.
_LEVER_M = 10.0
# Chains of perfectly known edges still prefer fewer edges.
_LEAST_COST = 1e-12


def close_gaps(
    nodes: Sequence[NodeId], edges: Sequence[Edge], sent: NDArray[np.bool_]
) -> list[Edge]:
    """Bridges between sent nodes, composed through omitted nodes.

    Args:
        sent: (N,) bool, which nodes are sent.

    Returns:
        Edges of kind `bridge`, with summed covariances, ordered by their ends. With them the sent
        nodes are in as many components as they are in the whole graph.
    """
    if sent.all() or not sent.any():
        return []
    index = {node: at for at, node in enumerate(nodes)}
    ends = np.array([(index[edge.a], index[edge.b]) for edge in edges], np.int64).reshape(-1, 2)
    # Of several edges between two nodes, the one of least variance.
    steps = Links.lightest(ends, np.array([_variance(edge.covariance) for edge in edges]))
    search = _Search(nodes, edges, ends, steps, sent)
    needed, near = search.candidates()
    chosen = {pair: search.bridge(*pair) for pair in needed}
    for pair in near:
        bridge = chosen.get(pair) or search.bridge(*pair)
        if bridge.a_from_b.distance_m <= _NEAR_M:
            chosen[pair] = bridge
    return [chosen[pair] for pair in sorted(chosen)]


def _variance(covariance: Array) -> float:
    diagonal = np.diag(covariance)
    return max(float(diagonal[:3].sum() + _LEVER_M**2 * diagonal[3:].sum()), _LEAST_COST)


class _Search:
    """Chains from sent nodes outwards through omitted nodes."""

    def __init__(
        self,
        nodes: Sequence[NodeId],
        edges: Sequence[Edge],
        ends: NDArray[np.int64],
        steps: Links,
        sent: NDArray[np.bool_],
    ) -> None:
        self._nodes, self._edges, self._ends, self._steps = nodes, edges, ends, steps
        self._sent = sent
        # Edges between two sent nodes are sent themselves.
        self._through = ~(sent[steps.low] & sent[steps.high])
        inner = sent[ends].all(axis=1)
        self._joined = labels_of(ends[inner], len(nodes))
        odometry = np.array([edge.kind is EdgeKind.ODOMETRY for edge in edges], np.bool_)
        self._pieces = labels_of(ends[inner & odometry], len(nodes))
        self._edge_of = {
            (int(low), int(high)): int(edge)
            for low, high, edge in zip(steps.low, steps.high, steps.edge, strict=True)
        }
        self._reach()

    def _reach(self) -> None:
        """The chain of least variance from any sent node to each omitted node."""
        from scipy.sparse.csgraph import dijkstra

        steps, through = self._steps, self._through
        links = steps.matrix(len(self._nodes), through)
        self._cost, self._before, self._source = dijkstra(
            links,
            directed=False,
            indices=np.flatnonzero(self._sent),
            min_only=True,
            return_predecessors=True,
        )

    def candidates(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Pairs of sent nodes that a bridge may join.

        Returns:
            A spanning tree over the gaps; and for each node the pair of least variance to every
            other piece of an experience.
        """
        steps, through = self._steps, self._through
        self._border: dict[tuple[int, int], tuple[float, int]] = {}
        for at in np.flatnonzero(through):
            low, high = int(steps.low[at]), int(steps.high[at])
            sources = int(self._source[low]), int(self._source[high])
            if min(sources) < 0 or sources[0] == sources[1]:  # unreached, or inside one basin
                continue
            cost = float(self._cost[low] + steps.weight[at] + self._cost[high])
            pair = (min(sources), max(sources))
            if pair not in self._border or cost < self._border[pair][0]:
                self._border[pair] = (cost, int(at))
        ordered = sorted(self._border, key=lambda pair: (self._border[pair][0], pair))
        return self._spanning(ordered), self._nearest(ordered)

    def _spanning(self, ordered: list[tuple[int, int]]) -> list[tuple[int, int]]:
        from scipy.cluster.hierarchy import DisjointSet

        label = self._joined.tolist()
        joined = DisjointSet(label)
        return [(a, b) for a, b in ordered if joined.merge(label[a], label[b])]

    def _nearest(self, ordered: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Candidates of least variance from either end to the other's piece."""
        taken: dict[int, set[int]] = defaultdict(set)
        kept = []
        for a, b in ordered:
            pieces = int(self._pieces[a]), int(self._pieces[b])
            if pieces[0] == pieces[1]:
                continue
            if pieces[1] not in taken[a] or pieces[0] not in taken[b]:
                kept.append((a, b))
            taken[a].add(pieces[1])
            taken[b].add(pieces[0])
        return kept

    def bridge(self, a: int, b: int) -> Edge:
        """The chain between two sent nodes as one edge."""
        _, at = self._border[a, b]
        ends = [int(self._steps.low[at]), int(self._steps.high[at])]
        if int(self._source[ends[0]]) != a:
            ends.reverse()
        chain = [*reversed(self._back(ends[0])), *self._back(ends[1])]
        a_from_end, covariance = SE3.identity(), np.zeros((6, 6))
        for near, far in pairwise(chain):
            near_from_far, step = self._step(near, far)
            covariance = propagate_covariance(a_from_end, covariance, step)
            a_from_end = a_from_end @ near_from_far
        covariance = (covariance + covariance.T) / 2
        return Edge(self._nodes[a], self._nodes[b], EdgeKind.BRIDGE, a_from_end, covariance)

    def _back(self, node: int) -> list[int]:
        """From a node to the sent node whose basin it is in."""
        chain = [node]
        while not self._sent[chain[-1]]:
            chain.append(int(self._before[chain[-1]]))
        return chain

    def _step(self, near: int, far: int) -> tuple[SE3, Array]:
        """``near_from_far`` and its covariance."""
        at = self._edge_of[min(near, far), max(near, far)]
        edge = self._edges[at]
        if int(self._ends[at, 0]) == near:
            return edge.a_from_b, edge.covariance
        b_from_a = edge.a_from_b.inverse()
        adjoint = b_from_a.adjoint()
        return b_from_a, adjoint @ edge.covariance @ adjoint.T


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A part of a fleet map, complete in itself.

    Attributes:
        sent: (N,) bool, which of its nodes go along.
        whole: whether omissions go along, as they do with a copy of everything.
        refused: sessions and omitted nodes that do not go along.
    """

    stock: Stock
    sent: Mask
    bridges: list[Edge]
    whole: bool
    thumbnails: bool
    refused: frozenset[UUID] = frozenset()

    @staticmethod
    def of(stock: Stock, sent: Mask, *, whole: bool, thumbnails: bool) -> Part:
        """The part with these nodes; its gaps are closed (`close_gaps`)."""
        bridges = close_gaps(stock.node_ids, stock.edges, sent)
        return Part(stock, sent, bridges, whole, thumbnails)

    def without(self, refused: frozenset[UUID]) -> Part:
        """The part without some sessions and nodes, and without what is theirs."""
        if not refused:
            return self
        kept = [not refused.intersection((node.id, node.session)) for node in self.stock.nodes]
        sent = self.sent & np.array(kept, np.bool_)
        bridges = close_gaps(self.stock.node_ids, self.stock.edges, sent)
        return replace(self, sent=sent, bridges=bridges, refused=refused)

    def __len__(self) -> int:
        return int(self.sent.sum())

    @property
    def node_ids(self) -> list[NodeId]:
        """UUIDs of the nodes, in the order of the stock."""
        return [self.stock.node_ids[at] for at in np.flatnonzero(self.sent)]

    @property
    def sessions(self) -> list[Session]:
        """Sessions that saved, passed or attempted a sent node; all of a whole map."""
        wanted = self._sessions_wanted()
        return [session for at, session in enumerate(self.stock.sessions) if wanted[at]]

    @property
    def amendments(self) -> list[Amendment]:
        """Amendments of the sessions."""
        sent = {session.id for session in self.sessions}
        return [amendment for amendment in self.stock.store.amendments if amendment.session in sent]

    def stored(self, lacking: Mask | None = None) -> Iterator[StoredNode]:
        """The nodes with their blobs.

        Args:
            lacking: (N,) bool, which of them are wanted; None for all.
        """
        wanted = self.sent if lacking is None else self.sent & lacking
        nodes = [self.stock.nodes[at] for at in np.flatnonzero(wanted)]
        for stored in self.stock.store.frames.stored(nodes):
            yield stored if self.thumbnails else replace(stored, thumbnail=None)

    def edges(self) -> Iterator[Edge]:
        """Edges between sent nodes, then bridges."""
        index, sent = self.stock.index, self.sent
        yield from (
            edge for edge in self.stock.edges if sent[index[edge.a]] and sent[index[edge.b]]
        )
        yield from self.bridges

    def entries(self) -> Iterator[PathEntry]:
        """Path entries at sent nodes, by path and sequence."""
        index, sent = self.stock.index, self.sent
        refused = {path_id(one.id) for one in self.stock.sessions if one.id in self.refused}
        return (
            entry
            for entry in self.stock.entries
            if sent[index[entry.node]] and entry.path not in refused
        )

    def omissions(self) -> list[Omission]:
        """Omissions that go along, by the UUID of the omitted node."""
        return (
            [
                omission
                for omitted, omission in sorted(self.stock.store.omissions.items())
                if omitted not in self.refused and self.sent[self.stock.index[omission.node]]
            ]
            if self.whole
            else []
        )

    def partial_paths(self) -> set[PathId]:
        """Paths of the sessions of which some entries are left out, now or earlier."""
        on_path = self.stock.on_path
        left = {path for path, nodes in on_path.items() if not self.sent[nodes].all()}
        return (left | self.stock.partial_paths) & {path_id(one.id) for one in self.sessions}

    def attempt_rows(self) -> NDArray[np.intp]:
        """(A,) intp: rows of the stock's attempts whose two nodes are sent."""
        made = self.stock.attempts
        return np.flatnonzero(
            self.sent[made.reference] & self.sent[made.node] & ~self._refused[made.session]
        )

    def add_session(self, writer: RevisionWriter, session: Session, partial: set[PathId]) -> bool:
        """Writes a session; returns whether it was new.

        Args:
            session: one of `sessions`.
            partial: `partial_paths`.
        """
        descriptor, frontend = self.stock.store.frontends[session.id]
        return writer.add_session(
            session,
            self.stock.cameras[session.camera],
            descriptor=descriptor,
            frontend=frontend,
            partial=path_id(session.id) in partial,
        )

    def write(self, writer: RevisionWriter, monitor: Monitor) -> None:
        """Writes all records into an empty map, owners first."""
        partial = self.partial_paths()
        for session in self.sessions:
            self.add_session(writer, session, partial)
        for amendment in self.amendments:
            writer.add_amendment(amendment)
        for stored in self.stored():
            writer.copy_node(stored)
            monitor.advance()
        for edge in self.edges():
            writer.add_edge(edge)
        for entry in self.entries():
            writer.add_path_entry(entry)
        self.write_attempts(writer, self.attempt_rows())
        for omission in self.omissions():
            writer.add_omission(omission)
        writer.add_forgotten(self.stock.store.forgotten)
        if self.stock.store.vocabulary is not None:
            writer.put_vocabulary(self.stock.store.vocabulary)

    def write_attempts(self, writer: RevisionWriter, rows: NDArray[np.intp]) -> None:
        """Writes rows, (A,) intp, of the stock's attempts, session by session."""
        kept = self.stock.attempts.rows(rows)
        for at, session in enumerate(self.stock.sessions):
            own = np.flatnonzero(kept.session == at)
            if len(own):
                writer.copy_attempts(session.id, kept.rows(own), self.stock.node_ids)

    @property
    def _refused(self) -> Mask:
        """(S,) bool, which sessions do not go along."""
        return np.array([one.id in self.refused for one in self.stock.sessions], np.bool_)

    def _sessions_wanted(self) -> Mask:
        stock = self.stock
        if self.stock.whole and self.sent.all():
            return ~self._refused
        wanted = np.zeros(len(stock.sessions), np.bool_)
        wanted[stock.session_of[self.sent]] = True
        wanted[stock.attempts.session[self.attempt_rows()]] = True
        for at, session in enumerate(stock.sessions):
            nodes = stock.on_path.get(path_id(session.id))
            if nodes is not None and self.sent[nodes].any():
                wanted[at] = True
        return wanted & ~self._refused


# The robot's map speaks of the fleet's frame if the nodes of both lie as near as this, metres.
_SAME_FRAME_M = 0.01


def write_marks(writer: RevisionWriter, part: Part) -> None:
    """Writes the marks of a part into an empty map, after its nodes.

    Nodes keep their place in the map frame, so a robot and its fleet speak of the same frame. A
    goal whose node is not sent moves to the nearest one that is.
    """
    store = part.stock.store
    sent, placed = set(part.node_ids), store.lookups.placements(part.node_ids)
    for removal in store.removals:
        if {removal.a, removal.b} <= sent:
            writer.add_mark(removal)
    for node in part.node_ids:
        if node in placed:
            writer.add_mark(Placement(node, placed[node]))
    for anchor in store.anchors:
        if anchor.node in sent:
            writer.add_mark(anchor)
    origin = store.statistics().get(ORIGIN)
    if origin is not None:
        writer.put_statistic(ORIGIN, origin)
    for goal in _goals(part):
        writer.add_mark(goal)


def lacking_marks(part: Part, own: Map) -> list[Mark]:
    """The marks of a part that are new to a robot's map; of places those of nodes new to it."""
    store, sent = part.stock.store, set(part.node_ids)
    lacking: list[Mark] = [
        removal
        for removal in store.removals
        if {removal.a, removal.b} <= sent and removal.key not in own.seen_removals
    ]
    lacking += [
        goal
        for goal in _goals(part)
        if goal.name not in own.goals and not had_goal(own.seen_goals, own.graph, goal)
    ]
    placed = store.lookups.placements({*own.placements, *part.node_ids})
    if _one_frame(own.placements, placed):
        lacking += [
            Placement(node, placed[node])
            for node in part.node_ids
            if node in placed and node not in own.placements
        ]
    return lacking


def _one_frame(own: Mapping[NodeId, SE3], fleet: Mapping[NodeId, SE3]) -> bool:
    shared = [node for node in own if node in fleet]
    apart = (own[node].inverse() @ fleet[node] for node in shared)
    return bool(shared) and all(offset.distance_m <= _SAME_FRAME_M for offset in apart)


def _goals(part: Part) -> Iterator[Goal]:
    """The goals, each in a sent node; without those that none is connected with."""
    store, sent = part.stock.store, set(part.node_ids)
    left = [goal for goal in store.goals.values() if goal.node not in sent]
    moved = {} if not left else _moved(store, left, part.node_ids)
    for name, goal in sorted(store.goals.items()):
        if goal.node in sent:
            yield goal
        elif name in moved:
            yield moved[name]


def _moved(store: Map, goals: Sequence[Goal], sent: Sequence[NodeId]) -> dict[str, Goal]:
    """Goals in the nearest of some nodes, by the map frame; without those not connected."""
    lookups, runs = store.lookups, store.lookups.runs()
    known = [*sent, *(goal.node for goal in goals)]
    held, placed = lookups.nodes(known), lookups.placements(known)
    component = {
        node: int(runs.component[runs.find(np.array([one.key]))[0]]) for node, one in held.items()
    }
    found = {}
    for goal in goals:
        near = [node for node in sent if component[node] == component[goal.node] and node in placed]
        if near and goal.node in placed:
            at_m = np.array([placed[node].translation for node in near])
            away_m = np.linalg.norm(at_m - placed[goal.node].translation, axis=1)
            to = near[int(np.argmin(away_m))]
            to_from_goal = placed[to].inverse() @ placed[goal.node] @ goal.node_from_goal
            found[goal.name] = Goal(goal.name, to, to_from_goal)
    return found
