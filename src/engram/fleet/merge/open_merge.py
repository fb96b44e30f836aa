"""The state of merging one robot's map into the fleet map, and whether it may be merged."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import IncompatibleError
from engram.fleet.merge.report import MergeReport
from engram.frontend.frame import Frame
from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    Amendment,
    Clock,
    Edge,
    EdgeKind,
    Goal,
    Node,
    NodeId,
    Omission,
    PathEntry,
    PathEntryKind,
    PathId,
    Removal,
    Removed,
    Session,
    SessionId,
    path_id,
)
from engram.graph.paths import Attempts, PathMemory
from engram.localiser.localisation import Position
from engram.maps.map import Map
from engram.maps.records import StoredNode
from engram.maps.writer import RevisionWriter
from engram.robot.anchors import had_goal

if TYPE_CHECKING:
    from scipy.cluster.hierarchy import DisjointSet


Array = NDArray[np.float64]

# Standard deviations of an omitted node's position, whose match covariance is not stored: wide
# against the errors of matches, 93 % of which are below 0.25 m, the median 2 cm (simulated drives,
# world 5).
_OMITTED_SIGMA_M = 0.2
_OMITTED_SIGMA_RAD = float(np.deg2rad(1.0))


def position_of(omission: Omission) -> Position:
    """Position of an omitted node in the map that omits it."""
    spread = np.diag([_OMITTED_SIGMA_M**2] * 3 + [_OMITTED_SIGMA_RAD**2] * 3)
    return Position(omission.node, omission.node_from_omitted, spread)


def seen_from(edge: Edge, node: NodeId) -> tuple[NodeId, SE3, Array]:
    """The other end of an edge, ``node_from_other``, and its (6, 6) covariance."""
    if node == edge.a:
        return edge.b, edge.a_from_b, edge.covariance
    b_from_a = edge.a_from_b.inverse()
    adjoint = b_from_a.adjoint()
    return edge.a, b_from_a, adjoint @ edge.covariance @ adjoint.T


def beyond(known: Position, edge: Edge, node: NodeId) -> Position:
    """Position of a node, by its edge to another node whose position is known.

    Args:
        known: position of the edge's other end.
    """
    other = edge.b if node == edge.a else edge.a
    _, other_from_node, covariance = seen_from(edge, other)
    return known.carried_on(other_from_node, covariance)


def recomposed(edge: Edge, a: Position, b: Position) -> Edge | None:
    """An edge between two of the robot's nodes, as one between their equivalents (method §7.3).

    A moved odometry edge becomes a tie, since it no longer links nodes of one experience.

    Args:
        edge: as in the robot's map.

    Returns:
        The edge; None if both ends have the same equivalent.
    """
    if (a.node, b.node) == (edge.a, edge.b):
        return edge
    if a.node == b.node:
        return None
    covariance = propagate_covariance(a.node_from_live, a.covariance, edge.covariance)
    new_a_from_new_b = a.node_from_live @ edge.a_from_b @ b.node_from_live.inverse()
    adjoint = new_a_from_new_b.adjoint()
    covariance = covariance + adjoint @ b.covariance @ adjoint.T
    kind = EdgeKind.TIE if edge.kind is EdgeKind.ODOMETRY else edge.kind
    return Edge(a.node, b.node, kind, new_a_from_new_b, (covariance + covariance.T) / 2)


def uncertainty_m2(covariance: Array) -> float:
    """Sum of the translational variances of a (6, 6) covariance, m²; ranks two estimates."""
    return float(np.trace(covariance[:3, :3]))


# Sequence numbers of entries that merges add follow all those that robots wrote (docs/format.md).
FIRST_REPLAYED = 2**32
# Represents all nodes that the fleet map had before, whatever their component.
_CENTRE = None


class Merge:
    """The fleet map, the robot's map, and the additions of this merge.

    Each addition goes into the fleet map's graph and path memory, the open revision and the report.

    Attributes:
        centre: the fleet map.
        held: those of the robot's nodes that the fleet map had before.
        runs: which nodes of the fleet map were connected before.
        robot: the robot's map.
        sessions: of the robot's map, but for forgotten ones, in the order of their starts.
        edges: of the robot's map, by their keys.
        taken: nodes taken in this merge.
        joined: the ends of edges that were added in this merge.
        writer: the open revision; set before the first addition.
    """

    writer: RevisionWriter

    def __init__(self, centre: Map, robot: Map) -> None:
        from scipy.cluster.hierarchy import DisjointSet

        self.centre = centre
        self.robot = robot
        own = [*(node.id for node in robot.graph.nodes), *robot.omissions]
        self._forgotten = centre.lookups.forgotten([*own, *robot.sessions])
        self.sessions = sorted(
            (one for one in robot.sessions.values() if one.id not in self._forgotten),
            key=lambda session: (session.start_ns, session.id),
        )
        self.edges = sorted(robot.graph.edges, key=_edge_key)
        self.report = MergeReport.of(robot)
        self.held = centre.lookups.nodes(own)
        self.runs = centre.lookups.runs()
        self.taken: set[NodeId] = set()
        self.joined: list[tuple[NodeId, NodeId]] = []
        known = centre.lookups.omissions(own)
        self._omitted = {node: position_of(omission) for node, omission in known.items()}
        self._entries: dict[PathId, _KnownEntries] = {}
        # Components of the taken nodes: a graph search for each would be too slow.
        self._parts: DisjointSet = DisjointSet([_CENTRE])

    @cached_property
    def graph(self) -> ExperienceGraph:
        """The fleet map's, in which segments are replayed; it grows."""
        return self.centre.read_graph()

    @cached_property
    def paths(self) -> PathMemory:
        """The fleet map's paths; they grow."""
        return PathMemory(self.graph, pages=self.centre.pages)

    # -- known records

    def has(self, node: NodeId) -> bool:
        """Whether the fleet map has the robot's node, perhaps since this merge."""
        return node in self.held or node in self.taken

    def has_omitted(self, node: NodeId) -> bool:
        """Whether an earlier merge omitted the node."""
        return node in self._omitted and not self.has(node)

    def knows(self, node: NodeId) -> bool:
        """Whether the node was taken or omitted before."""
        return self.has(node) or node in self._omitted

    def has_forgotten(self, node: Node) -> bool:
        """Whether the fleet map has forgotten the robot's node, or its session."""
        return node.id in self._forgotten or node.session in self._forgotten

    def equivalent(self, node: NodeId) -> Position | None:
        """Position of the node's camera in the fleet map: at itself or its equivalent."""
        return Position.at(node) if self.has(node) else self._omitted.get(node)

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
        paths = self.robot.path_memory
        return (
            any(session.id not in self.centre.sessions for session in self.sessions)
            or any(
                self.new_entry(entry)
                for session in self.sessions
                for entry in paths.entries(path_id(session.id))
            )
            or any(map(self.lacks_edge, self.edges))
            or any(map(self.lacks_omission, self.robot.omissions))
            or not set(self.amendments) <= set(self.centre.amendments)
            or any(self.new_removals())
            or any(self.new_goals())
            or len(self.new_attempts()) > 0
        )

    def lacks_edge(self, edge: Edge) -> bool:
        """Whether this edge is missing between two nodes of the fleet map; False for bridges."""
        return (
            edge.kind is not EdgeKind.BRIDGE
            and self.has(edge.a)
            and self.has(edge.b)
            and self.graph.find_edge(edge.a, edge.b, edge.kind) is None
            and edge not in self.removed
        )

    @property
    def amendments(self) -> list[Amendment]:
        """The robot's amendments of `sessions`."""
        return [one for one in self.robot.amendments if one.session not in self._forgotten]

    @cached_property
    def removed(self) -> Removed:
        """Edges that do not count in the fleet map."""
        return Removed(self.centre.removals)

    def new_removals(self) -> Iterator[Removal]:
        """The robot's removals between nodes of the fleet map that it has never had."""
        for removal in self.robot.removals:
            known = self.has(removal.a) and self.has(removal.b)
            if known and removal.key not in self.centre.seen_removals:
                yield removal

    def new_goals(self) -> Iterator[Goal]:
        """The robot's goals at known nodes, under names that are new to the fleet map.

        One that was removed from the fleet map stays removed.
        """
        for goal in self.robot.goals.values():
            position = self.equivalent(goal.node)
            if position is not None and goal.name not in self.centre.goals:
                node_from_goal = position.node_from_live @ goal.node_from_goal
                moved = Goal(goal.name, position.node, node_from_goal)
                if not had_goal(self.centre.seen_goals, self.graph, moved):
                    yield moved

    def lacks_omission(self, omitted: NodeId) -> Position | None:
        """Position of a node that the robot's map omitted; None if the fleet map contains it."""
        omission = self.robot.omissions[omitted]
        known = self.equivalent(omission.node)
        if known is None or self.knows(omitted) or omitted in self._forgotten:
            return None
        if omitted in self.robot.graph:
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
        return None if position is None else self._numbered(replace(entry, node=position.node))

    def _numbered(self, entry: PathEntry) -> PathEntry | None:
        """An entry at a node of the fleet map; None if the path has it."""
        known = self._known_entries(entry.path)
        if _key(entry) in known.keys:
            return None
        if entry.kind is PathEntryKind.REPLAYED:
            return replace(entry, sequence=max(FIRST_REPLAYED, known.last + 1))
        return entry

    def new_attempts(self) -> Attempts:
        """The robot's attempts between known nodes that the fleet map, as written, has not.

        Returns:
            Moved to the equivalents. `session` is a place in the sessions of the robot's map;
            `reference` and `node` are indices of its graph.
        """
        positions = [self.equivalent(node.id) for node in self.robot.graph.nodes]
        known = np.array([position is not None for position in positions], np.bool_)
        made = self.robot.attempts
        drives = np.array([one not in self._forgotten for one in self.robot.sessions], np.bool_)
        made = made.rows(known[made.reference] & known[made.node] & drives[made.session])
        remembered = self.centre.lookups.attempts(list(self.robot.sessions))
        new = made.rows(made.lacking(remembered))
        return new.moved_to(
            [None if position is None else position.node_from_live for position in positions]
        )

    # -- additions to the fleet map

    def take(self, stored: StoredNode, frame: Frame) -> int:
        """Adds a node to the fleet map; returns its dense index."""
        self.writer.copy_node(stored, frame)
        self.taken.add(stored.node.id)
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
            self._join(edge)
            self.report.edges += 1

    def see_edges_again(self) -> None:
        """Adds the edges of nodes that a revert had hidden and this merge shows again."""
        self.writer.checkpoint()
        shown = [
            edge
            for edge in self.centre.lookups.edges(self.taken)
            if self.graph.find_edge(edge.a, edge.b, edge.kind) is None
        ]
        self.graph.add_edges(shown)
        for edge in shown:
            self._join(edge)

    def _join(self, edge: Edge) -> None:
        self.joined.append((edge.a, edge.b))
        self._parts.merge(*(end if end in self.taken else _CENTRE for end in (edge.a, edge.b)))

    def add_entries(self, entries: Iterable[PathEntry]) -> None:
        """Adds the robot's entries that are missing from the fleet map's paths."""
        for entry in entries:
            self._add_entry(self.new_entry(entry))

    def add_replayed(self, entries: Iterable[PathEntry]) -> None:
        """Adds what a replay matched, at nodes of the fleet map."""
        for entry in entries:
            self._add_entry(self._numbered(entry))

    def _add_entry(self, new: PathEntry | None) -> None:
        if new is not None:
            self._known_entries(new.path).add(new)
            self.paths.add(new)
            self.writer.add_path_entry(new)
            self.report.path_entries += 1

    def _known_entries(self, path: PathId) -> _KnownEntries:
        if path not in self._entries:
            known = self._entries[path] = _KnownEntries()
            for entry in self.centre.lookups.entries(path):
                known.add(entry)
        return self._entries[path]


