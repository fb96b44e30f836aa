"""Replays a robot's segments in the fleet map as if they were live streams (method §7.2–7.3).

Relocates a robot behind a gap of its odometry. Odometry may fail for a second or two, in a bend or
in rain, and the nodes behind such a gap are not connected to those before it. The robot's speed
predicts its position behind the gap well enough to match there, as a live robot does, before place
recognition searches the whole map.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engram.fleet.merge.merge_settings import MergeOptions, SeedFrom, Unit, localises_well
from engram.fleet.merge.open_merge import Merge, beyond, recomposed, seen_from, uncertainty_m2
from engram.fleet.merge.report import KeptNode, Reason, Seed, SegmentReport
from engram.frontend.frame import Frame, FrameStatus
from engram.frontend.frontend import as_live
from engram.geometry.se3 import SE3
from engram.graph.model import (
    Attempt,
    Edge,
    EdgeKind,
    Node,
    NodeId,
    PathEntry,
    PathEntryKind,
    Session,
    SessionId,
    path_id,
)
from engram.graph.proximity import lay_proximity_edges, tighten_chain
from engram.localiser.attempts import Outcome
from engram.localiser.localisation import (
    Budget,
    Hint,
    Localisation,
    LocalisationStatus,
    Position,
    ResultSink,
)
from engram.localiser.localiser import Localiser
from engram.localiser.relocalisation import Relocaliser
from engram.mapper.mapper import match_edges
from engram.maps.records import StoredNode
from engram.monitor import Monitor
from engram.odometry.motion import GapConfig, GapFiller, Motion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.front import Front
from engram.robot.localisers import localiser_in, relocaliser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings
from engram.sequences.sequence import LoggedFrame


@dataclass(slots=True, eq=False)
class Held:
    """A replayed node, held back while its fix or one before it may still be withdrawn.

    Attributes:
        stored, live: the node, and its frame.
        found: its localisation; not localised once its fix is withdrawn.
        outcomes: of the frame's attempts.
    """

    stored: StoredNode
    live: Frame
    found: Localisation
    outcomes: Sequence[Outcome]
    attempts: list[Attempt]

    def withdrawn(self, *, is_the_fix: bool) -> None:
        """Drops the position; for the disproved fix, its match too."""
        self.found = replace(self.found, position=None)
        if is_the_fix:
            self.found = replace(
                self.found,
                status=LocalisationStatus.LOST,
                node=None,
                node_from_live=None,
                covariance=None,
            )
            self.outcomes = ()
            self.attempts = [replace(attempt, accepted=False) for attempt in self.attempts]


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A chain of nodes of one session, in the order of time.

    Attributes:
        steps: the odometry edges between them, one fewer than nodes; each in its stored
            direction.
    """

    nodes: tuple[Node, ...]
    steps: tuple[Edge, ...]

    @property
    def key(self) -> tuple[int, NodeId]:
        """Sort key of a session's segments: stamp and UUID of the first node."""
        return self.nodes[0].stamp_ns, self.nodes[0].id

    @property
    def motions(self) -> list[tuple[SE3, NDArray[np.float64]]]:
        """``prev_from_curr`` of each node but the first, and its (6, 6) covariance."""
        return [
            seen_from(edge, before.id)[1:]
            for edge, before in zip(self.steps, self.nodes[:-1], strict=True)
        ]


def string_segments(nodes: Sequence[Node], edges: Iterable[Edge]) -> list[Segment]:
    """Maximal chains of nodes linked by odometry edges, never across sessions.

    Every node is in one segment; one without an odometry edge forms its own. The result does
    not depend on the order of nodes or edges.

    Args:
        nodes: the nodes to divide.
        edges: any edges; only odometry edges between these nodes count.

    Returns:
        Segments by the stamp of their first node, then its UUID.

    Source: method §7.2; [G16] §V-A, Algorithm 1.
    """
    known = {node.id: node for node in nodes}
    following = _steps(known, edges)
    entered = {after for after, _ in following.values()}
    strung = [_from(node, known, following) for node in nodes if node.id not in entered]
    return sorted(strung, key=lambda segment: segment.key)


def _from(
    first: Node, known: dict[NodeId, Node], following: dict[NodeId, tuple[NodeId, Edge]]
) -> Segment:
    """The chain from a node; it ends, since steps lead forward in time."""
    nodes, steps = [first], []
    while (step := following.get(nodes[-1].id)) is not None:
        after, edge = step
        nodes.append(known[after])
        steps.append(edge)
    return Segment(tuple(nodes), tuple(steps))


