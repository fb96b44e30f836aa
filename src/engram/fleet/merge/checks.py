"""Checks whether a map may be merged, and collects warnings about it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from engram.counts import counted
from engram.errors import IncompatibleError
from engram.fleet.merge.state import Merge
from engram.graph.model import Clock, Node, NodeId, Session, SessionId
from engram.maps import Map

_NS_PER_S = 1_000_000_000
# Stamps run backwards only if odometry reports at least this much driven meanwhile.
_DRIVEN_SLACK_M = 0.5
# Most pairs of overlapping drives named for each robot: two robots of one name make many.
_NAMED_OVERLAPS = 5


def check_fits(merge: Merge) -> None:
    """Refuses a map that would damage the fleet map.

    Raises:
        IncompatibleError: it has another kind of descriptors, or a node or session whose UUID the
            fleet map has with other content.
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
    landmarks = merge.centre.landmark_hashes
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
    graphs = merge.graph, merge.robot.graph
    if not all(node in graph for graph in graphs):
        return True
    records = (graph.node(graph.index(node)) for graph in graphs)
    ours, theirs = ((one.session, one.stamp_ns, one.camera) for one in records)
    return ours == theirs


def check_readable(robot: Map, nodes: Sequence[Node]) -> None:
    """Reads all landmarks that may be taken once, before the fleet map is written.

    Raises:
        MapError: some of them are damaged.
    """
    for _ in robot.frames.stored(list(nodes)):
        pass


def notes(merge: Merge, now_ns: int) -> list[str]:
    """Warnings about a map that do not prevent a merge.

    Drives that the fleet map has are left out: their warnings were reported when they were merged.

    Args:
        merge: before anything is added.
        now_ns: the time, UTC.
    """
    robot = merge.robot
    found = [
        f"session {one.session.id} of {one.session.robot} was interrupted in {robot.location}: it "
        "is not merged before it is resumed or sealed there"
        for one in robot.interrupted()
    ]
    new = [one for one in merge.sessions if one.id not in merge.centre.sessions]
    saved: dict[SessionId, list[Node]] = defaultdict(list)
    for node in sorted(robot.graph.nodes, key=lambda one: (one.stamp_ns, one.id)):
        saved[node.session].append(node)
    for session in new:
        found += _backwards(session, saved[session.id])
        if session.clock is Clock.UTC and session.begin_ns > now_ns:
            found.append(
                f"session {session.id} of {session.robot} begins "
                f"{(session.begin_ns - now_ns) / _NS_PER_S / 3600:.1f} hours from now: its clock "
                "was wrong"
            )
    return found + list(_overlaps(merge, new))


def _backwards(session: Session, nodes: list[Node]) -> Iterator[str]:
    """Warns of stamps that fall while the distance driven rises."""
    back = [
        (before.driven_m - after.driven_m, before, after)
        for before, after in pairwise(nodes)
        if after.driven_m < before.driven_m - _DRIVEN_SLACK_M
    ]
    if back:
        _, before, after = max(back, key=lambda one: one[0])
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
        pairs = list(overlapping([one for one in spans if one.session.robot == name], ids))
        for one, other in pairs[:_NAMED_OVERLAPS]:
            yield (
                f"sessions {one.id} and {other.id} are both of a robot named {name!r} and overlap "
                "in time: two robots have the same name, or a clock was wrong"
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
    for span in sorted(spans, key=lambda one: (one.first_ns, one.session.id)):
        running = [one for one in running if one.last_ns >= span.first_ns]
        for one in running:
            if span.session.id in new or one.session.id in new:
                yield one.session, span.session
        running.append(span)


def _spans(merge: Merge) -> list[Span]:
    """Spans of all sessions whose clock is UTC."""
    sessions = {**merge.centre.sessions, **merge.robot.sessions}
    last = {one.id: one.start_ns for one in sessions.values()}
    for node in (*merge.graph.nodes, *merge.robot.graph.nodes):
        last[node.session] = max(last[node.session], node.stamp_ns)
    return [
        Span(one, one.begin_ns, last[one.id] + one.shift_ns)
        for one in sessions.values()
        if one.clock is Clock.UTC
    ]
