"""Mapping: frames of a drive become nodes and edges of a map (method §5).

Edges that live fixes contradict again and again: distrusted at once, removed with the session. Two
nodes that one live frame matches surely are measured relative to each other. Where the map says
otherwise, one of the edges between them joins what does not belong together. Each such frame votes
against the edges of that chain which matching made; frames that agree vote for theirs. Odometry's
own steps are not accused.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from queue import Full, Queue
from threading import Thread
from typing import Annotated, Protocol, TypeAlias

import numpy as np
from msgspec import Meta

from engram.config import PUBLIC, check_bounds
from engram.errors import ConfigError, MapError
from engram.frontend.frame import Frame, FrameStatus
from engram.frontend.frontend import scaled_to
from engram.geometry.cameras import StereoCamera
from engram.graph.graph import ChainTree, ExperienceGraph
from engram.graph.model import (
    Attempt,
    Edge,
    EdgeKind,
    Node,
    NodeId,
    PathEntry,
    PathEntryKind,
    PathId,
    Removal,
    Session,
    node_id,
)
from engram.graph.proximity import ProximityConfig, lay_proximity_edges, tighten_chain
from engram.localiser.acceptance import AcceptanceConfig, Prediction, agrees
from engram.localiser.attempts import Outcome
from engram.localiser.fixes import MOST_ON_TRIAL
from engram.localiser.localisation import (
    Hint,
    Localisation,
    LocalisationStatus,
    Position,
    ResultSink,
)
from engram.localiser.localiser import Localiser
from engram.mapper.loops import LoopSearch
from engram.maps.records import StoredSession
from engram.odometry.motion import Motion

# Most frames that wait to be written, about 40 MB; beyond it a slow disk slows the drive.
_QUEUE_LENGTH = 1000


@dataclass(frozen=True, slots=True)
class Records:
    """What one live frame adds to the map.

    Attributes:
        stamp_ns: of the frame; None for what belongs to no single frame.
        node, frame: the frame as a saved node; None if it was not saved.
        edges: from or to this node, or between others.
        attempts: of the frame.
        visit: the node that it adds to the path, and how; None if none.
    """

    stamp_ns: int | None = None
    node: Node | None = None
    frame: Frame | None = None
    edges: Sequence[Edge] = ()
    attempts: list[Attempt] = field(default_factory=list)
    visit: tuple[NodeId, PathEntryKind] | None = None


class Sink(Protocol):
    """Where the records of a drive go: a revision of a map, or a spool."""

    def hold(self, node: NodeId, frame: Frame) -> None:
        """Keeps the frame of a saved node readable until it is written."""
        ...

    def add(self, records: Records, entry: PathEntry | None) -> None:
        """Adds what one frame adds, with its step of the path if that is a new node."""
        ...

    def checkpoint(self) -> None:
        """Makes everything added so far durable."""
        ...


class Saver:
    """Writes what a drive adds, in order, on its own thread, and checkpoints at intervals.

    The newest records may be held back, as long as the fixes that they rest on may be withdrawn.
    Steps of the path are entries of it where the node changes (method §3.3).

    The next call of `put`, `release` or `finish` raises an error of the writer. Later records are
    dropped: a shorter session is better than one with holes.

    Args:
        checkpoint_every: live frames between two checkpoints; a crash loses at most these.
        waits: whether a full queue blocks the caller; else it raises.
        last: the last entry of the path that an interrupted run had stored; None for none.
    """

    def __init__(
        self,
        sink: Sink,
        path: PathId,
        checkpoint_every: int = 20,
        *,
        waits: bool = True,
        last: PathEntry | None = None,
    ) -> None:
        self._sink = sink
        self._path = path
        self._checkpoint_every = checkpoint_every
        self._waits = waits
        self._node = None if last is None else last.node
        self._sequence = 0 if last is None else last.sequence + 1
        self._held: deque[Records] = deque()
        # The records of each frame with its step of the path; None ends the thread.
        self._queue: Queue[tuple[Records, PathEntry | None] | None] = Queue(_QUEUE_LENGTH)
        self._error: BaseException | None = None
        self._thread: Thread | None = Thread(target=self._run, name="engram-saver", daemon=True)
        self._thread.start()

    def put(self, records: Records, held_back: int = 0) -> None:
        """Takes what one frame adds, and queues all but so many of the newest frames.

        The frame of a node is readable from then on, even if it is never written.
        """
        if records.node is not None and records.frame is not None:
            self._sink.hold(records.node.id, records.frame)
        self._held.append(records)
        while len(self._held) > held_back:
            records = self._held.popleft()
            self._raise_error()
            entry = self._entry(records)
            if not (records.node or records.edges or records.attempts or entry):
                continue
            try:
                self._queue.put((records, entry), block=self._waits)
            except Full:
                raise MapError(
                    f"{_QUEUE_LENGTH} frames wait to be saved: the disk is too slow for this drive"
                ) from None

    def withdraw(self, stamp_ns: int) -> None:
        """A later frame disproved the match: attempts failed; no node but its own was visited."""
        for at, one in enumerate(self._held):
            if one.stamp_ns == stamp_ns:
                failed = [replace(attempt, accepted=False) for attempt in one.attempts]
                visit = None if one.node is None else one.visit
                self._held[at] = replace(one, attempts=failed, visit=visit)

    def finish(self) -> None:
        """Writes what is queued, checkpoints and ends the thread; what is held back is dropped."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
            self._thread = None
        self._raise_error()

    def _entry(self, records: Records) -> PathEntry | None:
        """The step of the path that a frame makes; None while it stays at a node."""
        if records.visit is None or records.visit[0] == self._node or records.stamp_ns is None:
            return None
        self._node, kind = records.visit
        self._sequence += 1
        return PathEntry(self._path, self._sequence - 1, self._node, kind, records.stamp_ns)

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        since_checkpoint = 0
        while True:
            queued = self._queue.get()
            if self._error is None:
                try:
                    if queued is not None:
                        self._sink.add(*queued)
                        since_checkpoint += 1
                    if queued is None or since_checkpoint >= self._checkpoint_every:
                        self._sink.checkpoint()
                        since_checkpoint = 0
                except BaseException as error:  # raised again in the caller's thread
                    self._error = error
            if queued is None:
                return