def _steps(known: dict[NodeId, Node], edges: Iterable[Edge]) -> dict[NodeId, tuple[NodeId, Edge]]:
    """The next node of each node, and the edge between them.

    If edges branch, the one with the smaller time step is taken, then the smaller UUIDs: each node
    has at most one edge to an earlier node and one to a later node.
    """
    oriented: list[tuple[int, NodeId, NodeId, Edge]] = []
    for edge in edges:
        a, b = known.get(edge.a), known.get(edge.b)
        if edge.kind is not EdgeKind.ODOMETRY or a is None or b is None or a.session != b.session:
            continue
        if (b.stamp_ns, b.id) < (a.stamp_ns, a.id):
            a, b = b, a
        oriented.append((b.stamp_ns - a.stamp_ns, a.id, b.id, edge))
    # Of two opposite edges between the same nodes, the edge's key decides.
    oriented.sort(key=lambda step: (step[0], step[1], step[2], step[3].a))
    chosen: dict[NodeId, tuple[NodeId, Edge]] = {}
    entered: set[NodeId] = set()
    for _, a_id, b_id, edge in oriented:
        if a_id not in chosen and b_id not in entered:
            chosen[a_id] = b_id, edge
            entered.add(b_id)
    return chosen


# Longest gap for a guess. Source: method §3.4, the distance after which a robot is lost.
_GUESS_WITHIN_M = 10.0
# Longest part of a segment that is searched. Source: the distance after which own nodes are
# neighbours again (method §3.1).
_LOOK_WITHIN_M = 30.0
# Least distance of two agreeing matches that relocate a robot (`Hypotheses`).
_BASE_LINE_M = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """A node of a segment that was localised ahead of its turn."""

    found: Localisation
    outcomes: list[Outcome]


def position_behind_gap(
    end: Position, before: Segment, segment: Segment, config: GapConfig
) -> Position | None:
    """Predicts the start of a segment from the robot's speed before the gap.

    Args:
        end: position of the last node of the segment before.

    Returns:
        The guess with its covariance (`GapFiller`); None if the speed is unknown, or if the robot
            would have driven more than 10 m.
    """
    gaps = GapFiller(config)
    gaps.motion(OdometryStep(OdometryStatus.FIRST), before.nodes[0].stamp_ns)
    for node, motion in zip(before.nodes[1:], before.motions, strict=True):
        gaps.motion(OdometryStep(OdometryStatus.OK, *motion), node.stamp_ns)
    lost = OdometryStep(OdometryStatus.NO_CONSENSUS)
    guess = gaps.motion(lost, segment.nodes[0].stamp_ns)
    assert guess.prev_from_curr is not None
    assert guess.covariance is not None
    if guess.guessed_m > _GUESS_WITHIN_M or guess.moved_m > _GUESS_WITHIN_M:
        return None
    return end.carried_on(guess.prev_from_curr, guess.covariance)


def look_along(robot: Robot, frames: Iterable[LoggedFrame]) -> tuple[Ahead | None, int]:
    """Tries to localise the first frames of a segment from a guess of its start.

    Args:
        robot: placed at the guess; it tries nowhere else.

    Returns:
        The first of two matched frames at least 4 m apart, or None; and the number of attempts.
    """
    first: Ahead | None = None
    driven_m = first_at_m = 0.0
    attempts = 0
    for logged in frames:
        driven_m += logged.odometry.moved_m
        if driven_m > _LOOK_WITHIN_M:
            break
        found = robot.step(logged)
        attempts += found.attempts
        if not found.localised:
            continue
        if first is None:
            assert robot.last is not None
            first, first_at_m = Ahead(found, robot.last.outcomes), driven_m
        elif driven_m - first_at_m >= _BASE_LINE_M:
            return first, attempts
    return None, attempts


# A segment is seeded from a neighbour at most this far along it; beyond, by place recognition.
# Source: the distance after which own nodes are neighbours again (method §3.1).
_SEED_WITHIN_M = 30.0
# Kinds of edges that measure a relation, rather than dead-reckon it.
_MEASURED = frozenset({EdgeKind.ODOMETRY, EdgeKind.MATCH, EdgeKind.TIE, EdgeKind.BRIDGE})
# Iterations between two segments of a session: matches of one are no evidence for the other.
_ITERATION_GAP = 100
# Fixes that a position counts for that the robot itself measured on its drive.
_AGREED = 5


