"""The mapper: localise, else save an experience (method §5, [L15] §III, [1])."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from engram.errors import ConfigError
from engram.frontend import Frame, FrameStatus
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    Edge,
    EdgeKind,
    Node,
    NodeId,
    PathEntryKind,
    Session,
    node_id,
    path_id,
)
from engram.graph.proximity import ProximityConfig, lay_proximity_edges, tighten_chain
from engram.localiser import Hint, Localisation, LocalisationStatus, Localiser, Position
from engram.mapper.edges import edge_through_live, fits, match_edges
from engram.mapper.loops import LoopSearch
from engram.mapper.memory import Memory, match_of
from engram.mapper.saver import Records, Saver
from engram.mapper.votes import EdgeVotes, VoteConfig
from engram.maps import StoredSession
from engram.odometry import Motion

EdgeKey: TypeAlias = tuple[NodeId, NodeId, EdgeKind]


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

    save_every_m: float = 1.0
    save_every_rad: float = float(np.deg2rad(15.0))
    sure_inliers: int = 60
    tie_within_m: float = 8.0
    checkpoint_every: int = 20
    memory_bytes: int = 256_000_000
    votes: VoteConfig = field(default_factory=VoteConfig)
    proximity: ProximityConfig = field(default_factory=ProximityConfig)

    def __post_init__(self) -> None:
        for name in ("save_every_m", "save_every_rad", "tie_within_m"):
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise ConfigError(f"mapper: {name} is {value}, must be finite and >= 0")
        if self.sure_inliers < 0:
            raise ConfigError(f"mapper: sure_inliers is {self.sure_inliers}, must be >= 0")
        if self.checkpoint_every < 1:
            raise ConfigError(f"mapper: checkpoint_every is {self.checkpoint_every}, must be >= 1")


class Mapper(Memory):
    """Maps one session: saves nothing while frames match well, else grows an experience.

    It also remembers the drive's path and attempts. Frames that an interrupted run had mapped are
    only followed; mapping continues after the last saved node or match, whichever is later.

    Args:
        graph: the experience graph; grows.
        localiser: the session's localiser, on the same graph.
        saver: writes the additions.
        session: the drive.
        config: settings.
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
        super().__init__(localiser, saver, path_id(session.id), stored)
        self.config = config or MapperConfig()
        self._loops = loops
        # Whether the nodes being saved are connected to the rest of the map, and the distance
        # at which the disconnected part began.
        self._joined = bool((graph.sessions == graph.session_number(session.id)).all())
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

    def hint(self, live: Frame, motion: Motion) -> Hint | None:
        """See `Keeper`: closes the loops found so far before the frame is localised."""
        self._move_on(motion)
        followed = super().hint(live, motion)
        if followed is not None:
            return self._follow(followed, live)
        self._closures = self._close_loops(self._loops.closed()) if self._loops else []
        return None

    def may_propose(self, *, certain: bool) -> bool:
        """See `Keeper`.

        A robot whose nodes are connected to the map is not lost, however far it drifts: loop
        closure runs during the drive.
        """
        return not certain or self._loops is None or not self._joined

    def may_propose_own(self, *, certain: bool) -> bool:
        """See `Keeper`."""
        return not certain or self._loops is None

    def alone_m(self) -> float:
        """See `Keeper`."""
        return 0.0 if self._joined else self._localiser.driven_m - self._alone_from_m

    def keep(self, live: Frame, found: Localisation) -> Localisation:
        """Saves a frame that did not match, or weakly; ties experiences to their neighbours.

        Raises:
            MapError: an earlier frame could not be written.
        """
        if found.resumed:
            return found
        edges = self._closures + self._proved(found)
        saved: Node | None = None
        visit = match_of(found)
        if found.localised:
            edges += self._join(found)
        if self._looks_new(found) and self._worth_saving(live, found.motion):
            save = self._save_matched if found.localised else self._save
            saved, laid = save(live, found.measured)
            edges += laid
            visit = saved.id, PathEntryKind.SAVED
        self._put(live, Records(node=saved, frame=live if saved else None, edges=edges), visit)
        if saved is None:
            return found
        if self._loops is not None:
            self._loops.ask(saved, live)
        return replace(found, saved=saved.id)

    def withdrawn(self, found: Localisation) -> None:
        """See `Keeper`: no edge rests on the match."""
        super().withdrawn(found)
        self._waiting.clear()

    def _proved(self, found: Localisation) -> list[Edge]:
        """Edges that waited for their fixes; dropped if the robot is lost before these agree."""
        if self._localiser.on_trial and found.status is not LocalisationStatus.LOST:
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

    def _join(self, found: Localisation) -> list[Edge]:
        """Ties the experience to the matched node, and the matched nodes to each other."""
        matched = match_edges(
            self._graph, self._localiser.outcomes, self._localiser.config.acceptance
        )
        if self._localiser.on_trial:
            if not self._waiting and self._experience and self._since_saved is not None:
                assert found.measured is not None
                matched.append(edge_through_live(self._since_saved, found.measured, EdgeKind.TIE))
            self._wait_with(matched)
            return []
        self.votes.count(found.stamp_ns, self._localiser.outcomes)
        self._joined = True
        edges = self._end_experience(found)
        self._graph.add_edges(matched)
        return edges + matched

    def finish(self) -> None:
        """See `Keeper`: waits for the lookups of the last saved nodes.

        Raises:
            MapError: an earlier frame could not be written.
        """
        super().finish()
        edges = self._close_loops(self._loops.finish()) if self._loops else []
        if edges:
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

    def _looks_new(self, found: Localisation) -> bool:
        """Whether the frame's view is new to the map; a match on trial does not decide that."""
        if not found.localised:
            return True
        return found.inliers < self.config.sure_inliers and not self._localiser.on_trial

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

    def _save(self, live: Frame, position: Position | None) -> tuple[Node, list[Edge]]:
        """Saves the frame as a node, chained to the experience or tied to where it began."""
        node = self._node_of(live)
        edges = []
        unknown = self._localiser.told_otherwise
        if self._since_saved is None or unknown:
            self._joined = len(self._graph) == 1  # motion from earlier nodes is unknown
            self._alone_from_m = self._localiser.driven_m
        if self._experience and self._since_saved is not None:
            edges.append(_edge(self._since_saved, node.id, EdgeKind.ODOMETRY))
        elif not self._experience and position is not None and self._localiser.certain:
            tie = _edge(position, node.id, EdgeKind.TIE)
            if self._localiser.on_trial:
                self._wait_with([tie])
            elif not unknown:
                edges.append(tie)
            edges += self._edge_to_last_saved(position, node.id, EdgeKind.TIE)
        self._graph.add_edges(edges)
        edges += self._beside(node.id)
        self._experience.append(node.id)
        self._since_saved = Position.at(node.id)
        if not self._waiting and not unknown:
            self._localiser.settle_in(node.id)
        return node, edges

    def _save_matched(self, live: Frame, position: Position | None) -> tuple[Node, list[Edge]]:
        """Saves a frame that matched weakly: tied by its match, and chained to the last one."""
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