# Uncertainty of a resumed robot's pose in the node it last matched: the match basin is wide.
_RESUMED_SIGMA_M = 3.0
_RESUMED_SIGMA_RAD = float(np.deg2rad(20.0))


class Memory(ResultSink):
    """Remembers a drive without saving a node: its path and its attempts.

    The policies `path` and `recall` use them in later drives. What fixes on trial add is held back:
    those that are withdrawn leave no trace. Frames that an interrupted run had
    remembered are only followed; the memory continues after them.

    Args:
        stored: what an interrupted run had stored of the drive; None for a new one.

    Attributes:
        removals: edges that the drive's fixes disproved, to be stored with it.
    """

    removals: Sequence[Removal] = ()

    def __init__(
        self, localiser: Localiser, saver: Saver, stored: StoredSession | None = None
    ) -> None:
        self._localiser = localiser
        self._saver = saver
        self._stored = stored
        if stored is not None and stored.last_entry is not None:
            localiser.resume(0.0, stored.next_iteration)

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """See `ResultSink`: frames of an interrupted run are not localised again."""
        if not self._is_stored(live.stamp_ns):
            return None
        assert self._stored is not None
        entry, position = self._stored.last_entry, None
        if entry and entry.stamp_ns == live.stamp_ns and entry.kind is PathEntryKind.MATCHED:
            spread = np.diag([_RESUMED_SIGMA_M**2] * 3 + [_RESUMED_SIGMA_RAD**2] * 3)
            position = self._localiser.standing_at(entry.node, live, spread)
        followed = Localisation(
            live.stamp_ns, LocalisationStatus.DEAD_RECKONING, 0, 0, 0.0, motion, resumed=True
        )
        return Hint(position, guessed_m=np.inf, found=followed)

    def keep(self, live: Frame, result: Localisation) -> Localisation:
        """See `ResultSink`."""
        if not result.resumed:
            records = Records(
                live.stamp_ns, attempts=self._localiser.attempts(), visit=match_of(result)
            )
            self._saver.put(records, self._held_back)
        return result

    def withdrawn(self, result: Localisation) -> None:
        """See `ResultSink`: the frame was not localised, and its attempts failed."""
        self._saver.withdraw(result.stamp_ns)

    def finish(self) -> None:
        """See `ResultSink`: what is still held back is kept."""
        self._saver.put(Records())

    @property
    def _held_back(self) -> int:
        """Number of the newest frames that rest on fixes on trial, at most."""
        return MOST_ON_TRIAL if self._localiser.on_trial else 0

    def _is_stored(self, stamp_ns: int) -> bool:
        """Whether an interrupted run processed the frame."""
        last_ns = None if self._stored is None else self._stored.last_stamp_ns
        return last_ns is not None and stamp_ns <= last_ns