def _edge_key(edge: Edge) -> tuple[NodeId, NodeId, EdgeKind]:
    return edge.a, edge.b, edge.kind


_EntryKey: TypeAlias = int | tuple[NodeId, int]


def _key(entry: PathEntry) -> _EntryKey:
    """Identity of a path entry, independent of who numbered it."""
    is_replayed = entry.kind is PathEntryKind.REPLAYED
    return (entry.node, entry.stamp_ns) if is_replayed else entry.sequence


@dataclass(slots=True)
class _KnownEntries:
    """Entries of a path: what identifies them, and the largest sequence number."""

    keys: set[_EntryKey] = field(default_factory=set)
    last: int = -1

    def add(self, entry: PathEntry) -> None:
        self.keys.add(_key(entry))
        self.last = max(self.last, entry.sequence)


_NS_PER_S = 1_000_000_000
# Stamps run backwards only if odometry reports at least this much driven meanwhile.
_DRIVEN_SLACK_M = 0.5
# Most pairs of overlapping drives named for each robot: two robots of one name make many.
_NAMED_OVERLAPS = 5


def check_fits(merge: Merge) -> None:
    """Refuses a map that contradicts the fleet map.

    By another kind of descriptors, or a node or session of the same UUID with other content.
    """
    robot, known = merge.robot, merge.centre.sessions
    kind, theirs = merge.centre.descriptor, robot.descriptor
    if None not in {kind, theirs} and kind is not theirs:
        raise IncompatibleError(
            f"{robot.location} holds {theirs} descriptors, the fleet map {kind}; the two cannot "
            "be matched: record and map the drives again with the same --features"
        )
    for session in merge.sessions:
        ours = known.get(session.id)
        if ours is not None and _drive(ours) != _drive(session):
            raise IncompatibleError(
                f"session {session.id} is a drive of {session.robot} in {robot.location} and "
                f"another one, of {ours.robot}, in the fleet map: one of the two maps is "
                "wrong"
            )
    landmarks = merge.centre.lookups.landmark_hashes(robot.landmark_hashes)
    for node, brought in robot.landmark_hashes.items():
        held = landmarks.get(node, brought)
        if held != brought or not _same_record(merge, node):
            which = ""
            if node in robot.graph:
                record = robot.graph.node(robot.graph.index(node))
                which = f" (session {record.session}, stamp {record.stamp_ns})"
            raise IncompatibleError(
                f"node {node}{which} has one content in {robot.location} and another in the "
                f"fleet map, landmarks {brought.hex()} and {held.hex()}: a node never changes, so "
                "one of the two maps is wrong"
            )


