"""The one loop: `Robot.step` takes what arrived, localises it, and keeps what was found."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import deque
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Self

from engram.errors import ConfigError, InputError
from engram.frontend import Frame, StereoPair
from engram.geometry import SE3
from engram.localiser import (
    KEEPS_NOTHING,
    Keeper,
    Localisation,
    Localiser,
    Position,
    StageClock,
)
from engram.localiser.attempts import Outcome
from engram.monitor import QUIET, Monitor, deferred_interrupt
from engram.odometry import Motion
from engram.robot.front import Arrived, Front, arriving, paced
from engram.robot.live import LiveKeeper, Saving
from engram.sequences import FrameSequence, StereoSequence

# Frames whose positions `pose_at` remembers: ten seconds at 20 Hz.
_REMEMBERED = 200


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a robot saw last, for those who show it.

    Attributes:
        arrived: the images, or the logged frame.
        frame: what the front-end made of them.
        outcomes: what became of the attempts, in ranked order.
    """

    arrived: Arrived
    frame: Frame
    outcomes: list[Outcome]


class Robot:
    """One robot on one drive: image pairs in, `Localisation`s out. A context manager.

    One thread calls a robot's methods, whichever it is. A robot runs others of its own: a lane for
    each attempt at the same time (`Budget.lanes`); in `drive` one that reads ahead; and where it
    keeps what it finds one that writes, and one that looks for loops. No more than
    `Budget.lanes` + 3. Several robots in one process share nothing but the map they were made by,
    and each may run on a thread of its own.

    Args:
        front: front-end and odometry.
        localiser: of this drive.
        keeper: what becomes of what is found.
        deadline_ms: of each frame; None for none.
    """

    def __init__(
        self,
        front: Front,
        localiser: Localiser,
        keeper: Keeper = KEEPS_NOTHING,
        *,
        deadline_ms: float | None = None,
    ) -> None:
        self.last: Seen | None = None
        self._keeper = keeper
        self._live = keeper if isinstance(keeper, LiveKeeper) else None
        self._front = front
        self._localiser = localiser
        self._deadline_ms = deadline_ms
        self._saving = Saving() if self._live is None else self._live.saving
        self._stamp_ns: int | None = None
        self._track: deque[tuple[int, Localisation]] = deque(maxlen=_REMEMBERED)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the drive, and the robot's threads; what a live robot keeps becomes a revision.

        Raises:
            MapError: it cannot be written, though nothing had failed while the robot drove; see
                `saving`.
        """
        live, self._live = self._live, None
        try:
            if live is not None:
                live.close()
        finally:
            self._localiser.close()

    @property
    def outcomes(self) -> list[Outcome]:
        """What became of the attempts for the last frame, in ranked order."""
        return self._localiser.outcomes

    @property
    def saving(self) -> Saving:
        """Whether what a live robot finds is saved, and where it came to."""
        return self._saving

    def step(
        self,
        arrived: Arrived,
        *,
        motion: Motion | None = None,
        deadline_ms: float | None = None,
        arrived_s: float | None = None,
    ) -> Localisation:
        """Localises what arrived; call it for every pair, in the order of time.

        Args:
            arrived: a pair of images, (h, w) uint8 grey, rectified, synchronised; or a frame of
                a frame log.
            motion: how the camera moved since the usable frame before, where something else than
                visual odometry measured it; then give it for all frames.
            deadline_ms: no match attempt starts later than this after the images arrived; by
                default the robot's own deadline.
            arrived_s: `time.perf_counter` when they arrived; None for now.

        Returns:
            Where the robot is, as far as it is known. `node_from_live` (metres, x right, y down,
            z forward) is set only where the frame was matched.

        Raises:
            InputError: the stamp is not later than that of the frame before.
            MapError: the map's landmarks cannot be read, or what is kept not be written.
        """
        clock = StageClock(arrived_s)
        if deadline_ms is None:
            deadline_ms = self._deadline_ms
        frame, motion = self._front.take(self._checked(arrived), motion, clock)
        deadline = None if deadline_ms is None else clock.started + deadline_ms / 1e3
        self._localiser.move(motion)
        found = self._known(frame, motion)
        if found is None:
            found = self._localiser.localise(frame, deadline, self._keeper, clock)
        found = self._keeper.keep(frame, found)
        if deadline is not None and time.perf_counter() > deadline:
            found = replace(found, late=True)
        self.last = Seen(arrived, frame, self._localiser.outcomes)
        self._track.append((frame.stamp_ns, found))
        return found

    localise = step

    def drive(
        self,
        sequence: StereoSequence | FrameSequence,
        monitor: Monitor = QUIET,
        rate_hz: float | None = None,
    ) -> Generator[Localisation]:
        """Drives through a sequence, frame by frame, decoding ahead of the robot.

        Close the generator where it is left early: that ends the thread that reads ahead. While it
        is open, Ctrl-C waits for the end of the frame (`deferred_interrupt`).

        Args:
            sequence: images or a frame log.
            monitor: hears what became of each frame, and may stop the drive between two.
            rate_hz: replay in real time at this rate; frames are late after the deadline or,
                without one, when the next one arrives. None for as fast as it goes.

        Raises:
            ConfigError: the rate is not above 0.
            KeyboardInterrupt: between two frames.
        """
        if rate_hz is not None and not rate_hz > 0:
            raise ConfigError(f"rate is {rate_hz} Hz, must be > 0")
        with closing(arriving(sequence)) as entries, deferred_interrupt() as raise_if_asked:
            for due, arrived in paced(entries, rate_hz):
                raise_if_asked()
                found = self.step(arrived, arrived_s=due)
                if rate_hz is not None and self._deadline_ms is None:
                    found = replace(found, late=time.perf_counter() > due + 1 / rate_hz)
                yield found
                monitor.advance(_word(found))
                monitor.check()
                raise_if_asked()

    def follow(self, arrived: Arrived, *, motion: Motion | None = None) -> None:
        """Carries on over what arrived without localising it."""
        _, motion = self._front.take(self._checked(arrived), motion)
        self._localiser.move(motion)

    def place_at(self, hint: Position) -> None:
        """Tells the robot where it is before its next step: an operator's belief, or last night's.

        It counts as any position does: nodes around are tried first, and once the robot has come
        too far without a match it is lost.
        """
        self._localiser.place_at(hint)

    def lose(self) -> None:
        """The robot was carried elsewhere: it knows nothing of its place."""
        self._localiser.lose()

    def withdraw(self, found: Localisation) -> None:
        """A later frame disproved what was found: the keeper hears of it, and no pose rests on it.

        Nothing in the loop withdraws yet; it is for whoever knows better.
        """
        self._track = deque(
            ((at, replace(one, position=None) if one is found else one) for at, one in self._track),
            _REMEMBERED,
        )
        self._keeper.withdrawn(found)

    def pose_at(self, stamp_ns: int) -> Position | None:
        """Where the robot was at a time between its last frames, as when an image was taken.

        Args:
            stamp_ns: a time since the robot's last 200 frames, on the clock of their stamps.

        Returns:
            The position of the frame before, carried on along the motion to the frame after; None
            where that is not known, or the time lies outside of what is remembered.
        """
        usable = [(at, found) for at, found in self._track if found.motion.usable]
        after = bisect_left([at for at, _ in usable], stamp_ns)
        if after == len(usable):
            return None
        at_ns, found = usable[after]
        if at_ns == stamp_ns:
            return found.position
        motion = found.motion
        if after == 0 or motion.prev_from_curr is None or motion.covariance is None:
            return None
        before_ns, before = usable[after - 1]
        share = (stamp_ns - before_ns) / (at_ns - before_ns)
        twist = motion.prev_from_curr.log()
        if before.position is not None:
            return before.position.carried_on(SE3.exp(share * twist), share * motion.covariance)
        if found.position is None:
            return None
        back = SE3.exp((share - 1) * twist)
        return found.position.carried_on(back, (1 - share) * motion.covariance)

    def _known(self, frame: Frame, motion: Motion) -> Localisation | None:
        """What the keeper knows of the frame: the robot is placed there, or needs no looking."""
        hint = self._keeper.hint(frame, motion)
        if hint is None:
            return None
        if hint.position is not None:
            self._localiser.place_at(hint.position, hint.open_loop_m, hint.guessed_m)
        return hint.found

    def _checked(self, arrived: Arrived) -> Arrived:
        """The same; time only goes on. With the first one the drive of a live robot begins.

        Raises:
            InputError: it does not.
        """
        pair = arrived if isinstance(arrived, StereoPair) else arrived.frame
        if self._stamp_ns is not None and pair.stamp_ns <= self._stamp_ns:
            raise InputError(
                f"stamp {pair.stamp_ns} ns is not later than {self._stamp_ns} ns, that of the "
                "frame before; give the frames of a drive in the order of time, each once"
            )
        if self._stamp_ns is None and self._live is not None:
            self._live.begin(arrived)
        self._stamp_ns = pair.stamp_ns
        return arrived


def _word(found: Localisation) -> str:
    """What became of a frame, in a word."""
    if found.resumed:
        return "resuming"
    return "saved" if found.saved else found.status.value