class Replay(ResultSink):
    """Replays segments one after another and adds what is missing from the fleet map.

    Each segment is a drive of `Robot.step`, with this object as the result sink. What fixes on
    trial would omit or tie is held back until they have proved themselves.

    Args:
        monitor: receives the outcome of each node; its `check` is called after each.

    Attributes:
        attempts: attempts to remember, by session, in the order of iterations.
        entries: matches of the replay, by session, in the order of time; not yet numbered.
    """

    def __init__(
        self, merge: Merge, settings: Settings, options: MergeOptions, monitor: Monitor
    ) -> None:
        self.attempts: dict[SessionId, list[Attempt]] = defaultdict(list)
        self.entries: dict[SessionId, list[PathEntry]] = defaultdict(list)
        self._merge = merge
        self._settings = settings
        self._options = options
        self._monitor = monitor
        self._taken: set[NodeId] = set()
        self._iterations: dict[SessionId, int] = {}
        # Distance driven of each drive at its last known node.
        self._matched_at_m: dict[SessionId, float] = {}
        self._last: Segment | None = None  # the latest replayed segment
        # State of the current segment:
        self._localiser: Localiser
        self._stored: StoredNode
        self._start: Position | None = None  # position of its first node, if known
        self._ahead: Ahead | None = None  # found behind a gap, ahead of its turn
        self._run: list[int] = []  # nodes taken in a row, by their dense indices
        self._visited: NodeId | None = None  # matched or taken last
        self._held: list[Held] = []
        self._kept: list[KeptNode] = []
        # Whether the segment is omitted as a whole; None where each frame decides.
        self._omits: bool | None = None

    def segment(self, session: Session, segment: Segment) -> SegmentReport:
        """Replays one segment: omits nodes that localise, takes the rest (method §7.3).

        Also takes nodes that match only weakly; see `MergeOptions`.
        """
        self._visited, self._kept = None, []
        seed = self._find_start(session, segment)
        self._last = segment
        self._omits = self._covers(session, segment) if self._whole else None
        if self._relocaliser is not None:
            self._relocaliser.forget()
        self._localiser = self._localiser_of(session, segment, self._relocaliser)
        with Robot(Front(self._settings), self._localiser, self) as robot:
            for stored, logged in self._stream(segment):
                self._stored = stored
                robot.step(logged)
            self._drop_unproved()
            self._release()
            self._end_run()
            self._iterations[session.id] = self._localiser.iteration + _ITERATION_GAP
        return SegmentReport.of(session, seed, self._kept)

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """See `ResultSink`: the position of a frame by what the robot measured to a known node."""
        del motion
        node, (known, self._start) = self._stored.node, (self._start, None)
        if self._options.seed is SeedFrom.PLACES:
            return None
        if self._ahead is not None and self._ahead.found.stamp_ns == live.stamp_ns:
            return Hint(self._ahead.found.measured, found=self._ahead.found)
        if self._run:
            known = self._known_neighbour(node.id, _MEASURED, self._run[0])
        if known is None:
            return None
        # Matches with its own nodes are no evidence: the robot is as lost as when it saved them.
        open_loop_m = 0.0
        if self._merge.is_apart(known.node):
            open_loop_m = node.driven_m - self._matched_at_m.get(node.session, -math.inf)
        return Hint(known, open_loop_m, agreed=_AGREED)

    def may_propose_own(self) -> bool:
        """See `ResultSink`.

        While odometry holds, a drive's match with its own nodes far back is a loop, which the robot
        closed itself and whose edges come along, or a look-alike, which would take nodes away.
        """
        return not self._localiser.certain

    def keep(self, live: Frame, found: Localisation) -> Localisation:
        """See `ResultSink`: omits or takes the node, once its fix is no longer on trial."""
        outcomes, attempts = self._localiser.outcomes, self._localiser.attempts()
        if self._ahead is not None and self._ahead.found is found:
            outcomes, attempts = self._ahead.outcomes, []
        self._held.append(Held(self._stored, live, found, outcomes, attempts))
        if not self._localiser.on_trial:
            self._release()
        report = self._merge.report
        report.match_attempts += found.attempts
        report.proposed_attempts += found.proposed
        report.lookups += found.looked_up
        self._monitor.check()
        return found

    def withdrawn(self, found: Localisation) -> None:
        """See `ResultSink`: the frame was not localised, nor do those after it have a position."""
        for held in self._held:
            if held.found.stamp_ns >= found.stamp_ns:
                held.withdrawn(is_the_fix=held.found.stamp_ns == found.stamp_ns)

    @property
    def _whole(self) -> bool:
        return self._options.unit is Unit.SEGMENT

    def _find_start(self, session: Session, segment: Segment) -> Seed:
        """Looks for the position of the first frame, unless place recognition is to give it."""
        self._start = self._ahead = None
        if self._options.seed is SeedFrom.PLACES:
            return Seed.NONE
        self._start = self._seed(segment)
        if self._start is not None:
            return Seed.NEIGHBOUR
        self._ahead = None if self._whole else self._look_behind_gap(session, segment)
        return Seed.NONE if self._ahead is None else Seed.GAP

    def _covers(self, session: Session, segment: Segment) -> bool:
        if self._relocaliser is not None:
            self._relocaliser.forget()
        localiser = self._localiser_of(session, segment, self._relocaliser)
        with Robot(Front(self._settings), localiser) as robot:
            if self._start is not None:
                robot.place_at(self._start)
            frames = (logged for _, logged in self._stream(segment))
            return localises_well(robot, frames, self._options.segment_share)

    # -- the stream

    @cached_property
    def _relocaliser(self) -> Relocaliser | None:
        """One for all segments, since indexing all nodes is slow."""
        name, descriptor = self._options.relocaliser_name, self._settings.frontend.descriptor
        centre = self._merge.centre
        return None if name is None else relocaliser_in(centre, name, descriptor, self._merge.graph)

    def _localiser_of(
        self, session: Session, segment: Segment, relocaliser: Relocaliser | None
    ) -> Localiser:
        robot, centre, options = self._merge.robot, self._merge.centre, self._options
        localiser = localiser_in(
            centre,
            robot.cameras[segment.nodes[0].camera],
            self._settings,
            policy=options.ranking,
            # A lost robot gets no more attempts, since the next node tries again: four times as
            # many find 1 to 3 % more nodes (simulated drives, world 5).
            budget=Budget(options.lanes, options.rounds, lost_rounds=options.rounds),
            relocaliser=relocaliser,
            live=session.id,
            saves=True,
            graph=self._merge.graph,
            paths=self._merge.paths,
            clock=session,
        )
        if session.id not in self._iterations:
            remembered = centre.lookups.attempts([session.id]).iteration
            made = robot.last_iterations.get(session.id, -1)
            self._iterations[session.id] = max([made, *remembered.tolist()]) + _ITERATION_GAP
        localiser.resume(segment.nodes[0].driven_m, self._iterations[session.id])
        return localiser

    def _stream(self, segment: Segment) -> Iterator[tuple[StoredNode, LoggedFrame]]:
        """The nodes in the order of time, as frames of a log."""
        frames = self._merge.robot.frames
        steps = [
            OdometryStep(OdometryStatus.FIRST),
            *(OdometryStep(OdometryStatus.OK, *motion) for motion in segment.motions),
        ]
        for stored, step in zip(frames.stored(segment.nodes), steps, strict=True):
            live = as_live(frames.decode(stored), self._settings.frontend)
            yield stored, LoggedFrame(live, step)

    def _look_behind_gap(self, session: Session, segment: Segment) -> Ahead | None:
        """Looks for a segment from the end of the one before it; see `behind_gaps`."""
        before = self._last
        if before is None or before.nodes[0].session != session.id:
            return None
        end = self._merge.equivalent(before.nodes[-1].id)
        start = (
            None if end is None else position_behind_gap(end, before, segment, self._settings.gaps)
        )
        if start is None:
            return None
        localiser = self._localiser_of(session, segment, relocaliser=None)
        with Robot(Front(self._settings), localiser) as robot:
            robot.place_at(start)
            found, attempts = look_along(robot, (logged for _, logged in self._stream(segment)))
        self._merge.report.match_attempts += attempts
        return found

    def _seed(self, segment: Segment) -> Position | None:
        """Position of the first frame, by the nearest node with a known neighbour."""
        from_first = Position.at(segment.nodes[0].id)
        for node, motion in zip(segment.nodes, (None, *segment.motions), strict=True):
            if motion is not None:
                from_first = from_first.carried_on(*motion)
                if from_first.node_from_live.distance_m > _SEED_WITHIN_M:
                    return None
            known = self._known_neighbour(node.id, frozenset(EdgeKind))
            if known is not None:
                node_from_first = from_first.node_from_live.inverse()
                adjoint = node_from_first.adjoint()
                return known.carried_on(
                    node_from_first, adjoint @ from_first.covariance @ adjoint.T
                )
        return None

    def _known_neighbour(
        self, node: NodeId, kinds: frozenset[EdgeKind], before: int | None = None
    ) -> Position | None:
        """Position of a node, by its edge of least variance to nodes of the fleet map.

        Args:
            node: of the robot's map.
            before: nodes from this dense index on do not count: those of the current run, which
                carry no more information than odometry.
        """
        positions = []
        for edge in self._merge.edges_of(node):
            other = self._merge.equivalent(edge.b if edge.a == node else edge.a)
            if other is None or edge.kind not in kinds:
                continue
            if before is None or self._merge.graph.index(other.node) < before:
                positions.append(beyond(other, edge, node))
        return min(
            positions, key=lambda position: uncertainty_m2(position.covariance), default=None
        )

    # -- the outcome of a frame

    def _drop_unproved(self) -> None:
        """Withdraws fixes that are still on trial at the end of the segment, as mapping does.

        They agreed over too short a distance: an alike street would do that, too.
        """
        if not self._localiser.on_trial:
            return
        for held in self._held:
            held.withdrawn(is_the_fix=held.found.localised)

    def _release(self) -> None:
        """Omits or takes the nodes that were held back, in the order of time."""
        held, self._held = self._held, []
        for pending in held:
            node, found = pending.stored.node, pending.found
            self._remember(node, found, pending.attempts)
            reason = self._reason(pending.live, found)
            if reason is None:
                # The fleet map covers this place already.
                assert found.measured is not None
                self._merge.omit(node.id, found.measured, pending.stored.landmark_hash)
                self._link(node.id)
            else:
                self._take(pending)
                if pending is held[-1]:
                    self._localiser.settle_in(node.id)
            if found.localised:
                self._matched(node, pending.outcomes)
            moved_m = found.motion.odometry.moved_m
            self._kept.append(KeptNode(node.stamp_ns, moved_m, reason))
            self._monitor.advance("added" if reason else "covered")

    def _remember(self, node: Node, found: Localisation, attempts: list[Attempt]) -> None:
        self.attempts[node.session] += attempts
        if found.node is not None and found.node != self._visited:
            self._visited = found.node
            path, kind = path_id(node.session), PathEntryKind.REPLAYED
            entry = PathEntry(path, 0, found.node, kind, node.stamp_ns)
            self.entries[node.session].append(entry)

    def _reason(self, frame: Frame, found: Localisation) -> Reason | None:
        """Why a node is taken; None if its match can replace it for all drives that use it."""
        if self._omits is not None:
            omitted = self._omits and found.measured is not None
            return None if omitted else Reason.WHOLE_SEGMENT
        if found.localised:
            is_sure = found.inliers >= self._options.sure_inliers
            return None if is_sure else Reason.WEAK_MATCH
        if frame.status is not FrameStatus.OK:
            return Reason.UNUSABLE_FRAME
        if found.candidates:
            return Reason.NO_MATCH
        return Reason.NO_PLACE if found.attempts else Reason.NOTHING_NEAR

    def _take(self, held: Held) -> None:
        """Takes a node, with its own edges and the one to its match."""
        node, found = held.stored.node, held.found
        index = self._merge.take(held.stored, self._merge.robot.frames.decode(held.stored))
        self._taken.add(node.id)
        self._run.append(index)
        self._link(node.id)
        if found.localised:
            at = found.measured
            assert at is not None
            match = Edge(at.node, node.id, EdgeKind.MATCH, at.node_from_live, at.covariance)
            self._merge.add_edge(match)
        else:
            proximity = self._settings.mapper.proximity
            self._merge.write_edges(lay_proximity_edges(self._merge.graph, index, proximity))
        self._visited = node.id

    def _matched(self, node: Node, outcomes: Sequence[Outcome]) -> None:
        """Ends a run at a localised frame, and ties the nodes that it matched."""
        self._matched_at_m[node.session] = node.driven_m
        self._end_run()
        acceptance = self._settings.localiser.acceptance
        for edge in match_edges(self._merge.graph, outcomes, acceptance):
            self._merge.add_edge(edge)

    def _link(self, node: NodeId) -> None:
        """The robot's edges from a node to resolved nodes, moved to the equivalents of both."""
        for edge in self._merge.edges_of(node):
            a, b = self._merge.equivalent(edge.a), self._merge.equivalent(edge.b)
            if a is None or b is None or not {edge.a, edge.b} & self._taken:
                continue
            moved = recomposed(edge, a, b)
            if moved is not None:
                self._merge.add_edge(moved)

    def _end_run(self) -> None:
        run, self._run = self._run, []
        if run:
            proximity = self._settings.mapper.proximity
            self._merge.write_edges(tighten_chain(self._merge.graph, run, proximity))