def _drive(session: Session) -> tuple[str, str, int]:
    """The parts of a session's UUID; clock, longitude and zone may be set later (method §2.8)."""
    recorded = session.as_recorded
    return recorded.robot, recorded.camera, recorded.start_ns


def _same_record(merge: Merge, node: NodeId) -> bool:
    """Whether both maps have the node with the same drive, stamp and camera."""
    graph = merge.robot.graph
    if node not in merge.held or node not in graph:
        return True
    records = merge.held[node].node, graph.node(graph.index(node))
    ours, theirs = ((record.session, record.stamp_ns, record.camera) for record in records)
    return ours == theirs


def check_readable(robot: Map, nodes: Sequence[Node]) -> None:
    """Reads all landmarks that may be taken once, before the fleet map is written."""
    for _ in robot.frames.stored(list(nodes)):
        pass


def notes(merge: Merge, now_ns: int) -> list[str]:
    """Warnings about a map that do not prevent a merge.

    Drives that the fleet map has are left out: their warnings were reported when they were merged.

    Args:
        now_ns: the time, UTC.
    """
    robot = merge.robot
    warnings = [
        f"session {drive.session.id} of {drive.session.robot} was interrupted in "
        f"{robot.location}: it is not merged before it is resumed or sealed there"
        for drive in robot.interrupted()
    ]
    new = [session for session in merge.sessions if session.id not in merge.centre.sessions]
    saved: dict[SessionId, list[Node]] = defaultdict(list)
    for node in sorted(robot.graph.nodes, key=lambda node: (node.stamp_ns, node.id)):
        saved[node.session].append(node)
    for session in new:
        warnings += _backwards(session, saved[session.id])
        if session.clock is Clock.UTC and session.begin_ns > now_ns:
            warnings.append(
                f"session {session.id} of {session.robot} begins "
                f"{(session.begin_ns - now_ns) / _NS_PER_S / 3600:.1f} hours from now: its clock "
                "was wrong"
            )
    return warnings + list(_overlaps(merge, new))


