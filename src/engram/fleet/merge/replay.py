"""Replaying a robot's segments in the centre as if they were live streams (SPEC §7 MERGE 3)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

from engram.errors import ConfigError
from engram.fleet.merge.behind_gaps import FoundNode, look_along, position_behind_gap
from engram.fleet.merge.centre import Centre
from engram.fleet.merge.handed_in import HandedIn
from engram.fleet.merge.parts import Parts
from engram.fleet.merge.positions import beyond, recomposed, seen_from, uncertainty_m2
from engram.fleet.merge.report import Reason, Seed, SegmentReport
from engram.fleet.merge.segments import Segment
from engram.frontend import Frame, FrameStatus
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
)
from engram.graph.proximity import lay_proximity_edges, tighten_chain
from engram.localiser import (
    RELOCALISERS,
    Budget,
    Localisation,
    LocalisationStatus,
    Localiser,
    Position,
    Relocaliser,
)
from engram.localiser.attempts import Outcome
from engram.mapper import match_edges
from engram.maps import BulkWriter, StoredNode
from engram.monitor import Monitor
from engram.odometry import GapFiller, Motion, OdometryStatus, OdometryStep
from engram.ranking import check_for_robot
from engram.robot import Settings

# A segment is seeded from a neighbour this far along it: farther, places are looked up instead.
# Source: the distance after which own nodes are neighbours again (SPEC §3.1).
_SEED_WITHIN_M = 30.0
# What measured a relation, and did not dead-reckon it.
_MEASURED = frozenset({EdgeKind.ODOMETRY, EdgeKind.MATCH, EdgeKind.TIE, EdgeKind.BRIDGE})
# Iterations between two segments of a session: a match in one vouches for nothing in the other.
_ITERATION_GAP = 100


@dataclass(frozen=True, slots=True)
class MergeOptions:
    """How maps are merged.

    Attributes:
        policy: key of `POLICIES`.
        lanes, rounds: the budget of each replayed frame, lost or not; a count, never a deadline,
            so that the same input gives the same map.
        relocaliser: key of `RELOCALISERS`, for segments without a known neighbour; None for none.
        author: who merges; None for the robots whose drives are handed in.
        sure_inliers: a node that other drives of the robot's map matched is omitted only for a
            match of so many inliers: what localised by the node need not localise by another that
            the node itself barely matches. 0 omits for every match, as [G16] does. What it
            costs and brings is in docs/results-fleet.md.
    """

    policy: str = "recall"
    lanes: int = 2
    rounds: int = 4
    relocaliser: str | None = "fabmap"
    author: str | None = None
    sure_inliers: int = 40

    def __post_init__(self) -> None:
        check_for_robot(self.policy)
        Budget(self.lanes, self.rounds)  # refuses what is no budget
        if self.relocaliser is not None and self.relocaliser not in RELOCALISERS:
            raise ConfigError(
                f"relocaliser {self.relocaliser!r} is unknown; known: {', '.join(RELOCALISERS)}"
            )
        if self.sure_inliers < 0:
            raise ConfigError(f"sure_inliers is {self.sure_inliers}, must be 0 or more")


class Replay:
    """Replays segments one after another and writes what the centre takes.

    Args:
        centre: grows.
        robot: whose segments they are.
        writer: the open revision.
        settings: of localiser and mapper.
        options: policy and budget.
        relocaliser: shared by all segments.
        monitor: hears of each node what became of it, and is asked behind each whether to go on.

    Attributes:
        edges: how many were written.
        match_attempts: how many were made.
        proposed_attempts: how many of them at nodes that the relocaliser proposed.
        lookups: for how many frames the relocaliser was asked.
        attempts: those to be remembered, by session, in the order of iterations.
        entries: what the replay matched, by session, in the order of time; not yet numbered.
    """

    def __init__(
        self,
        centre: Centre,
        robot: HandedIn,
        writer: BulkWriter,
        settings: Settings,
        options: MergeOptions,
        relocaliser: Relocaliser | None,
        monitor: Monitor,
    ) -> None:
        self.edges = 0
        self.match_attempts = 0
        self.proposed_attempts = 0
        self.lookups = 0
        self.attempts: dict[SessionId, list[Attempt]] = {}
        self.entries: dict[SessionId, list[PathEntry]] = {}
        self._centre = centre
        self._robot = robot
        self._writer = writer
        self._settings = settings
        self._options = options
        self._relocaliser = relocaliser
        self._monitor = monitor
        self._taken: set[NodeId] = set()
        self._parts = Parts()
        self._run: list[int] = []  # nodes taken one after another, by their dense indices
        self._iterations: dict[SessionId, int] = {}
        # How far each drive had come when the centre last knew it.
        self._matched_at_m: dict[SessionId, float] = {}
        self._last: Segment | None = None  # the one that was replayed last
        # Found behind gaps, before their turn came.
        self._looked_up: dict[NodeId, FoundNode] = {}

    def segment(self, session: Session, segment: Segment) -> SegmentReport:
        """Replays one segment: what localises is omitted, the rest is taken (SPEC §7 MERGE 3).

        Taken is, too, what others rely on and the centre barely shows; see `MergeOptions`.
        """
        report = SegmentReport(str(session.id), session.robot, segment.nodes[0].stamp_ns)
        seed = self._seed(segment)
        if seed is not None:
            report.seed = Seed.NEIGHBOUR
        elif self._look_behind_gap(session, segment):
            report.seed = Seed.GAP
        self._last = segment
        if self._relocaliser is not None:
            self._relocaliser.forget()
        with self._localiser(session, segment, self._relocaliser) as localiser:
            if seed is not None:
                self._start_at(localiser, seed, segment.nodes[0])
            for stored, motion in self._stream(segment):
                frame = self._robot.store.frames.decode(stored)
                localiser.move(motion)
                found, outcomes = self._localise(localiser, stored.node, frame)
                reason = self._reason(stored.node, frame, found)
                if reason is None:
                    self._omit(stored, found)
                    report.omit()
                else:
                    self._take(stored, frame, localiser, found)
                    report.take(stored.node.stamp_ns, _moved_m(motion), reason)
                if found.status is LocalisationStatus.LOCALISED:
                    self._matched(stored.node, outcomes)
                    report.seed = Seed.PLACE if report.seed is Seed.NONE else report.seed
                self.match_attempts += found.attempts
                self.proposed_attempts += found.proposed
                self.lookups += "places" in found.stage_ms
                self._monitor.advance("added" if reason else "covered")
                self._monitor.check()
            self._end_run()
            self._remember(session, localiser)
        return report

    # -- the stream

    def _localiser(
        self, session: Session, segment: Segment, relocaliser: Relocaliser | None
    ) -> Localiser:
        centre, options = self._centre.opened, self._options
        localiser = centre.localiser(
            self._robot.contents.cameras[segment.nodes[0].camera],
            self._settings,
            policy=options.policy,
            # The lost get no more, for the next node asks again, from a step on: four times as
            # many attempts find one to three nodes more in a hundred.
            budget=Budget(options.lanes, options.rounds, lost_rounds=options.rounds),
            relocaliser=relocaliser,
            live=session.id,
            saves=True,
            clock=session,
        )
        if session.id not in self._iterations:
            made = self._robot.last_iterations.get(session.id, -1)
            made = max(made, centre.last_iterations.get(session.id, -1))
            self._iterations[session.id] = made + _ITERATION_GAP
        localiser.replay_from(segment.nodes[0].driven_m, self._iterations[session.id])
        return localiser

    def _stream(self, segment: Segment) -> Iterator[tuple[StoredNode, Motion]]:
        """The nodes in the order of time, each with its motion since the one before."""
        gaps, steps = GapFiller(), [OdometryStep(OdometryStatus.FIRST)]
        for (before, _), edge in zip(pairwise(segment.nodes), segment.steps, strict=True):
            _, prev_from_curr, covariance = seen_from(edge, before.id)
            steps.append(OdometryStep(OdometryStatus.OK, prev_from_curr, covariance))
        for stored, step in zip(self._robot.store.frames.stored(segment.nodes), steps, strict=True):
            yield stored, gaps.motion(step, stored.node.stamp_ns)

    def _localise(
        self, localiser: Localiser, node: Node, frame: Frame
    ) -> tuple[Localisation, list[Outcome]]:
        """One frame; where the robot itself measured how it lies to a known node, from there."""
        looked_up = self._looked_up.pop(node.id, None)
        if looked_up is not None:
            position = looked_up.localisation.position
            assert position is not None
            localiser.start_at(position)
            return looked_up.localisation, looked_up.outcomes
        known = self._known_neighbour(node.id, _MEASURED, self._run[0]) if self._run else None
        if known is not None:
            self._start_at(localiser, known, node)
        found = localiser.localise(frame)
        return found, localiser.outcomes

    def _start_at(self, localiser: Localiser, position: Position, node: Node) -> None:
        """A robot that only its own nodes vouch for is as lost as it was when it saved them."""
        open_loop_m = 0.0
        if self._parts.is_apart(position.node):
            open_loop_m = node.driven_m - self._matched_at_m.get(node.session, -math.inf)
        localiser.start_at(position, open_loop_m)

    def _look_behind_gap(self, session: Session, segment: Segment) -> bool:
        """Whether a segment is found from where the one before it ended; see `behind_gaps`."""
        before = self._last
        if before is None or before.nodes[0].session != session.id:
            return False
        end = self._centre.equivalent(before.nodes[-1].id)
        start = None if end is None else position_behind_gap(end, before, segment)
        if start is None:
            return False
        frames = (
            (stored.node.id, self._robot.store.frames.decode(stored), motion)
            for stored, motion in self._stream(segment)
        )
        with self._localiser(session, segment, relocaliser=None) as localiser:
            found, attempts = look_along(localiser, start, frames)
        self.match_attempts += attempts
        if found is not None:
            self._looked_up[found.node] = found
        return found is not None

    def _seed(self, segment: Segment) -> Position | None:
        """Where the first frame is, by the nearest node of the segment with a known neighbour."""
        from_first = Position.at(segment.nodes[0].id)
        for number, node in enumerate(segment.nodes):
            if number:
                _, motion, covariance = seen_from(
                    segment.steps[number - 1], segment.nodes[number - 1].id
                )
                from_first = from_first.carried_on(motion, covariance)
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
        """Where a node is, by the surest of its edges to nodes that the centre knows.

        Args:
            node: of the robot's map.
            kinds: of the edges that count.
            before: nodes from this dense index on do not count: those of the run being taken,
                which say no more than odometry does.
        """
        found = []
        for edge in self._robot.edges_of.get(node, ()):
            other = self._centre.equivalent(edge.b if edge.a == node else edge.a)
            if other is None or edge.kind not in kinds:
                continue
            if before is None or self._centre.graph.index(other.node) < before:
                found.append(beyond(other, edge, node))
        return min(found, key=lambda one: uncertainty_m2(one.covariance), default=None)

    # -- what becomes of a frame

    def _reason(self, node: Node, frame: Frame, found: Localisation) -> Reason | None:
        """Why a node is taken; None where what it matched will do for all that localised by it."""
        if found.status is LocalisationStatus.LOCALISED:
            is_sure = found.inliers >= self._options.sure_inliers
            return None if is_sure or node.id not in self._robot.relied_on else Reason.WEAK_MATCH
        if frame.status is not FrameStatus.OK:
            return Reason.UNUSABLE_FRAME
        if found.candidates:
            return Reason.NO_MATCH
        return Reason.NO_PLACE if found.attempts else Reason.NOTHING_NEAR

    def _omit(self, stored: StoredNode, found: Localisation) -> None:
        """The centre shows this place alike already."""
        node = stored.node.id
        position = _measured(found)
        self._writer.add_omission(self._centre.omit(node, position, stored.landmark_hash))
        self._link(node)

    def _take(
        self, stored: StoredNode, frame: Frame, localiser: Localiser, found: Localisation
    ) -> None:
        """A node that the centre is lacking, with its own edges and that to what it matched."""
        node = stored.node
        index = self._centre.graph.add_node(node)
        self._writer.add_node(stored, frame)
        self._taken.add(node.id)
        self._parts.take(node.id)
        self._run.append(index)
        self._link(node.id)
        if found.node is not None:
            at = _measured(found)
            match = Edge(at.node, node.id, EdgeKind.MATCH, at.node_from_live, at.covariance)
            self._add_edge(match)
        self._write(lay_proximity_edges(self._centre.graph, index))
        localiser.settle_in(node.id, node.stamp_ns)

    def _matched(self, node: Node, outcomes: list[Outcome]) -> None:
        """The robot knows where it is: a run ends, and what one frame matched lies together."""
        self._matched_at_m[node.session] = node.driven_m
        self._end_run()
        acceptance = self._settings.localiser.acceptance
        for edge in match_edges(self._centre.graph, outcomes, acceptance):
            self._add_edge(edge)

    def _link(self, node: NodeId) -> None:
        """The robot's edges from a node to what is resolved already, to the equivalents of both."""
        for edge in self._robot.edges_of.get(node, ()):
            a, b = self._centre.equivalent(edge.a), self._centre.equivalent(edge.b)
            if a is None or b is None or not {edge.a, edge.b} & self._taken:
                continue
            moved = recomposed(edge, a, b)
            if moved is not None:
                self._add_edge(moved)

    def _end_run(self) -> None:
        """Nodes were taken one after another up to here: their far end is tied now, or never."""
        run, self._run = self._run, []
        if run:
            self._write(tighten_chain(self._centre.graph, run))

    def _add_edge(self, edge: Edge) -> None:
        """Adds an edge; of two with one key, moved from different nodes, the surer one stays."""
        known = self._centre.graph.find_edge(edge.a, edge.b, edge.kind)
        if known is None or uncertainty_m2(edge.covariance) < uncertainty_m2(known.covariance):
            self._centre.graph.add_edge(edge)
            self._write([edge])

    def _write(self, edges: list[Edge]) -> None:
        """Edges that are in the graph already."""
        for edge in edges:
            self._writer.add_edge(edge)
            self._parts.join(edge)
        self.edges += len(edges)

    def _remember(self, session: Session, localiser: Localiser) -> None:
        """Attempts and matches of a segment, for the session's attempts and its path."""
        self._iterations[session.id] = localiser.iteration + _ITERATION_GAP
        self.attempts.setdefault(session.id, []).extend(localiser.take_attempts())
        self.entries.setdefault(session.id, []).extend(
            replace(entry, kind=PathEntryKind.REPLAYED)
            for entry in localiser.walk.take_new()
            if entry.kind is PathEntryKind.MATCHED
        )


def _measured(found: Localisation) -> Position:
    """Where a frame that localised is."""
    assert found.node is not None
    assert found.node_from_live is not None
    assert found.covariance is not None
    return Position(found.node, found.node_from_live, found.covariance)


def _moved_m(motion: Motion) -> float:
    """How far a node is from the one before by its edge; 0 for a segment's first."""
    measured = motion.odometry.prev_from_curr
    return 0.0 if measured is None else measured.distance_m
