"""The one loop: `Robot.step` takes a frame, localises it, and keeps the result."""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from engram.doctor.table import Diagnosis, Finding
from engram.errors import ConfigError, InputError, MapError
from engram.frontend.frame import Frame
from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId
from engram.graph.placing import MAP_FROM_CAMERA
from engram.localiser.attempts import Outcome
from engram.localiser.localisation import (
    NO_SINK,
    Localisation,
    LocalisationStatus,
    Position,
    ResultSink,
    StageClock,
)
from engram.localiser.localiser import InForce, Localiser
from engram.maps.map_frame import MapFrame
from engram.monitor import QUIET, Monitor, deferred_interrupt
from engram.odometry.motion import Motion
from engram.odometry.outside import OutsideMotion
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.drive_session import LiveDrive, Saving
from engram.robot.front import Arrived, Front, arriving, at_time, check_position, paced, stamp_of
from engram.robot.recorder import Recorder
from engram.sequences.clocks import Placed
from engram.sequences.framelog.reader import compose
from engram.sequences.motion_files import MovedSequence
from engram.sequences.sequence import LoggedFrame

# Frames whose positions `pose_at` remembers: ten seconds at 20 Hz.
_REMEMBERED = 200


@dataclass(frozen=True, slots=True, eq=False)
class LastFrame:
    """The robot's last frame, for display.

    Attributes:
        arrived: the images, or the logged frame.
        frame: the frame extracted from them.
        outcomes: outcomes of the attempts, in ranked order.
        refused: whether it matched, but its run of matches may be one of look-alikes.
    """

    arrived: Arrived
    frame: Frame
    outcomes: list[Outcome]
    refused: bool = False


