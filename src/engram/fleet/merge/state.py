"""The state of merging one robot's map into the fleet map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from engram.fleet.merge.positions import position_of, uncertainty_m2
from engram.fleet.merge.report import MergeReport
from engram.frontend import Frame
from engram.graph.attempts import Attempts
from engram.graph.marks import Goal, Removal, Removed
from engram.graph.model import (
    Edge,
    EdgeKind,
    NodeId,
    Omission,
    PathEntry,
    PathEntryKind,
    PathId,
    SessionId,
)
from engram.localiser import Position
from engram.maps import Map, RevisionWriter, StoredNode
from engram.robot.goals import had_goal

if TYPE_CHECKING:
    from scipy.cluster.hierarchy import DisjointSet

# Sequence numbers of entries that merges add follow all those that robots wrote (docs/format.md).
FIRST_REPLAYED = 2**32
# Represents all nodes that the fleet map had before, whatever their component.
_CENTRE = None


class Merge:
    """The fleet map, the robot's map, and the additions of this merge.

    Each addition goes into the fleet map's graph and path memory, the open revision and the report.

    Attributes:
        centre: the fleet map; its graph and path memory grow.
        graph: the fleet map's.
        robot: the robot's map.
        sessions: of the robot's map, in the order of their starts.
        edges: of the robot's map, by their keys.
        report: counts so far.
        writer: the open revision; set before the first addition.
    """

    writer: RevisionWriter

    def __init__(self, centre: Map, robot: Map) -> None:
        from scipy.cluster.hierarchy import DisjointSet

        self.centre = centre
        self.graph = centre.graph
        self.robot = robot
        self.sessions = sorted(robot.sessions.values(), key=lambda one: (one.start_ns, one.id))
        self.edges = sorted(robot.graph.edges, key=_edge_key)
        self.report = MergeReport.of(robot)
        self._omitted = {
            omission.omitted: position_of(omission) for omission in centre.omissions.values()
        }
        self._entries: dict[PathId, set[_EntryKey]] = {}
        # Components of the taken nodes: a graph search for each would be too slow.
        self._parts: DisjointSet = DisjointSet([_CENTRE])

    # -- known records

    def has_omitted(self, node: NodeId) -> bool:
        """Whether an earlier merge omitted the node."""
        return node in self._omitted and node not in self.graph

    def knows(self, node: NodeId) -> bool:
        """Whether the node was taken or omitted before."""
        return node in self.graph or node in self._omitted

    def equivalent(self, node: NodeId) -> Position | None:
        """Position of the node's camera in the fleet map: at itself or its equivalent."""
        if node in self.graph:
            return Position.at(node)
        return self._omitted.get(node)

    def is_apart(self, node: NodeId) -> bool:
        """Whether a node taken in this merge is not connected to the earlier fleet map."""
        return node in self._parts and not self._parts.connected(node, _CENTRE)

    def edges_of(self, node: NodeId) -> list[Edge]:
        """The robot's edges at a node, by their keys."""
        graph = self.robot.graph
        return sorted(graph.edges_of(graph.index(node)), key=_edge_key)

    # -- new records of the robot

    def has_more(self) -> bool:
        """Whether a map without new nodes has other new records."""
        known, paths = self.centre.sessions, self.robot.path_memory
        return (
            any(session not in known for session in self.robot.sessions)
            or any(self.new_entry(entry) for path in paths.paths for entry in paths.entries(path))
            or any(map(self.lacks_edge, self.edges))
            or any(map(self.lacks_omission, self.robot.omissions))
            or not set(self.robot.amendments) <= set(self.centre.amendments)
            or any(self.new_removals())
            or any(self.new_goals())
            or len(self.new_attempts(known, self.centre.attempts)) > 0
        )

    def lacks_edge(self, edge: Edge) -> bool:
        """Whether this edge is missing between two nodes of the fleet map; False for bridges."""
        return (
            edge.kind is not EdgeKind.BRIDGE
            and edge.a in self.graph
            and edge.b in self.graph
            and self.graph.find_edge(edge.a, edge.b, edge.kind) is None
            and edge not in self.removed
        )

    @cached_property
    def removed(self) -> Removed:
        """Edges that do not count in the fleet map."""
        return Removed(self.centre.removals)

    def new_removals(self) -> Iterator[Removal]:
        """The robot's removals between nodes of the fleet map that it has never had."""
        for one in self.robot.removals:
            known = one.a in self.graph and one.b in self.graph
            if known and one.key not in self.centre.seen_removals:
                yield one

    def new_goals(self) -> Iterator[Goal]:
        """The robot's goals at known nodes, under names that are new to the fleet map.

        One that was removed from the fleet map stays removed.
        """
        for goal in self.robot.goals.values():
            position = self.equivalent(goal.node)
            if position is not None and goal.name not in self.centre.goals:
                node_from_goal = position.node_from_live @ goal.node_from_goal
                found = Goal(goal.name, position.node, node_from_goal)
                if not had_goal(self.centre, found):
                    yield found

    def lacks_omission(self, omitted: NodeId) -> Position | None:
        """Position of a node that the robot's map omitted; None if the fleet map contains it."""
        omission = self.robot.omissions[omitted]
        known = self.equivalent(omission.node)
        if known is None or self.knows(omitted) or omitted in self.robot.graph:
            return None
        return known.carried_on(omission.node_from_omitted, np.zeros((6, 6)))

    def new_entry(self, entry: PathEntry) -> PathEntry | None:
        """The robot's path entry as an entry of the fleet map's path of the same drive.

        Paths are united by (path, sequence) (method §7.4). Entries of merges are compared by
        node and stamp, and get the next free sequence number.

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
        """The robot's new attempts between known nodes, moved to the equivalents.

        Args:
            sessions: of the fleet map.
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

    # -- additions to the fleet map

    def take(self, stored: StoredNode, frame: Frame) -> int:
        """Adds a node to the fleet map; returns its dense index."""
        self.writer.copy_node(stored, frame)
        self._parts.add(stored.node.id)
        return self.graph.add_node(stored.node)

    def omit(self, node: NodeId, position: Position, landmark_hash: bytes | None) -> None:
        """Records an omitted node and its position."""
        self._omitted[node] = position
        omission = Omission(node, position.node, position.node_from_live, landmark_hash)
        self.writer.add_omission(omission)

    def add_edge(self, edge: Edge) -> None:
        """Adds a missing edge, or replaces one of larger variance; never a removed one."""
        if edge in self.removed:
            return
        known = self.graph.find_edge(edge.a, edge.b, edge.kind)
        if known is None or uncertainty_m2(edge.covariance) < uncertainty_m2(known.covariance):
            self.graph.add_edge(edge)
            self.write_edges([edge])

    def write_edges(self, edges: Iterable[Edge]) -> None:
        """Writes edges that are in the graph already."""
        for edge in edges:
            self.writer.add_edge(edge)
            a, b = (end if end in self._parts else _CENTRE for end in (edge.a, edge.b))
            self._parts.merge(a, b)
            self.report.edges += 1

    def add_entries(self, entries: Iterable[PathEntry]) -> None:
        """Adds the entries that are missing from the fleet map's paths."""
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
    """Identity of a path entry, independent of who numbered it."""
    is_replayed = entry.kind is PathEntryKind.REPLAYED
    return (entry.node, entry.stamp_ns) if is_replayed else entry.sequence