def match_of(result: Localisation) -> tuple[NodeId, PathEntryKind] | None:
    """The visit of a localised frame; None for another."""
    return None if result.node is None else (result.node, PathEntryKind.MATCHED)


def match_edges(
    graph: ExperienceGraph, outcomes: Sequence[Outcome], config: AcceptanceConfig
) -> list[Edge]:
    """Edges between nodes that one live frame matched: their relative pose is measured.

    A measurement that contradicts the known path between two nodes gives no edge: one of the two
    matches is then wrong, and its edge would fold the map permanently. This happens when a lost
    robot tries nodes far apart.

    Args:
        graph: has all nodes of the outcomes.
        outcomes: of one live frame. All edges start at the node of the best match.
        config: allowed disagreement with the known path, as for a match.

    Returns:
        Edges of kind `MATCH`, the best match's node as `a`.
    """
    best_first = sorted(outcomes, key=lambda outcome: -outcome.match.inliers)
    seen_from = [
        Position(outcome.candidate.node, pose, covariance)
        for outcome in best_first
        if outcome.accepted
        and (pose := outcome.match.reference_from_live) is not None
        and (covariance := outcome.match.covariance) is not None
    ]
    edges = [edge_through_live(seen_from[0], other, EdgeKind.MATCH) for other in seen_from[1:]]
    return [edge for edge in edges if fits(graph, edge, config)]


def edge_through_live(a: Position, b: Position, kind: EdgeKind) -> Edge:
    """The edge from `a.node` to `b.node`, of which each sees the same live camera."""
    a_from_b = a.node_from_live @ b.node_from_live.inverse()
    adjoint = a_from_b.adjoint()
    covariance = a.covariance + adjoint @ b.covariance @ adjoint.T
    return Edge(a.node, b.node, kind, a_from_b, covariance)


def fits(graph: ExperienceGraph, edge: Edge, config: AcceptanceConfig) -> bool:
    """Whether an edge agrees with the known path between its ends; True without a path."""
    known = graph.predict(graph.index(edge.a), graph.index(edge.b))
    if known is None:
        return True
    a_from_b, covariance = known
    whole = covariance + edge.covariance
    sigma_m, sigma_rad = (
        float(np.sqrt(max(np.linalg.eigvalsh(part)[-1], 0.0)))
        for part in (whole[:3, :3], whole[3:, 3:])
    )
    return agrees(edge.a_from_b, Prediction(a_from_b, sigma_m, sigma_rad), config)


# Of a distrusted edge: nothing is predicted through it any more.
_NOWHERE = np.diag([1e3**2] * 3 + [np.pi**2] * 3)