class Robot:
    """One robot on one drive: image pairs in, one `Localisation` each out. A context manager.

    One thread at a time calls a robot's methods, all but `pose_at`. `RobotOptions.threads` bounds
    all that work for it: the caller's; one more for each further lane; one that decodes images in
    `drive`; one that reads the map ahead, which robots in it share; one that writes, if it keeps
    its results; and one that closes loops, if it maps. Robots in one process share only the map
    that made them; each may run on its own thread. A flight recorder and OpenCV have their own.

    Args:
        front: front-end and odometry.
        localiser: localiser of this drive.
        result_sink: keeps the results.
        live: the live drive, which gives the result sink from its first frame on; None for others.
        deadline_ms: latest start of an attempt after its frame arrived; None for no limit.
    """

    def __init__(
        self,
        front: Front,
        localiser: Localiser,
        result_sink: ResultSink = NO_SINK,
        *,
        live: LiveDrive | None = None,
        deadline_ms: float | None = None,
    ) -> None:
        self.last: LastFrame | None = None
        # Why nothing that the robot says is to be trusted, once the doctor has seen enough frames.
        self.unfit: tuple[Finding, ...] = ()
        self._result_sink = result_sink
        self._live = live
        self._front = front
        self._clock = front.clock
        self._localiser = localiser
        self._deadline_ms = deadline_ms
        self._saving = Saving() if live is None else live.saving
        # Time of the newest frame with one.
        self._time_ns: int | None = None
        # The motion of the newest frames, if they were left out and a log or the caller knows it.
        self._behind: OdometryStep | Motion | None = None
        # The newest frames, also those where an error came. Replaced, never changed: another
        # thread may ask `pose_at`.
        self.track: tuple[Localisation, ...] = ()
        self._used = True  # whether the last frame was
        self._closed = False
        self.recorder: Recorder | None = None
        # Called after each step with the frame and its result, such as by a viewer.
        self.watch: Callable[[LastFrame, Localisation], None] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the drive and the robot's threads; commits what a live robot keeps.

        Raises:
            MapError: it cannot be written, though no earlier write failed; see `saving`.
        """
        self._closed = True
        live, self._live = self._live, None
        self.unfit = self._front.unfit
        try:
            if live is not None:
                live.close(self.unfit)
        finally:
            self._localiser.close()
            if self.recorder is not None:
                self.recorder.close()

    @property
    def outcomes(self) -> list[Outcome]:
        """Outcomes of the attempts for the last frame, in ranked order; none if it was left out."""
        return self._localiser.outcomes if self._used else []

    @property
    def in_force(self) -> InForce:
        """By what it localises, read from its parts."""
        return self._localiser.in_force

    @property
    def graph(self) -> ExperienceGraph:
        """What it localises in, with the nodes that it saved."""
        return self._localiser.graph

    @property
    def diagnosis(self) -> Diagnosis:
        """What the doctor finds in the first frames of the drive; see `DoctorConfig`."""
        return self._front.diagnosis

    @property
    def saving(self) -> Saving:
        """Whether and where a live robot's results are saved."""
        return self._saving

    def step(
        self,
        arrived: Arrived,
        *,
        motion: Motion | OutsideMotion | None = None,
        deadline_ms: float | None = None,
        arrived_s: float | None = None,
        trusted: bool = False,
    ) -> Localisation:
        """Localises one pair or logged frame; call it for each, in temporal order.

        A frame with a wrong stamp (see `engram.sequences.clocks`) is not used: its result has the
        status `NO_ODOMETRY`, and its position is a guess. After two such frames that follow each
        other the clock counts as set: the robot continues from the third one if the images do. If
        they do not, and the clock went back, it was carried elsewhere, as by `lose`.
        What it saves counts on in time; results and `pose_at` have the stamps of the frames.

        Args:
            arrived: a pair of images, (h, w) uint8 grey, rectified, synchronised; or a frame of
                a frame log.
            motion: what wheels and gyroscope measured since the previous frame; or a `Motion` since
                the previous usable frame that replaces odometry, given for all frames or for none.
            deadline_ms: latest start of an attempt after the images arrived; None for the
                robot's own deadline.
            arrived_s: `time.perf_counter` when they arrived; None for now.
            trusted: whether a reader of drives has looked after the stamp: it is right if it rises.

        Returns:
            The localisation. `node_from_live` (metres; x right, y down, z forward) is set only if
            the frame was matched.

        Raises:
            InputError: the robot is closed, or cannot use an argument: it is as it was before.
            IncompatibleError: the pair is of another camera; likewise.
            MapError: landmarks cannot be read, or the results cannot be written.
            KeyboardInterrupt: Ctrl-C, once the frame is done: no motion is left out.
        """
        clock = StageClock(arrived_s)
        deadline_ms = self._deadline_ms if deadline_ms is None else deadline_ms
        if self._closed:
            raise InputError("the robot is closed; make another one with Map.robot")
        self._front.check(arrived, motion, deadline_ms)
        with deferred_interrupt() as raise_if_asked:
            given, placed = arrived, self._placed(arrived, trusted=trusted)
            self._used = placed is not None
            if placed is None:
                raise_if_asked()
                return self._left_out(arrived, motion)
            arrived = at_time(arrived, placed.time_ns)
            frame, motion = self._taken(arrived, motion, clock)
            if _is_elsewhere(placed, motion):
                self._localiser.lose()
            deadline = None if deadline_ms is None else clock.started + deadline_ms / 1e3
            self._localiser.move(motion)
            try:
                result = self._known(frame, motion)
                if result is None:
                    result = self._localiser.localise(frame, deadline, self._result_sink, clock)
                for earlier in self.track if result.withdraws else ():
                    if earlier.stamp_ns in result.withdraws:
                        self._withdraw(earlier)
                result = self._kept(frame, result)
            except MapError:
                self._followed(arrived, motion)
                raise
            if deadline is not None and time.perf_counter() > deadline:
                result = replace(result, late=True)
            if self._front.fixed_share:
                result = replace(result, fixed_share=self._front.fixed_share)
            self._front.match_again(frame, self._localiser.best_matched)
            self.last = LastFrame(
                arrived, frame, self._localiser.outcomes, self._localiser.refuses_lookalikes
            )
            if self.watch is not None:
                self.watch(self.last, result)
            if self.recorder is not None:
                self.recorder.note(arrived, frame, result, self._localiser.outcomes)
            self.track = (*self.track[1 - _REMEMBERED :], result)
        raise_if_asked()
        return self._with_stamps(result, stamp_of(given))

    localise = step

    def _with_stamps(self, result: Localisation, stamp_ns: int) -> Localisation:
        """A result with the stamps of its frames in place of times."""
        if not self._clock.steps:
            return result
        withdraws = tuple(map(self._clock.stamp_of, result.withdraws))
        return replace(result, stamp_ns=stamp_ns, withdraws=withdraws)

    def drive(
        self,
        sequence: Iterable[Arrived],
        monitor: Monitor = QUIET,
        rate_hz: float | None = None,
    ) -> Generator[Localisation]:
        """Drives through a sequence, frame by frame, decoding ahead of the robot.

        Close the generator when you leave it early: this ends the thread that reads ahead. While it
        is open, Ctrl-C waits for the end of the frame (`deferred_interrupt`).

        Args:
            sequence: images or a frame log.
            monitor: receives the status of each frame, and may stop the drive between two.
            rate_hz: replay in real time at this rate; frames are late after the deadline or,
                without one, once the next one arrives. None for maximum speed.

        Raises:
            ConfigError: the rate is not above 0.
            KeyboardInterrupt: between two frames.
        """
        if rate_hz is not None and not rate_hz > 0:
            raise ConfigError(f"rate is {rate_hz} Hz, must be > 0")
        outside = sequence.motion() if isinstance(sequence, MovedSequence) else None
        with closing(arriving(sequence)) as entries, deferred_interrupt() as raise_if_asked:
            for due, arrived in paced(entries, rate_hz):
                raise_if_asked()
                motion = None
                if outside is not None and self._time_ns is not None:
                    motion = outside.between(self._time_ns, stamp_of(arrived))
                result = self.step(arrived, motion=motion, arrived_s=due, trusted=True)
                if rate_hz is not None and self._deadline_ms is None:
                    result = replace(result, late=time.perf_counter() > due + 1 / rate_hz)
                yield result
                monitor.advance(_word(result))
                monitor.check()
                raise_if_asked()

    def follow(self, arrived: Arrived, *, motion: Motion | OutsideMotion | None = None) -> None:
        """Carries the position on by the motion to this frame, without localising it."""
        placed = self._placed(arrived, trusted=True)
        if placed is not None:
            arrived = at_time(arrived, placed.time_ns)
            _, motion = self._front.take(arrived, motion)
            self._localiser.move(motion)
            self._followed(arrived, motion)

    def _followed(self, arrived: Arrived, motion: Motion) -> None:
        """Records a frame that yields only motion."""
        followed = _unlocalised(stamp_of(arrived), motion, self._localiser.best_position)
        self.track = (*self.track[1 - _REMEMBERED :], followed)

    def record(self, reason: str = "asked") -> Path:
        """Writes the last seconds as a flight record; see `Recorder.record`.

        Args:
            reason: stored with it.

        Raises:
            InputError: the robot has no `recorder`.
        """
        if self.recorder is None:
            raise InputError("the robot records nothing: set robot.recorder = Recorder(FOLDER)")
        return self.recorder.record(reason)

    def place_at(self, hint: Position) -> None:
        """Sets the position before the next step, such as an operator's or a stored one.

        It counts like any position: the nodes around it are tried first, and after too long a
        distance without a match the robot is lost.

        Raises:
            InputError: no such position; see `check_position`.
        """
        check_position(hint, self.graph)
        self._localiser.place_at(hint, said=True)

    def lose(self) -> None:
        """Discards the position: the robot was carried elsewhere."""
        self._localiser.lose()

    def withdraw(self, result: Localisation) -> None:
        """Withdraws a result that a later frame disproved: no pose rests on it any more.

        The loop calls it for `Localisation.withdraws`, and so may a caller with better evidence.
        """
        time_ns = self._clock.time_of(result.stamp_ns)
        known = (one for one in self.track if one.stamp_ns == time_ns)
        self._withdraw(next(known, replace(result, stamp_ns=time_ns)))

    def _withdraw(self, result: Localisation) -> None:
        """The same for a result as it is in `track`."""
        track, rests = [], False
        for one in self.track:
            rests = one.stamp_ns == result.stamp_ns or (rests and not one.localised)
            track.append(replace(one, position=None) if rests else one)
            rests = rests and one.saved is None  # from there on it is seen from that node
        self.track = tuple(track)
        self._result_sink.withdrawn(result)
        if self.recorder is not None:
            self.recorder.withdrew()

    def pose_at(self, stamp_ns: int) -> Position | None:
        """The position at a time between the robot's last frames, such as that of an image.

        Any thread may ask, even during a `step`.

        Args:
            stamp_ns: a time within the robot's last 200 frames, on the clock of their stamps.

        Returns:
            The position of the previous frame, carried on along the motion to the next one; None
            if unknown or outside these frames.
        """
        stamp_ns = self._clock.time_of(stamp_ns)
        usable = [result for result in self.track if result.motion.usable]
        after = bisect_left(usable, stamp_ns, key=lambda one: one.stamp_ns)
        if after == len(usable):
            return None
        found = usable[after]
        if found.stamp_ns == stamp_ns:
            return found.position
        motion = found.motion
        if after == 0 or motion.prev_from_curr is None or motion.covariance is None:
            return None
        before = usable[after - 1]
        share = (stamp_ns - before.stamp_ns) / (found.stamp_ns - before.stamp_ns)
        twist = motion.prev_from_curr.log()
        if before.position is not None:
            return before.position.carried_on(SE3.exp(share * twist), share * motion.covariance)
        if found.position is None:
            return None
        back = SE3.exp((share - 1) * twist)
        return found.position.carried_on(back, (1 - share) * motion.covariance)

    def _taken(
        self, arrived: Arrived, motion: Motion | OutsideMotion | None, clock: StageClock
    ) -> tuple[Frame, Motion]:
        """Frame and motion; once the doctor has seen enough, an unfit drive is kept no longer."""
        examination = self._front.examination
        waits = not examination.full
        behind, self._behind = self._behind, None
        if behind is not None:
            since = _since_placed(behind, arrived, motion)
            if isinstance(since, Motion):
                motion = since
            elif since is not None and isinstance(arrived, LoggedFrame):
                arrived = replace(arrived, odometry=since)
        taken = self._front.take(arrived, motion, clock)
        if waits and examination.full:
            self.unfit = self._front.unfit
            if self._live is not None:
                self._result_sink = self._live.examined(self.unfit, self._result_sink)
        return taken

    def _known(self, frame: Frame, motion: Motion) -> Localisation | None:
        """Applies the result sink's hint; returns its result if the frame needs no localising."""
        hint = self._result_sink.hint(frame, motion)
        if hint is None:
            return None
        if hint.position is not None:
            self._localiser.place_at(hint.position, hint.open_loop_m, hint.guessed_m, hint.agreed)
        return hint.found

    def _kept(self, frame: Frame, result: Localisation) -> Localisation:
        """The result, completed by the sink; a write error ends a live drive's saving alone."""
        try:
            result = self._result_sink.keep(frame, result)
        except MapError as error:
            if self._live is None:
                raise
            self._result_sink = self._live.failed(error)
        self._saving.nodes += result.saved is not None
        return result

    def _placed(self, arrived: Arrived, *, trusted: bool) -> Placed | None:
        """The frame's stamp with its time; None without. The first one begins a live drive."""
        placed = self._clock.take(stamp_of(arrived), trusted=trusted)
        if not placed or placed[-1].step is not None:
            self._front.examination.evidence.taken = self._clock.report
        if not placed:
            return None
        if self._time_ns is None and self._live is not None:
            self._result_sink = self._live.begin(at_time(arrived, placed[-1].time_ns))
        self._time_ns = placed[-1].time_ns
        return placed[-1]

    def _left_out(self, arrived: Arrived, motion: Motion | OutsideMotion | None) -> Localisation:
        """The result for a frame without a time: where the robot may be by now."""
        self._behind = _since_placed(self._behind, arrived, motion)
        guess = self._front.left_out(motion)
        position = self._localiser.best_position
        if position is not None:
            position = None if guess.ahead is None else position.carried_on(*guess.ahead)
        return _unlocalised(stamp_of(arrived), guess, position)


