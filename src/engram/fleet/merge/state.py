"""One robot's map on its way into the fleet's: what is known so far, and what becomes of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.cluster.hierarchy import DisjointSet

from engram.fleet.merge.positions import uncertainty_m2
from engram.fleet.merge.report import MergeReport
from engram.frontend import Frame
from engram.graph.attempts import Attempts
from engram.graph.model import (
    Edge,
    EdgeKind,
    NodeId,
    Omission,
    PathEntry,
    PathEntryKind,
    PathId,
    SessionId,
    path_id,
)
from engram.localiser import Position
from engram.maps import Map, RevisionWriter, StoredNode

# Entries that a merge adds itself stand behind all that robots wrote (docs/format.md).
FIRST_REPLAYED = 2**32
# How well a node omitted long ago lies to its equivalent: its match's covariance was not kept.
# Set wide of what matches reach: 93 % within 0.25 m, median 2 cm (docs/performance.md).
_OMITTED_SIGMA_M = 0.2
_OMITTED_SIGMA_RAD = float(np.deg2rad(1.0))
# Stands for all nodes that the centre had before, in whatever parts they lie.
_CENTRE = None


class Merge:
    """What the centre knows, what the robot hands in, and what this merge adds.

    What is added goes into the centre's graph and path memory, the open revision and the report
    alike.

    Attributes:
        centre: the fleet's map; its graph and path memory grow.
        graph: the centre's.
        robot: the map handed in.
        sessions: of the robot's map, in the order of their starts.
        edges: of the robot's map, by their keys.
        report: counts so far.
        writer: the open revision; from when something is to be added.
    """

    writer: RevisionWriter

    def __init__(self, centre: Map, robot: Map) -> None:
        self.centre = centre
        self.graph = centre.graph
        self.robot = robot
        self.sessions = sorted(robot.sessions.values(), key=lambda one: (one.start_ns, one.id))
        self.edges = sorted(robot.graph.edges, key=_edge_key)
        self.report = MergeReport.of(robot)
        spread = np.diag([_OMITTED_SIGMA_M**2] * 3 + [_OMITTED_SIGMA_RAD**2] * 3)
        self._omitted = {
            omission.omitted: Position(omission.node, omission.node_from_omitted, spread)
            for omission in centre.omissions.values()
        }
        self._entries: dict[PathId, set[_EntryKey]] = {}
        # Nodes that were taken, by what joins them: a graph search for each would take too long.
        self._parts: DisjointSet = DisjointSet([_CENTRE])

    # -- what is known

    def has_omitted(self, node: NodeId) -> bool:
        """Whether the node was handed in once and not taken."""
        return node in self._omitted and node not in self.graph

    def knows(self, node: NodeId) -> bool:
        """Whether the node needs no more looking at."""
        return node in self.graph or node in self._omitted

    def equivalent(self, node: NodeId) -> Position | None:
        """Where the node's camera is in the centre: in itself or in its equivalent."""
        if node in self.graph:
            return Position.at(node)
        return self._omitted.get(node)

    def is_apart(self, node: NodeId) -> bool:
        """Whether a node was taken in this merge, and nothing leads from it to what was there."""
        return node in self._parts and not self._parts.connected(node, _CENTRE)

    def edges_of(self, node: NodeId) -> list[Edge]:
        """The robot's edges at a node, by their keys."""
        graph = self.robot.graph
        return sorted(graph.edges_of(graph.index(node)), key=_edge_key)

    @cached_property
    def relied_on(self) -> frozenset[NodeId]:
        """Nodes of the robot's map that a drive other than their own localised by."""
        graph, paths = self.robot.graph, self.robot.path_memory
        return frozenset(
            entry.node
            for path in paths.paths
            for entry in paths.entries(path)
            if entry.kind is not PathEntryKind.SAVED
            and path_id(graph.node(graph.index(entry.node)).session) != path
        )

    # -- what the centre lacks

    def has_more(self) -> bool:
        """Whether a map without new nodes has anything else to say."""
        known, paths = self.centre.sessions, self.robot.path_memory
        return (
            any(session not in known for session in self.robot.sessions)
            or any(self.new_entry(entry) for path in paths.paths for entry in paths.entries(path))
            or any(map(self.lacks_edge, self.edges))
            or any(map(self.lacks_omission, self.robot.omissions))
            or not set(self.robot.amendments) <= set(self.centre.amendments)
            or len(self.new_attempts(known, self.centre.attempts)) > 0
        )

    def lacks_edge(self, edge: Edge) -> bool:
        """Whether two of the centre's nodes lack this edge; a bridge stands for what it has."""
        return (
            edge.kind is not EdgeKind.BRIDGE
            and edge.a in self.graph
            and edge.b in self.graph
            and self.graph.find_edge(edge.a, edge.b, edge.kind) is None
        )

    def lacks_omission(self, omitted: NodeId) -> Position | None:
        """Where a node that the robot's map had omitted is in the centre; None if it is no news."""
        omission = self.robot.omissions[omitted]
        known = self.equivalent(omission.node)
        if known is None or self.knows(omitted) or omitted in self.robot.graph:
            return None
        return known.carried_on(omission.node_from_omitted, np.zeros((6, 6)))

    def new_entry(self, entry: PathEntry) -> PathEntry | None:
        """A path entry handed in, as it joins the centre's path of the same drive.

        Paths are united by (path, sequence) (SPEC §7 MERGE 4). Entries that merges made have no
        number of the robot's: they are the same when node and stamp are, and get the next number.

        Returns:
            The entry, pointing to the equivalent of its node; None if the path has it, or the node
            is not known.
        """
        position = self.equivalent(entry.node)
        if position is None:
            return None
        new = replace(entry, node=position.node)
        if _key(new) in self._known_entries(entry.path):
            return None
        if entry.kind is PathEntryKind.REPLAYED:
            last = [one.sequence + 1 for one in self.centre.path_memory.entries(entry.path)[-1:]]
            return replace(new, sequence=max([FIRST_REPLAYED, *last]))
        return new

    def new_attempts(self, sessions: Iterable[SessionId], remembered: Attempts) -> Attempts:
        """The robot's attempts between known nodes that the centre lacks, from the equivalents.

        Args:
            sessions: of the centre.
            remembered: its attempts; `session` is a place in `sessions`.

        Returns:
            `session` is a place in the sessions of the robot's map; `reference` and `node` are
            indices of its graph.
        """
        positions = [self.equivalent(node.id) for node in self.robot.graph.nodes]
        known = np.array([position is not None for position in positions], np.bool_)
        made = self.robot.attempts
        made = made.rows(known[made.reference] & known[made.node])
        place: dict[SessionId, int] = {}
        for session in (*sessions, *self.robot.sessions):
            place.setdefault(session, len(place))
        named = np.array([place[session] for session in self.robot.sessions], np.int32)
        new = made.rows(replace(made, session=named[made.session]).lacking(remembered))
        return new.moved_to([None if one is None else one.node_from_live for one in positions])

    # -- what it learns

    def take(self, stored: StoredNode, frame: Frame) -> int:
        """A node that the centre was lacking; returns its dense index."""
        self.writer.copy_node(stored, frame)
        self._parts.add(stored.node.id)
        return self.graph.add_node(stored.node)

    def omit(self, node: NodeId, position: Position, landmark_hash: bytes | None) -> None:
        """A node that is not taken, and where it is."""
        self._omitted[node] = position
        omission = Omission(node, position.node, position.node_from_live, landmark_hash)
        self.writer.add_omission(omission)

    def add_edge(self, edge: Edge) -> None:
        """An edge that the graph lacks; or a surer one, of two moved from different nodes."""
        known = self.graph.find_edge(edge.a, edge.b, edge.kind)
        if known is None or uncertainty_m2(edge.covariance) < uncertainty_m2(known.covariance):
            self.graph.add_edge(edge)
            self.write_edges([edge])

    def write_edges(self, edges: Iterable[Edge]) -> None:
        """Edges that are in the graph already."""
        for edge in edges:
            self.writer.add_edge(edge)
            a, b = (end if end in self._parts else _CENTRE for end in (edge.a, edge.b))
            self._parts.merge(a, b)
            self.report.edges += 1

    def add_entries(self, entries: Iterable[PathEntry]) -> None:
        """The entries of these that the centre's paths lack."""
        for entry in entries:
            new = self.new_entry(entry)
            if new is not None:
                self._known_entries(new.path).add(_key(new))
                self.centre.path_memory.add(new)
                self.writer.add_path_entry(new)
                self.report.path_entries += 1

    def _known_entries(self, path: PathId) -> set[_EntryKey]:
        if path not in self._entries:
            self._entries[path] = set(map(_key, self.centre.path_memory.entries(path)))
        return self._entries[path]


def _edge_key(edge: Edge) -> tuple[NodeId, NodeId, EdgeKind]:
    return edge.a, edge.b, edge.kind


_EntryKey: TypeAlias = int | tuple[NodeId, int]


def _key(entry: PathEntry) -> _EntryKey:
    """By what an entry of a path is known, whoever numbered it."""
    is_replayed = entry.kind is PathEntryKind.REPLAYED
    return (entry.node, entry.stamp_ns) if is_replayed else entry.sequence