def _backwards(session: Session, nodes: list[Node]) -> Iterator[str]:
    """Warns of stamps that fall while the distance driven rises."""
    back = [
        (before.driven_m - after.driven_m, before, after)
        for before, after in pairwise(nodes)
        if after.driven_m < before.driven_m - _DRIVEN_SLACK_M
    ]
    if back:
        _, before, after = max(back, key=lambda step: step[0])
        yield (
            f"the clock of session {session.id} ({session.robot}) runs backwards "
            f"{counted(len(back), 'time')}: "
            f"{(after.stamp_ns - before.stamp_ns) / _NS_PER_S:.1f} s after "
            f"{before.driven_m:.0f} m driven it stamped {after.driven_m:.0f} m; nodes are replayed "
            "in the order of their stamps"
        )


def _overlaps(merge: Merge, new: Sequence[Session]) -> Iterator[str]:
    """Warns of drives of one robot at the same time: a shared name or a wrong clock."""
    spans = _spans(merge)
    ids = {session.id for session in new}
    for name in sorted({session.robot for session in new}):
        pairs = list(overlapping([span for span in spans if span.session.robot == name], ids))
        for first, other in pairs[:_NAMED_OVERLAPS]:
            yield (
                f"sessions {first.id} and {other.id} are both of a robot named {name!r} and "
                "overlap in time: two robots have the same name, or a clock was wrong"
            )
        if len(pairs) > _NAMED_OVERLAPS:
            more = counted(len(pairs) - _NAMED_OVERLAPS, "more pair")
            yield f"… and {more} of drives of {name!r}"