def _word(result: Localisation) -> str:
    """The status of a frame, in one word."""
    if result.resumed:
        return "resuming"
    return "saved" if result.saved else result.status.value


def _unlocalised(stamp_ns: int, motion: Motion, position: Position | None) -> Localisation:
    """The result for a frame that is not localised."""
    return Localisation(
        stamp_ns=stamp_ns,
        status=LocalisationStatus.NO_ODOMETRY,
        attempts=0,
        candidates=0,
        open_loop_m=0.0,
        motion=motion,
        position=position,
    )


def _since_placed(
    behind: OdometryStep | Motion | None, arrived: Arrived, motion: Motion | OutsideMotion | None
) -> OdometryStep | Motion | None:
    """The motion to a frame past those left out; None where odometry measures it over them."""
    if isinstance(motion, Motion):
        return _after(behind, motion) if isinstance(behind, Motion) else motion
    if isinstance(arrived, LoggedFrame):
        return compose(behind if isinstance(behind, OdometryStep) else None, arrived.odometry)
    return None


def _after(before: Motion, motion: Motion) -> Motion:
    """Two successive motions as one; the second alone where one of them is unknown."""
    first, second = before.prev_from_curr, motion.prev_from_curr
    if first is None or second is None:
        return motion
    covariance = None
    if before.covariance is not None and motion.covariance is not None:
        covariance = propagate_covariance(first, before.covariance, motion.covariance)
    guessed_m = math.hypot(before.guessed_m, motion.guessed_m)
    return replace(
        motion, prev_from_curr=first @ second, covariance=covariance, guessed_m=guessed_m
    )


