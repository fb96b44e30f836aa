"""The localiser: its inputs, and the one step from a frame to a position (method §3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Self
from uuid import uuid5

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Frame, FrameStatus
from engram.frontend.frontend import FrontendConfig
from engram.graph.basin import MatchBasin
from engram.graph.clock import Clocked, day_of, hour_of_day
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    ENGRAM_NAMESPACE,
    Attempt,
    LandmarkSource,
    NodeId,
    Session,
    SessionId,
    node_id,
    path_id,
)
from engram.graph.neighbourhood import Neighbourhood, Search
from engram.graph.paths import PathMemory
from engram.graph.proximity import breadth_first
from engram.localiser.acceptance import Lenses, Prediction, Rule
from engram.localiser.attempts import (
    Attempter,
    Candidate,
    Matcher,
    Outcome,
    add_outcomes,
    alternate,
    split_at_first_success,
    stored_attempts,
)
from engram.localiser.fixes import Fixes, best_success
from engram.localiser.localisation import (
    NO_SINK,
    Budget,
    Localisation,
    LocalisationStatus,
    Position,
    ResultSink,
    StageClock,
)
from engram.localiser.relocalisation import Relocaliser
from engram.localiser.settings import LocaliserConfig, NeighbourhoodSearch, PathEntries, Success
from engram.localiser.tracking import Track
from engram.odometry.motion import UNMOVED, Motion
from engram.odometry.step import OdometryStatus
from engram.processes import cores
from engram.ranking.context import Background, Foreseen, RankingContext, RankingPolicy
from engram.ranking.recent import AttemptHistory

# For a drive without an id: equal input still gives equal results.
UNNAMED_LIVE_SESSION = SessionId(uuid5(ENGRAM_NAMESPACE, "live"))


@dataclass(frozen=True, slots=True)
class MapParts:
    """What a localiser reads of a map; graph and paths may grow.

    Attributes:
        background: what policies may use of the map beyond its graph and paths.
        search: stands for the graph's own `neighbourhood`, such as one with a cache that the
            localisers of one drive on a fixed graph share; None for that itself. It is not asked
            where the settings want another search.
    """

    graph: ExperienceGraph
    paths: PathMemory
    frames: LandmarkSource
    background: Background = field(default_factory=Background)
    search: Callable[..., Neighbourhood] | None = None


@dataclass(frozen=True, slots=True)
class InForce:
    """By what a localiser localises.

    Attributes:
        budget: attempts per frame.
        config: its settings; neighbourhood, path entries and memory as its parts have them.
    """

    policy: str
    budget: Budget
    config: LocaliserConfig


@dataclass(frozen=True, slots=True)
class LiveDrive:
    """The drive whose frames are localised.

    Attributes:
        live: its session; the UUID seeds the matcher, so that the same drive gives the same
            results.
        saves: whether it is being mapped: then its own recent nodes are not candidates.
        clock: time zone and location of its stamps; None if unknown.
        frontend: settings of the front-end that makes its frames.
    """

    basin: MatchBasin
    live: SessionId = UNNAMED_LIVE_SESSION
    saves: bool = False
    clock: Clocked | None = None
    frontend: FrontendConfig = field(default_factory=FrontendConfig)


_PREFETCH = 16
# Nodes near each weak match of a lost robot to try first: they would confirm it.
_CONFIRMING = 6


class Localiser:
    """Localises the frames of one session, one after another.

    Not thread-safe: each session has its own localiser. The graph and the path memory may grow
    between calls.

    Args:
        budget: how many attempts a frame may make.
        relocaliser: proposes nodes to a lost robot; with None it tries the nodes near its dead
            reckoning, within a growing radius.
        matcher: the first half of an attempt; None matches with the landmarks of `known`.
        threads: how many threads the lanes share, the caller's included; None for one each. A
            given `matcher` runs on the caller's.
    """

    def __init__(
        self,
        known: MapParts,
        drive: LiveDrive,
        *,
        policy: RankingPolicy,
        budget: Budget,
        relocaliser: Relocaliser | None,
        config: LocaliserConfig | None = None,
        matcher: Matcher | None = None,
        threads: int | None = None,
    ) -> None:
        self.config = config or LocaliserConfig()
        self.live = drive.live
        self._clock = drive.clock
        self._own_session = drive.live if drive.saves else None
        self._own_path = path_id(drive.live)
        self._basin = drive.basin
        self._graph = known.graph
        self._paths = known.paths
        self._background = known.background
        self._policy = policy
        self._budget = budget
        self._relocaliser = relocaliser
        self._search = self._search_of(known)
        # On one core each hand-over between threads would only cost.
        lanes = min(budget.lanes, threads or budget.lanes) if cores() > 1 else 1
        self._attempter = Attempter(known.frames, self.config, matcher, lanes)
        self._lenses = self._lenses_of_map()
        self._history = AttemptHistory(self.config.recent)
        # The published rule knows no more than the last match.
        once = self.config.acceptance.rule is Rule.INLIERS
        doubt = 0.0 if once else self.config.earlier_doubt
        self._track = Track(known.graph, doubt, self.config.greatest_gap_m)
        self._fixes = Fixes(
            known.graph,
            self._track,
            self._nodes_near,
            self._attempter,
            self.config,
            drive.frontend,
        )
        self._open_loop_m = 0.0
        self._driven_m = 0.0
        self._motion = UNMOVED
        self._outcomes: list[Outcome] = []
        # Attempts of the last frame that its first success made useless.
        self._beyond: list[Outcome] = []
        # Reference node and neighbourhood of the last frame's attempts.
        self._reference: NodeId | None = None
        self._near: Neighbourhood | None = None
        self._looked_up = False
        self._damaged: set[int] = set()
        self._new_damaged: tuple[NodeId, ...] = ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def position(self) -> Position | None:
        """The robot's position by its last match or saved node; None if unknown."""
        return self._track.measured

    @property
    def best_position(self) -> Position | None:
        """The same, fused with the matches before that."""
        return self._track.best

    @property
    def graph(self) -> ExperienceGraph:
        """The experience graph."""
        return self._graph

    @property
    def relocaliser(self) -> Relocaliser | None:
        """What proposes nodes to a lost robot."""
        return self._relocaliser

    def close(self) -> None:
        """Ends the threads of the lanes."""
        self._attempter.close()

    @property
    def driven_m(self) -> float:
        """Odometry distance from the session's start, metres."""
        return self._driven_m

    @property
    def outcomes(self) -> list[Outcome]:
        """Outcomes of the attempts for the last frame, in ranked order."""
        return self._outcomes

    @property
    def attempted(self) -> list[Outcome]:
        """The same, and those of its lanes that the first success of the frame made useless."""
        return [*self._outcomes, *self._beyond]

    @property
    def neighbourhood(self) -> Neighbourhood | None:
        """Candidates Y of the last frame; None if it was not usable or the position was unknown."""
        return self._near

    @property
    def in_force(self) -> InForce:
        """By what it localises, read from its parts."""
        found = replace(
            self.config,
            neighbourhood=self._searched_by(),
            path_entries=PathEntries.of(self._paths.kinds),
            recent=self._history.config,
        )
        return InForce(self._policy.name, self._budget, found)

    def best_matched(self) -> Frame | None:
        """The node's frame that the last one matched best, right or not; none of its own drive."""
        tried = [
            outcome
            for outcome in self._outcomes
            if outcome.candidate.prediction is not None
            and not outcome.damaged
            and self._graph.node(outcome.candidate.index).session != self.live
        ]
        best = max(tried, key=lambda one: one.match.inliers, default=self._fixes.lookalike)
        return None if best is None else self._attempter.frame(best.candidate.node)

    def attempts(self) -> list[Attempt]:
        """The last frame's attempts that had a prediction, as a map stores them (method §3.5)."""
        if self._near is None or self._reference is None:
            return []
        return stored_attempts(
            self.iteration, self._near, self._reference, self._outcomes, self._policy.name
        )

    def place_at(
        self,
        position: Position,
        open_loop_m: float | None = 0.0,
        guessed_m: float = 0.0,
        agreed: int = 0,
        said: bool = False,
    ) -> None:
        """Sets the position, as an operator or another localiser would.

        Args:
            open_loop_m: distance driven since the last match with the map, metres; None keeps
                the count.
            guessed_m: standard deviation of the motion guessed since then, metres.
            agreed: number of fixes that confirm it; 0 for a position that only the caller supplied.
            said: whether the caller supplied it, which may be wrong if the robot was certain.
        """
        self._fixes.forget(agreed, contradicted=said and self.certain)
        self._track.set(position)
        if open_loop_m is not None:
            self._open_loop_m = open_loop_m
        self._track.guessed_m2 = guessed_m**2

    def standing_at(self, node: NodeId, live: Frame, covariance: NDArray[np.float64]) -> Position:
        """Position of a robot standing where the node was recorded; see `Position.mounted`.

        Args:
            live: the live frame.
            covariance: (6, 6) float64 of the pose, left perturbation, [translation in m, rotation
                in rad].
        """
        known = self._graph.node(self._graph.index(node)).camera
        camera = self._background.cameras.get(known, live.camera)
        return Position.mounted(node, camera, live.camera, covariance)

    def lose(self) -> None:
        """Discards the position: the robot was restarted or carried elsewhere."""
        self._track.set(None)
        self._fixes.forget()
        self._fixes.forget_waiting()
        if self._relocaliser is not None:
            self._relocaliser.forget()

    def begin(self, session: Session) -> None:
        """Sets the session of the coming frames; a live robot's begins with its first frame."""
        self._background = replace(
            self._background, sessions={**self._background.sessions, session.id: session}
        )
        self._clock = session
        self._own_session = session.id if self._own_session is not None else None
        self._own_path = path_id(session.id)
        self.live = session.id

    def resume(self, driven_m: float, next_iteration: int) -> None:
        """Continues a session at a later frame (method §7.3).

        Args:
            driven_m: odometry distance from the session's start to that frame, metres.
        """
        self._driven_m = driven_m
        self._history.resume(next_iteration)

    @property
    def iteration(self) -> int:
        """Number of the current iteration."""
        return self._history.iteration

    def settle_in(self, node: NodeId) -> None:
        """Sets the position to `node`, as which the live frame was just saved (method §4)."""
        self._track.set(Position.at(node))
        self._fixes.settled()
        self._track.guessed_m2 = 0.0

    def localise(
        self,
        live: Frame,
        deadline: float | None = None,
        result_sink: ResultSink = NO_SINK,
        clock: StageClock | None = None,
    ) -> Localisation:
        """One iteration of method §3: gather candidates, rank, attempt, settle.

        Args:
            live: the live frame; `move` has been called with the motion that led to it.
            deadline: `time.perf_counter` value after which no attempt starts; None for no limit.
            result_sink: decides whether places beyond the neighbourhood may be tried.
        """
        clock = clock or StageClock()
        self._graph.trim()
        self._paths.trim()
        self._new_damaged, self._near, self._looked_up, self._beyond = (), None, False, []
        self._history.begin_frame(self._driven_m)
        self._fixes.begin_frame(self._motion.odometry.inliers)
        outcomes: list[Outcome] = []
        if live.status is FrameStatus.OK:
            self._near = self._neighbourhood()
            clock.lap("neighbourhood")
            order = self._rank(live, self._near)
            clock.lap("rank")
            candidates = self._candidates(live, self._near, order, result_sink, clock)
            live_id = node_id(self.live, live.stamp_ns)
            for start in range(0, len(candidates), self._budget.lanes):
                if deadline is not None and perf_counter() >= deadline:
                    break
                lanes = candidates[start : start + self._budget.lanes]
                outcomes += self._attempter.attempts(live, live_id, start, lanes)
                if any(outcome.accepted for outcome in outcomes):
                    break
            if self.config.success is Success.FIRST:
                outcomes, beyond = split_at_first_success(outcomes)
                self._beyond = [one for one in beyond if not one.damaged]
            readable = self._without_damaged(outcomes)
            outcomes = self._fixes.judged(live, live_id, self._driven_m, readable)
            clock.lap("attempts")
            add_outcomes(self._history, live, self._near, outcomes, self._basin, self._lenses)
        success = self._conclude(live, outcomes, result_sink)
        clock.lap("remember")
        return self._result(live, success, clock.stage_ms)

    def _conclude(
        self, live: Frame, outcomes: list[Outcome], result_sink: ResultSink
    ) -> Outcome | None:
        """Sets the position to that of the best match; without one, reports the failures."""
        self._outcomes = outcomes
        self._reference = None if self.position is None else self.position.node
        success = best_success(outcomes, self.config.acceptance.rule)
        if success is not None:
            self._fixes.fix(live, success, result_sink)
            self._open_loop_m = 0.0
            if self._relocaliser is not None:
                self._relocaliser.forget()
            return success
        if any(outcome.candidate.row is not None for outcome in outcomes):
            self._fixes.missed()
        if self._relocaliser is not None:
            self._relocaliser.failed(
                [
                    outcome.candidate.index
                    for outcome in outcomes
                    if outcome.candidate.prediction is None and not outcome.plausible
                ]
            )
        return None

    def move(self, motion: Motion) -> None:
        """Propagates the position by the motion that led to the next frame (method §3).

        A frame that odometry could not use changes nothing: the next usable one carries the motion
        since the last. The robot is lost once the uncertainty of guessed motion exceeds
        `LocaliserConfig.greatest_gap_m`, and if a frame was taken at a different place.
        """
        self._motion = motion
        if motion.prev_from_curr is None or motion.covariance is None:
            return
        self._open_loop_m += motion.moved_m
        if motion.guessed_m:
            self._track.guessed_m2 += motion.guessed_m**2
        else:
            self._driven_m += motion.moved_m
        if motion.jumped:
            self._track.guessed_m2 = math.inf
            self._fixes.forget_waiting()
        if self._relocaliser is not None:
            followed = not motion.jumped and motion.guessed_m <= self.config.followed_gap_m
            self._relocaliser.carry_on(motion.prev_from_curr if followed else None)
        for follower in (self._track, self._fixes):
            follower.carry_on(motion.prev_from_curr, motion.covariance)

    @property
    def certain(self) -> bool:
        """Whether the position is known: odometry since the last match had only short gaps."""
        return self._track.certain

    @property
    def _lost(self) -> bool:
        return not self.certain or self._open_loop_m > self.config.lost_after_m

    @property
    def _lost_long(self) -> bool:
        return self._open_loop_m > self.config.acceptance.lost_long_m

    @property
    def _looks_elsewhere(self) -> bool:
        return self._lost or self._fixes.doubted

    def _lenses_of_map(self) -> Lenses:
        sessions, cameras = self._background.sessions, self._background.cameras
        depth_m = self.config.lens_depth_m
        return Lenses(self._graph, sessions, cameras, self._basin.focal_px, depth_m)

    def _search_of(self, known: MapParts) -> Callable[..., Neighbourhood]:
        if self.config.neighbourhood is NeighbourhoodSearch.BREADTH_FIRST:
            return partial(breadth_first, self._graph)
        return known.search or self._graph.neighbourhood

    def _searched_by(self) -> NeighbourhoodSearch:
        if getattr(self._search, "func", None) is breadth_first:
            return NeighbourhoodSearch.BREADTH_FIRST
        return NeighbourhoodSearch.SUREST

    def _neighbourhood(self) -> Neighbourhood | None:
        return None if self.position is None else self._nodes_near(self.position)

    def _nodes_near(self, position: Position) -> Neighbourhood:
        radius_m = self._basin.search_radius_m(
            position.sigma_m, self.config.search_radius_m, self.config.max_search_radius_m
        )
        return self._search(
            self._graph.index(position.node),
            position.node_from_live,
            position.covariance,
            Search(
                radius_m,
                self.config.view_gate_rad,
                self._own_session,
                self._driven_m,
                self.config.own_exclusion_m,
            ),
        )

    def _rank(self, live: Frame, neighbourhood: Neighbourhood | None) -> NDArray[np.int64]:
        if neighbourhood is None or self.position is None or len(neighbourhood) == 0:
            return np.zeros(0, dtype=np.int64)
        context = RankingContext(
            neighbourhood=neighbourhood,
            graph=self._graph,
            path_memory=self._paths,
            basin=self._basin,
            observations=self._history.observations,
            reference=None if self._fixes.told else self._graph.index(self.position.node),
            own_path=self._own_path,
            stamp_ns=live.stamp_ns,
            seed=live.stamp_ns,
            foresee=lambda: self._foresee(live, neighbourhood),
            run=self._history.run(),
            hour=None if self._clock is None else hour_of_day(self._clock, live.stamp_ns),
            day=None if self._clock is None else day_of(self._clock, live.stamp_ns),
            background=self._background,
            seen=self._lenses.as_seen(neighbourhood),
            live_words=self._words_of(live),
        )
        return self._policy.rank(context)

    def _foresee(self, live: Frame, neighbourhood: Neighbourhood) -> Foreseen:
        """The outcome of attempting each candidate; these attempts are not recorded."""
        attempt = partial(self._attempter.attempt, live, node_id(self.live, live.stamp_ns))
        outcomes = [
            attempt(row, self._predicted(neighbourhood, row)) for row in range(len(neighbourhood))
        ]
        return Foreseen(
            np.array([outcome.accepted for outcome in outcomes], dtype=np.bool_),
            np.array([outcome.match.inliers for outcome in outcomes], dtype=np.int64),
        )

    def _words_of(self, live: Frame) -> Callable[[], NDArray[np.int32]] | None:
        words = self._background.words
        return None if words is None else partial(words.of_frame, live)

    def _candidates(
        self,
        live: Frame,
        neighbourhood: Neighbourhood | None,
        order: NDArray[np.int64],
        result_sink: ResultSink,
        clock: StageClock,
    ) -> list[Candidate]:
        """What to attempt, best first.

        A lost robot, and one whose position is doubtful, alternates proposed nodes and nodes of its
        neighbourhood. A robot with no node near it spends its budget on proposed ones.
        """
        budget = self._budget.attempts
        ranked = []
        if neighbourhood is not None:
            self._attempter.prefetch(
                [self._graph.node(int(i)).id for i in neighbourhood.nodes[order[:_PREFETCH]]]
            )
            ranked = [
                self._predicted(neighbourhood, int(row))
                for row in order[: budget + len(self._damaged)]
                if int(neighbourhood.nodes[row]) not in self._damaged
            ][:budget]
        if (ranked and not self._looks_elsewhere) or self._relocaliser is None:
            return ranked
        if not result_sink.may_propose():
            return ranked
        known = {candidate.index for candidate in ranked}
        budget = self._budget.lost_attempts
        indices = self._fixes.nodes_to_confirm(_CONFIRMING) + self._proposals(
            live, budget, result_sink
        )
        proposed = [
            Candidate(
                index,
                self._graph.node(index).id,
                None,
                guided=False,
                row=None,
                standing=self._fixes.standing,
                lost_long=self._lost_long,
            )
            for index in dict.fromkeys(indices)
            if index not in known | self._damaged
        ]
        clock.lap("places")
        return alternate(proposed, ranked)[:budget]

    def _proposals(self, live: Frame, count: int, result_sink: ResultSink) -> list[int]:
        """The relocaliser's nodes, without known ones of this session."""
        assert self._relocaliser is not None
        self._looked_up = True
        own = result_sink.may_propose_own()
        return self._relocaliser.propose(
            live,
            count,
            lambda index: index not in self._damaged and not self._is_known_own(index, own=own),
        )

    def _is_known_own(self, index: int, *, own: bool) -> bool:
        """Whether a node is this session's own, and recent or left to loop closure.

        Recent nodes are not candidates (method §3.1). While all motion is measured, the pose
        relative to them is certain up to drift: a match with one of them is a loop or a look-alike,
        and loop closure requires a second match.
        """
        if self._own_session is None or self._graph.session_of(index) != self._own_session:
            return False
        driven_m = self._graph.node(index).driven_m
        return not own or driven_m > self._driven_m - self.config.own_exclusion_m

    def _predicted(self, neighbourhood: Neighbourhood, row: int) -> Candidate:
        index = int(neighbourhood.nodes[row])
        prediction = Prediction.of(neighbourhood, row)
        guided = (
            prediction.sigma_m < self.config.guide_below_m
            and prediction.sigma_yaw_rad < self.config.guide_below_rad
        )
        # A mapping robot knows its position by its own nodes; loop closure has stricter tests.
        doubted = self._looks_elsewhere and not (self.certain and self._own_session is not None)
        node, standing = self._graph.node(index).id, self._fixes.standing
        return Candidate(index, node, prediction, guided, row, doubted, standing, self._lost_long)

    def _without_damaged(self, outcomes: list[Outcome]) -> list[Outcome]:
        """Outcomes of readable nodes; the others are reported, and not attempted again."""
        damaged = [outcome.candidate for outcome in outcomes if outcome.damaged]
        self._new_damaged = tuple(candidate.node for candidate in damaged)
        self._damaged.update(candidate.index for candidate in damaged)
        return [outcome for outcome in outcomes if not outcome.damaged]

    @property
    def contradicted(self) -> bool:
        """Whether a caller-supplied position contradicts the robot's own.

        No edge is created until a fix confirms it.
        """
        return self._fixes.contradicted

    @property
    def refuses_lookalikes(self) -> bool:
        """Whether the last frame matched, but its run of matches may be one of look-alikes."""
        return self._fixes.lookalike is not None

    @property
    def on_trial(self) -> bool:
        """Whether the last fixes may still be withdrawn: no edge should rest on them yet."""
        return self._fixes.on_trial

    def _result(
        self,
        live: Frame,
        success: Outcome | None,
        stage_ms: dict[str, float],
    ) -> Localisation:
        node = None if success is None else self._graph.node(success.candidate.index)
        best = None if success is None else self.best_position
        return Localisation(
            stamp_ns=live.stamp_ns,
            status=self._status_without_match() if node is None else LocalisationStatus.LOCALISED,
            attempts=len(self.attempted),
            proposed=sum(one.candidate.prediction is None for one in self.attempted),
            candidates=0 if self._near is None else len(self._near),
            motion=self._motion,
            open_loop_m=self._open_loop_m,
            position=self._track.best_after(self._motion.ahead),
            looked_up=self._looked_up,
            damaged=self._new_damaged,
            withdraws=self._fixes.withdraws,
            node=None if node is None else node.id,
            node_stamp_ns=None if node is None else node.stamp_ns,
            node_from_live=None if best is None else best.node_from_live,
            covariance=None if best is None else best.covariance,
            measured=self.position,
            inliers=0 if success is None else success.match.inliers,
            confidence=max((outcome.confidence for outcome in self._outcomes), default=-math.inf)
            if success is None
            else success.confidence,
            stage_ms=stage_ms,
        )

    def _status_without_match(self) -> LocalisationStatus:
        if self._motion.odometry.status not in {OdometryStatus.OK, OdometryStatus.FIRST}:
            return LocalisationStatus.NO_ODOMETRY
        return LocalisationStatus.LOST if self._lost else LocalisationStatus.DEAD_RECKONING