@dataclass(frozen=True, slots=True)
class Span:
    """A session and its first and last stamp, UTC."""

    session: Session
    first_ns: int
    last_ns: int


def overlapping(
    spans: Iterable[Span], new: Container[SessionId]
) -> Iterator[tuple[Session, Session]]:
    """The pairs of sessions that overlap in time, at least one of them new; the earlier first.

    One sweep over the starts that keeps only sessions that have not ended.
    """
    running: list[Span] = []
    for span in sorted(spans, key=lambda span: (span.first_ns, span.session.id)):
        running = [earlier for earlier in running if earlier.last_ns >= span.first_ns]
        for earlier in running:
            if span.session.id in new or earlier.session.id in new:
                yield earlier.session, span.session
        running.append(span)


def _spans(merge: Merge) -> list[Span]:
    sessions = {**merge.centre.sessions, **merge.robot.sessions}
    last = {session.id: session.start_ns for session in sessions.values()}
    for session_id, stamp_ns in merge.centre.lookups.last_stamps_ns().items():
        last[session_id] = max(last[session_id], stamp_ns)
    for node in merge.robot.graph.nodes:
        last[node.session] = max(last[node.session], node.stamp_ns)
    return [
        Span(session, session.begin_ns, last[session.id] + session.shift_ns)
        for session in sessions.values()
        if session.clock is Clock.UTC
    ]