def _is_elsewhere(placed: Placed, motion: Motion) -> bool:
    """Whether stamps went back and images do not match: another drive, or a simulator's reset."""
    back = placed.step is not None and placed.step.by_ns < 0
    return back and motion.guessed_m > 0 and motion.odometry.status is not OdometryStatus.OK


class DisplayPose:
    """Follows a robot in the map frame, for display and messages.

    Nodes get their place in the frame with the revision that commits them. Until then one that the
    robot saved lies where the robot took itself to be; one that it saved while it was lost, where
    the graph has it, once that joins it to the map. In an empty map the first frame lies at the
    origin and looks along x, as the committed frame will have it.

    Args:
        frame: that of the map as it was when the drive began.
        graph: what the robot localises in, with the nodes that it saved.
    """

    def __init__(self, frame: MapFrame, graph: ExperienceGraph) -> None:
        self._frame, self._graph = frame, graph
        self._saved: dict[NodeId, SE3] = {}
        # A node with a place; and the one without for which the graph was asked, and its edges.
        self._placed: NodeId | None = None
        self._asked: tuple[NodeId, int] | None = None

    def of(self, node: NodeId) -> SE3 | None:
        """``map_from_node``; None for a node without a place."""
        return self._saved.get(node) or self._frame.find(node)

    def after(self, result: Localisation) -> SE3 | None:
        """``map_from_live`` at the next frame of the drive; None where it is not known.

        Args:
            found: the result of each frame, one after another.
        """
        position = result.position
        map_from_node = None if position is None else self._found(position.node)
        map_from_live = None
        if position is not None and map_from_node is not None:
            map_from_live = map_from_node @ position.node_from_live
        elif result.saved is not None and not self._saved and self._frame.is_empty:
            map_from_live = SE3(MAP_FROM_CAMERA.copy(), np.zeros(3))
        if result.saved is not None and map_from_live is not None:
            self._saved[result.saved] = map_from_live
        return map_from_live

    def _found(self, node: NodeId) -> SE3 | None:
        """The place of a node, if need be along the graph from the last one that had a place."""
        map_from_node = self.of(node)
        if map_from_node is None:
            map_from_node = self._along_graph(node)
        if map_from_node is not None:
            self._placed = node
        return map_from_node

    def _along_graph(self, node: NodeId) -> SE3 | None:
        graph, placed = self._graph, self._placed
        asked = node, graph.edge_count
        if placed is None or asked == self._asked or node not in graph or placed not in graph:
            return None
        self._asked = asked
        map_from_placed = self.of(placed)
        predicted = graph.predict(graph.index(placed), graph.index(node))
        if predicted is None or map_from_placed is None:
            return None
        self._saved[node] = map_from_placed @ predicted[0]
        return self._saved[node]
