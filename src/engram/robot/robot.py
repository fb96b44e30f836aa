"""The one loop: `Robot.step` takes a frame, localises it, and keeps the result."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from engram.doctor import Diagnosis
from engram.errors import ConfigError, InputError, MapError
from engram.frontend import Frame
from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.localiser import (
    KEEPS_NOTHING,
    Keeper,
    Localisation,
    LocalisationStatus,
    Localiser,
    Position,
    StageClock,
)
from engram.localiser.attempts import Outcome
from engram.localiser.given import InForce
from engram.monitor import QUIET, Monitor, deferred_interrupt
from engram.odometry import Motion, OdometryStatus, OdometryStep, OutsideMotion
from engram.robot.front import Arrived, Front, arriving, check_position, paced, stamp_of
from engram.robot.live import LiveDrive
from engram.robot.recorder import Recorder
from engram.robot.saved import Saving
from engram.sequences.motion import MovedSequence

# Frames whose positions `pose_at` remembers: ten seconds at 20 Hz.
_REMEMBERED = 200
# So many rising stamps before the newest one are a clock that was set back, not stray frames.
_SET_BACK = 3


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """The robot's last frame, for display.

    Attributes:
        arrived: the images, or the logged frame.
        frame: the frame extracted from them.
        outcomes: outcomes of the attempts, in ranked order.
    """

    arrived: Arrived
    frame: Frame
    outcomes: list[Outcome]


class Robot:
    """One robot on one drive: image pairs in, `Localisation`s out. A context manager.

    One thread at a time calls a robot's methods, all but `pose_at`. `RobotOptions.threads` bounds
    all that work for it: the caller's; one more for each further lane; one that decodes images in
    `drive`; one that reads the map ahead, which robots in it share; one that writes, if it keeps
    its results; and one that closes loops, if it maps. Robots in one process share only the map
    that made them; each may run on its own thread. A flight recorder and OpenCV have their own.

    Args:
        front: front-end and odometry.
        localiser: localiser of this drive.
        keeper: keeps the results.
        live: the live drive, which gives the keeper from its first frame on; None if it is not one.
        deadline_ms: latest start of an attempt after its frame arrived; None for no limit.
    """

    def __init__(
        self,
        front: Front,
        localiser: Localiser,
        keeper: Keeper = KEEPS_NOTHING,
        *,
        live: LiveDrive | None = None,
        deadline_ms: float | None = None,
    ) -> None:
        self.last: Seen | None = None
        self._keeper = keeper
        self._live = live
        self._front = front
        self._localiser = localiser
        self._deadline_ms = deadline_ms
        self._saving = Saving() if live is None else live.saving
        self._stamp_ns: int | None = None
        # Rising stamps of the newest frames that came too late.
        self._early_ns: list[int] = []
        # The newest frames, also those where an error came. Replaced, never changed: another
        # thread may ask `pose_at`.
        self.track: tuple[Localisation, ...] = ()
        self._closed = False
        self.recorder: Recorder | None = None
        # Called after each step with the frame and its result, such as by a viewer.
        self.watch: Callable[[Seen, Localisation], None] | None = None

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
        try:
            if live is not None:
                live.close(self.diagnosis.fatal)
        finally:
            self._localiser.close()
            if self.recorder is not None:
                self.recorder.close()

    @property
    def outcomes(self) -> list[Outcome]:
        """Outcomes of the attempts for the last frame, in ranked order."""
        return self._localiser.outcomes

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
    ) -> Localisation:
        """Localises one pair or logged frame; call it for each, in temporal order.

        A frame whose stamp is not later than that of the frame before is not used: its result has
        the status `NO_ODOMETRY`. After three of them with rising stamps the clock counts as set
        back: a robot that keeps nothing begins anew, as after `lose`; one that keeps its drive does
        not, as a drive has one clock.

        Args:
            arrived: a pair of images, (h, w) uint8 grey, rectified, synchronised; or a frame of
                a frame log.
            motion: what wheels and gyroscope measured since the previous frame; or a `Motion` since
                the previous usable frame that replaces odometry, given for all frames or for none.
            deadline_ms: latest start of an attempt after the images arrived; None for the
                robot's own deadline.
            arrived_s: `time.perf_counter` when they arrived; None for now.

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
            if not self._in_order(arrived):
                raise_if_asked()
                return self._left_out(arrived)
            frame, motion = self._taken(arrived, motion, clock)
            deadline = None if deadline_ms is None else clock.started + deadline_ms / 1e3
            self._localiser.move(motion)
            try:
                found = self._known(frame, motion)
                if found is None:
                    found = self._localiser.localise(frame, deadline, self._keeper, clock)
                for earlier in self.track if found.withdraws else ():
                    if earlier.stamp_ns in found.withdraws:
                        self.withdraw(earlier)
                found = self._kept(frame, found)
            except MapError:
                self._followed(arrived, motion)
                raise
            if deadline is not None and time.perf_counter() > deadline:
                found = replace(found, late=True)
            if self._front.fixed_share:
                found = replace(found, fixed_share=self._front.fixed_share)
            self._front.match_again(frame, self._localiser.best_matched)
            self.last = Seen(arrived, frame, self._localiser.outcomes)
            if self.watch is not None:
                self.watch(self.last, found)
            if self.recorder is not None:
                self.recorder.note(arrived, frame, found, self._localiser.outcomes)
            self.track = (*self.track[1 - _REMEMBERED :], found)
        raise_if_asked()
        return found

    localise = step

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
                if outside is not None and self._stamp_ns is not None:
                    motion = outside.between(self._stamp_ns, stamp_of(arrived))
                found = self.step(arrived, motion=motion, arrived_s=due)
                if rate_hz is not None and self._deadline_ms is None:
                    found = replace(found, late=time.perf_counter() > due + 1 / rate_hz)
                yield found
                monitor.advance(_word(found))
                monitor.check()
                raise_if_asked()

    def follow(self, arrived: Arrived, *, motion: Motion | OutsideMotion | None = None) -> None:
        """Carries the position on by the motion to this frame, without localising it."""
        if self._in_order(arrived):
            _, motion = self._front.take(arrived, motion)
            self._localiser.move(motion)
            self._followed(arrived, motion)

    def _followed(self, arrived: Arrived, motion: Motion) -> None:
        """Notes a frame of which only the motion is known."""
        followed = replace(self._left_out(arrived), motion=motion)
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

    def withdraw(self, found: Localisation) -> None:
        """Withdraws a result that a later frame disproved: no pose rests on it any more.

        The loop calls it for `Localisation.withdraws`, and so may a caller that knows better.
        """
        track, rests = [], False
        for one in self.track:
            rests = one.stamp_ns == found.stamp_ns or (rests and not one.localised)
            track.append(replace(one, position=None) if rests else one)
            rests = rests and one.saved is None  # from there on it is seen from that node
        self.track = tuple(track)
        self._keeper.withdrawn(found)
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
        usable = [one for one in self.track if one.motion.usable]
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
        waits = self._live is not None and not examination.full
        taken = self._front.take(arrived, motion, clock)
        if self._live is not None and waits and examination.full:
            self._keeper = self._live.examined(self.diagnosis.fatal, self._keeper)
        return taken

    def _known(self, frame: Frame, motion: Motion) -> Localisation | None:
        """Applies the keeper's hint; returns its result if the frame needs no localising."""
        hint = self._keeper.hint(frame, motion)
        if hint is None:
            return None
        if hint.position is not None:
            self._localiser.place_at(hint.position, hint.open_loop_m, hint.guessed_m, hint.agreed)
        return hint.found

    def _kept(self, frame: Frame, found: Localisation) -> Localisation:
        """The result as its keeper completes it; a write error ends a live drive's saving alone."""
        try:
            found = self._keeper.keep(frame, found)
        except MapError as error:
            if self._live is None:
                raise
            self._keeper = self._live.failed(error)
        self._saving.nodes += found.saved is not None
        return found

    def _in_order(self, arrived: Arrived) -> bool:
        """Whether the stamp is later than the last one; the first frame begins a live drive."""
        stamp_ns, last_ns = stamp_of(arrived), self._stamp_ns
        if last_ns is not None and stamp_ns <= last_ns:
            self._front.examination.misordered(stamp_ns, last_ns)
            if not self._set_back(stamp_ns):
                return False
        elif last_ns is None and self._live is not None:
            self._keeper = self._live.begin(arrived)
        self._early_ns.clear()
        self._stamp_ns = stamp_ns
        return True

    def _set_back(self, stamp_ns: int) -> bool:
        """Whether the clock was set back, so that the robot begins anew at this frame."""
        if self._early_ns and stamp_ns <= self._early_ns[-1]:
            self._early_ns.clear()
        self._early_ns.append(stamp_ns)
        if len(self._early_ns) < _SET_BACK or self._keeper is not KEEPS_NOTHING:
            return False
        self._front.restart()
        self._localiser.lose()
        self.track = ()
        return True

    def _left_out(self, arrived: Arrived) -> Localisation:
        """The result for a frame that is not used."""
        return Localisation(
            stamp_ns=stamp_of(arrived),
            status=LocalisationStatus.NO_ODOMETRY,
            attempts=0,
            candidates=0,
            open_loop_m=0.0,
            motion=Motion(OdometryStep(OdometryStatus.UNUSABLE_FRAME)),
            position=self._localiser.best_position,
        )


def _word(found: Localisation) -> str:
    """The status of a frame, in one word."""
    if found.resumed:
        return "resuming"
    return "saved" if found.saved else found.status.value