@dataclass(frozen=True, slots=True)
class VoteConfig:
    """Settings of `EdgeVotes`.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    against: Annotated[
        int,
        Meta(ge=1, description="frames that contradict an edge before it is distrusted; at "
             "least twice as many as agree with it"),
    ] = 4  # fmt: skip
    inliers: Annotated[
        int,
        Meta(ge=0, description="fewest inliers of both matches of a vote; look-alikes reach 50"),
    ] = 60
    gross_m: Annotated[
        float, Meta(ge=0, description="least disagreement that is a contradiction, m")
    ] = 2.0
    sigmas: Annotated[
        float, Meta(ge=0, description="the same in standard deviations of the chain")
    ] = 4.0

    def __post_init__(self) -> None:
        check_bounds(self)


EdgeKey: TypeAlias = tuple[NodeId, NodeId, EdgeKind]


class EdgeVotes:
    """Votes of the frames of one drive.

    Args:
        graph: the experience graph of the drive alone: distrusted edges are changed in it.

    Attributes:
        removals: the distrusted edges, to be stored with the drive.
    """

    def __init__(self, graph: ExperienceGraph, config: VoteConfig | None = None) -> None:
        self.config = config or VoteConfig()
        self.removals: list[Removal] = []
        self._graph = graph
        self._against: Counter[EdgeKey] = Counter()
        self._agreeing: Counter[EdgeKey] = Counter()

    def count(self, stamp_ns: int, outcomes: Sequence[Outcome]) -> None:
        """Counts the votes of one localised frame, and distrusts what was contradicted too often.

        Args:
            stamp_ns: stamp of the frame.
        """
        sure = sorted(self._sure(outcomes), key=lambda found: found[0], reverse=True)
        if len(sure) < 2:
            return
        best = sure[0][1]
        measured = [edge_through_live(best, other, EdgeKind.MATCH) for _, other in sure[1:]]
        goals = [self._graph.index(edge.b) for edge in measured]
        tree = self._graph.chains_from(self._graph.index(best.node), goals=goals)
        against, agreeing = dict[EdgeKey, Edge](), dict[EdgeKey, Edge]()
        for edge, goal in zip(measured, goals, strict=True):
            if goal in tree.row_of and edge.a != edge.b:
                chain = self._chain(tree, goal)
                (against if self._contradicts(edge, tree, goal) else agreeing).update(chain)
        contradicted = {key: edge for key, edge in against.items() if key not in agreeing}
        self._agreeing.update(agreeing.keys())
        self._against.update(contradicted.keys())
        for key, edge in contradicted.items():
            most = max(self.config.against, 2 * self._agreeing[key])
            if self._against[key] >= most:
                self._distrust(key, edge, stamp_ns)

    def _sure(self, outcomes: Sequence[Outcome]) -> Iterator[tuple[int, Position]]:
        for outcome in outcomes:
            pose, covariance = outcome.match.reference_from_live, outcome.match.covariance
            if pose is None or covariance is None or outcome.match.inliers < self.config.inliers:
                continue
            yield outcome.match.inliers, Position(outcome.candidate.node, pose, covariance)

    def _contradicts(self, edge: Edge, tree: ChainTree, goal: int) -> bool:
        pose = tree.pose(goal)
        covariance = tree.error(goal).pivoted(pose.translation).covariance() + edge.covariance
        sigma_m = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))
        off_m = float(np.linalg.norm(pose.translation - edge.a_from_b.translation))
        return off_m > max(self.config.gross_m, self.config.sigmas * sigma_m)

    def _chain(self, tree: ChainTree, goal: int) -> Iterator[tuple[EdgeKey, Edge]]:
        """Edges that matching made, on the path from the tree's root to a node."""
        row = tree.row_of[goal]
        while (half := int(tree.half_edges[row])) >= 0:
            edge = self._graph.edge(half // 2)
            if edge.kind is not EdgeKind.ODOMETRY:
                yield (edge.a, edge.b, edge.kind), edge
            row = int(tree.parents[row])

    def _distrust(self, key: EdgeKey, edge: Edge, stamp_ns: int) -> None:
        count = self._against.pop(key)
        self._graph.add_edge(replace(edge, covariance=_NOWHERE))
        reason = f"{count} frames of a drive that matched nodes on both sides contradict it"
        self.removals.append(
            Removal(edge.a, edge.b, edge.kind, edge.a_from_b, reason, removed_ns=stamp_ns)
        )


@dataclass(frozen=True, slots=True)
class MapperConfig:
    """Settings of the mapper.

    Attributes:
        save_every_m, save_every_rad: motion since the last saved node after which a frame that
            did not localise is saved. Source: method §5.
        sure_inliers: a frame that matched with fewer inliers is saved all the same: the place has
            come to look different, and frames that match this one need not match its old nodes. 0
            saves none of them, as published. Source: lab/reports/constants.md.
        tie_within_m: a new experience is also tied to the session's last saved node within this
            distance, metres. Source: the search radius, method §3.
        checkpoint_every: live frames between two checkpoints of the map.
        memory_bytes: largest memory of a drive that saves no nodes, bytes; later frames are not
            remembered. About a day at 20 frames per second.
        votes: when an edge is distrusted that fixes contradict.
        proximity: which experiences are joined by dead reckoning; merging joins them alike.
    """

    landmarks: Annotated[
        int,
        Meta(
            ge=0,
            le=100_000,
            description="most landmarks of a saved node in a 512×384 image, scaled as "
            "frontend.landmarks: those of the live frame and the next ones, so that a frame in "
            "rain or at night finds more of its own there; 0: those of the live frame. "
            "Source: lab/reports/conditions.md",
        ),
        PUBLIC,
    ] = 1000
    save_every_m: Annotated[float, PUBLIC] = 1.0
    save_every_rad: Annotated[float, PUBLIC] = float(np.deg2rad(15.0))
    sure_inliers: Annotated[int, PUBLIC] = 45
    tie_within_m: float = 8.0
    checkpoint_every: Annotated[int, PUBLIC] = 20
    memory_bytes: int = 256_000_000
    votes: VoteConfig = field(default_factory=VoteConfig)
    proximity: ProximityConfig = field(default_factory=ProximityConfig)

    def __post_init__(self) -> None:
        for name in ("save_every_m", "save_every_rad", "tie_within_m"):
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise ConfigError(f"mapper: {name} is {value}, must be finite and >= 0")
        check_bounds(self)
        if self.sure_inliers < 0:
            raise ConfigError(f"mapper: sure_inliers is {self.sure_inliers}, must be >= 0")
        if self.checkpoint_every < 1:
            raise ConfigError(f"mapper: checkpoint_every is {self.checkpoint_every}, must be >= 1")

    def landmarks_for(self, camera: StereoCamera) -> int:
        """Most landmarks of a node of a camera."""
        return scaled_to(camera.width * camera.height, self.landmarks)


class Mapper(Memory):
    """Maps one session: saves nothing while frames match well, else grows an experience.

    It also remembers the drive's path and attempts. Frames that an interrupted run had mapped are
    only followed; mapping continues after the last saved node or match, whichever is later.

    Args:
        graph: the experience graph; grows.
        localiser: the session's localiser, on the same graph.
        loops: closes loops during the drive; None leaves them to the localiser's relocaliser.
        stored: what an interrupted run had stored of the session; None for a new one.

    Attributes:
        votes: of the drive's fixes on the edges of the map.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        localiser: Localiser,
        saver: Saver,
        session: Session,
        config: MapperConfig | None = None,
        loops: LoopSearch | None = None,
        stored: StoredSession | None = None,
    ) -> None:
        super().__init__(localiser, saver, stored)
        self.config = config or MapperConfig()
        self._loops = loops
        # Whether the nodes being saved are connected to the rest of the map, and the distance
        # at which the disconnected part began.
        self._joined = graph.is_only_of(session.id)
        self._alone_from_m = localiser.driven_m
        self._graph = graph
        self._session = session
        # The last saved node and the motion since, while that is known.
        self._since_saved: Position | None = None
        # Variance of the motion guessed since odometry last measured one, m².
        self._gap_m2 = 0.0
        # The experience being saved, first node first; empty while localisation succeeds.
        self._experience: list[NodeId] = []
        # Edges of loops closed since the last frame.
        self._closures: list[Edge] = []
        # Edges that rest on fixes on trial.
        self._waiting: dict[EdgeKey, Edge] = {}
        self.votes = EdgeVotes(graph, self.config.votes)
        self.removals = self.votes.removals

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """See `ResultSink`: closes the loops found so far before the frame is localised."""
        self._move_on(motion)
        followed = super().hint(live, motion)
        if followed is not None:
            return self._follow(followed, live)
        self._closures = self._close_loops(self._loops.closed()) if self._loops else []
        return None

    def may_propose(self) -> bool:
        """See `ResultSink`.

        A robot whose nodes are connected to the map is not lost, however far it drifts: loop
        closure runs during the drive.
        """
        return not self._localiser.certain or self._loops is None or not self._joined

    def may_propose_own(self) -> bool:
        """See `ResultSink`."""
        return not self._localiser.certain or self._loops is None

    def alone_m(self) -> float:
        """See `ResultSink`."""
        return 0.0 if self._joined else self._localiser.driven_m - self._alone_from_m

    def keep(self, live: Frame, result: Localisation) -> Localisation:
        """Saves a frame that did not match, or weakly; ties experiences to their neighbours."""
        if result.resumed:
            return result
        edges = self._closures + self._proved(result)
        saved: Node | None = None
        visit = match_of(result)
        if result.localised:
            edges += self._join(result)
        if self._looks_new(result) and self._worth_saving(live, result.motion):
            tied = result.localised and not self._localiser.on_trial
            saved, laid = (self._save_matched if tied else self._save)(live, result)
            edges += laid
            visit = saved.id, PathEntryKind.SAVED
        attempts = self._localiser.attempts()
        frame = live.with_further(self.config.landmarks_for(live.camera)) if saved else None
        records = Records(live.stamp_ns, saved, frame, edges, attempts, visit)
        self._saver.put(records, self._held_back)
        if saved is None:
            return result
        if self._loops is not None:
            self._loops.ask(saved, replace(live, further=None))  # its images are not kept
        return replace(result, saved=saved.id)

    def withdrawn(self, result: Localisation) -> None:
        """See `ResultSink`: no edge rests on the match."""
        super().withdrawn(result)
        self._waiting.clear()

    def _proved(self, result: Localisation) -> list[Edge]:
        """Edges that waited for their fixes; dropped if the robot is lost before these agree."""
        if self._localiser.on_trial and result.status is not LocalisationStatus.LOST:
            return []
        waiting = list(self._waiting.values())
        self._waiting.clear()
        if self._localiser.on_trial or not waiting:
            return []
        self._graph.add_edges(waiting)
        self._joined = True
        edges = [*waiting, *self._tightened(self._experience)]
        for edge in waiting:
            edges += self._beside(edge.b)
        return edges

    def _wait_with(self, edges: list[Edge]) -> None:
        """Holds edges back; a robot that stands measures the same ones again and again."""
        self._waiting |= {(edge.a, edge.b, edge.kind): edge for edge in edges}

    def _join(self, result: Localisation) -> list[Edge]:
        """Ties the experience to the matched node, and the matched nodes to each other."""
        matched = match_edges(
            self._graph, self._localiser.outcomes, self._localiser.config.acceptance
        )
        if self._localiser.on_trial:
            if not self._waiting and self._experience and self._since_saved is not None:
                assert result.measured is not None
                matched.append(edge_through_live(self._since_saved, result.measured, EdgeKind.TIE))
            self._wait_with(matched)
            return []
        self.votes.count(result.stamp_ns, self._localiser.outcomes)
        self._joined = True
        edges = self._end_experience(result)
        self._graph.add_edges(matched)
        return edges + matched

    def finish(self) -> None:
        """See `ResultSink`: waits for the lookups of the last saved nodes."""
        super().finish()
        edges = self._close_loops(self._loops.finish()) if self._loops else []
        self._saver.put(Records(edges=edges))

    def _follow(self, followed: Hint, live: Frame) -> Hint:
        """Restores the mapper's state after a frame that an interrupted run had mapped."""
        assert self._stored is not None
        if self._stored.nodes and live.stamp_ns == self._stored.nodes[-1].stamp_ns:
            saved = self._stored.nodes[-1].id
            self._experience = [saved]
            self._since_saved = Position.at(saved)
            return replace(followed, position=Position.at(saved), open_loop_m=None, guessed_m=0.0)
        if followed.position is not None:
            self._experience = []
        return followed

    def _move_on(self, motion: Motion) -> None:
        """Carries the pose in the last saved node on; drops it after too long a gap, or a jump."""
        if motion.prev_from_curr is None or motion.covariance is None:
            return
        self._gap_m2 = self._gap_m2 + motion.guessed_m**2 if motion.guessed_m else 0.0
        if self._since_saved is None:
            return
        if motion.jumped or self._gap_m2 > self._localiser.config.greatest_gap_m**2:
            self._since_saved = None
        else:
            self._since_saved = self._since_saved.carried_on(
                motion.prev_from_curr, motion.covariance
            )

    def _looks_new(self, result: Localisation) -> bool:
        """Whether the frame's view is new to the map."""
        return not result.localised or result.inliers < self.config.sure_inliers

    def _worth_saving(self, live: Frame, motion: Motion) -> bool:
        """Whether a frame is usable and far enough from the last saved one (method §5).

        During a long gap of odometry none is: a node without an edge has no use.
        """
        if live.status is not FrameStatus.OK or motion.suspected:
            return False
        if self._since_saved is None:
            return not motion.guessed_m
        moved = self._since_saved.node_from_live
        return (
            moved.distance_m >= self.config.save_every_m
            or moved.angle_rad >= self.config.save_every_rad
        )

    def _save(self, live: Frame, result: Localisation) -> tuple[Node, list[Edge]]:
        """Saves the frame as a node, chained to the experience or tied to where it began.

        So is a frame that matched weakly on trial: if the match is withdrawn, the chain stays.
        """
        node, position, edges = self._node_of(live), result.measured, []
        unknown = self._localiser.contradicted
        if self._since_saved is None or unknown:
            self._joined = len(self._graph) == 1  # motion from earlier nodes is unknown
            self._alone_from_m = self._localiser.driven_m
        begins = not self._experience
        if not begins and self._since_saved is not None:
            edges.append(_edge(self._since_saved, node.id, EdgeKind.ODOMETRY))
        if position is not None and self._localiser.certain and (begins or result.localised):
            tie = _edge(position, node.id, EdgeKind.TIE)
            if self._localiser.on_trial:
                self._wait_with([tie])
            elif not unknown:
                edges.append(tie)
            if begins:
                edges += self._edge_to_last_saved(position, node.id, EdgeKind.TIE)
        self._graph.add_edges(edges)
        edges += self._beside(node.id)
        self._experience.append(node.id)
        self._since_saved = Position.at(node.id)
        if not self._waiting and not unknown:
            self._localiser.settle_in(node.id)
        return node, edges

    def _save_matched(self, live: Frame, result: Localisation) -> tuple[Node, list[Edge]]:
        """Saves a frame that matched weakly: tied by its match, and chained to the last one."""
        position = result.measured
        assert position is not None
        node = self._node_of(live)
        tie = _edge(position, node.id, EdgeKind.TIE)
        self._graph.add_edge(tie)
        acceptance = self._localiser.config.acceptance
        chained = [
            edge
            for edge in self._edge_to_last_saved(position, node.id, EdgeKind.ODOMETRY)
            if fits(self._graph, edge, acceptance)
        ]
        self._graph.add_edges(chained)
        self._since_saved = Position.at(node.id)
        return node, [tie, *chained]

    def _node_of(self, live: Frame) -> Node:
        """Adds the frame to the graph."""
        node = Node(
            node_id(self._session.id, live.stamp_ns),
            self._session.id,
            live.stamp_ns,
            live.camera.id,
            self._localiser.driven_m,
        )
        self._graph.add_node(node)
        return node

    def _close_loops(self, closures: list[Edge]) -> list[Edge]:
        """Adds edges to recognised places; the nodes around them become candidates."""
        edges = list(closures)
        self._graph.add_edges(closures)
        for closure in closures:
            self._joined = True
            edges += self._beside(closure.b)
        return edges

    def _edge_to_last_saved(self, position: Position, node: NodeId, kind: EdgeKind) -> list[Edge]:
        """Also ties a new experience to this session's last one if that is still near.

        In between the robot was localised only briefly, perhaps in a distant node: without this
        edge the two would be unconnected neighbours.
        """
        last = self._since_saved
        if last is None or last.node == position.node:
            return []
        if last.node_from_live.distance_m > self.config.tie_within_m:
            return []
        return [_edge(last, node, kind)]

    def _end_experience(self, localisation: Localisation) -> list[Edge]:
        """Ties the last node of the experience to the matched node."""
        experience, self._experience = self._experience, []
        if not experience or self._since_saved is None:
            return []
        assert localisation.measured is not None
        tie = edge_through_live(self._since_saved, localisation.measured, EdgeKind.TIE)
        self._graph.add_edge(tie)
        return [tie, *self._tightened(experience)]

    def _tightened(self, experience: list[NodeId]) -> list[Edge]:
        chain = [self._graph.index(node) for node in experience]
        return tighten_chain(self._graph, chain, self.config.proximity)

    def _beside(self, node: NodeId) -> list[Edge]:
        return lay_proximity_edges(self._graph, self._graph.index(node), self.config.proximity)


def _edge(position: Position, node: NodeId, kind: EdgeKind) -> Edge:
    """The edge from the position's node to the node that the live frame was saved as."""
    return Edge(position.node, node, kind, position.node_from_live, position.covariance)
