"""Input of a robot: images or logged frames, decoded ahead, in real time or at once."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from math import inf
from numbers import Real
from queue import Queue
from threading import Event, Thread
from typing import TypeAlias, TypeVar

import numpy as np

from engram.doctor.examination import Evidence, Examination
from engram.doctor.table import Diagnosis, Finding, diagnose, fatal_findings
from engram.errors import IncompatibleError, InputError
from engram.frontend.frame import Frame, FrameStatus, StereoPair
from engram.frontend.frontend import Frontend, check_pair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.localiser.localisation import Position, StageClock
from engram.odometry.fixed import FixedPixels
from engram.odometry.motion import GapFiller, Motion
from engram.odometry.odometry import Odometry
from engram.odometry.outside import OutsideModel, OutsideMotion, Repeats, StandsStill, rests
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.settings import Settings
from engram.sequences.clocks import SteadyClock
from engram.sequences.sequence import LoggedFrame

T = TypeVar("T")
Arrived: TypeAlias = StereoPair | LoggedFrame

# Decoded pairs that wait for the front-end: about 8 MB at KITTI's size.
_READ_AHEAD = 8
# No robot moves further between two frames.
_FARTHEST_M = 1e5
# A year between two frames.
_LONGEST_S = 3.2e7


class Front:
    """From images to a frame and its motion: front-end, odometry, gap filling.

    A frame log already contains frame and odometry.

    Args:
        camera: that of all its frames; None if the first one decides.

    Attributes:
        examination: what the doctor saw of the first frames.
        clock: turns the stamps of a robot's frames into times.
    """

    def __init__(self, settings: Settings, camera: StereoCamera | None = None) -> None:
        self._camera = camera
        self.examination = Examination(settings.doctor)
        self._settings = settings
        self._frontend = Frontend(settings.frontend)
        self._fixed = FixedPixels(settings.fixed, settings.odometry.matcher)
        # Motions of frames that were taken ahead.
        self._ahead: deque[Motion] = deque()
        self.clock = SteadyClock(waits=False)
        self.restart()

    def restart(self) -> None:
        """Forgets all motion: what comes next is another drive, or another part of one."""
        self._odometry = Odometry(self._settings.odometry)
        self._gaps = GapFiller(self._settings.gaps)
        self._outside = OutsideModel(self._settings.outside)
        self._repeats = Repeats(self._settings.frozen)
        self._stands = StandsStill(self._settings.frozen)
        self._fixed.restart()
        # Whether the steps of a frame log do not hold: landmarks of it are left out.
        self._again = False
        self._before: Frame | None = None
        self.examination.begin()

    def check(
        self, arrived: Arrived, motion: Motion | OutsideMotion | None, deadline_ms: float | None
    ) -> None:
        """Refuses what no step of this robot can take, before anything counts it."""
        if isinstance(arrived, StereoPair):
            check_pair(arrived)
        elif not isinstance(arrived, LoggedFrame):
            raise InputError(
                f"a robot takes an engram.StereoPair, not a value of {type(arrived).__name__}"
            )
        if deadline_ms is not None and not (isinstance(deadline_ms, Real) and -inf < deadline_ms):
            raise InputError(f"deadline_ms is {deadline_ms!r}, must be milliseconds, or None")
        camera = arrived.camera if isinstance(arrived, StereoPair) else arrived.frame.camera
        if self._camera is not None and camera != self._camera:
            raise IncompatibleError(
                f"the frame at {stamp_of(arrived)} ns is of camera {camera.id[:8]}, the robot's is "
                f"{self._camera.id[:8]}; use a separate robot for each camera"
            )
        if not isinstance(motion, Motion | OutsideMotion | None):
            raise InputError(
                f"motion is a value of {type(motion).__name__}, must be an OutsideMotion of wheels "
                "and gyroscope, or a Motion"
            )
        if motion is not None:
            check_motion(motion)

    @property
    def diagnosis(self) -> Diagnosis:
        """What the doctor finds in the first frames so far."""
        evidence = self._evidence()
        found = diagnose(evidence)
        if not self._fixed.share or evidence.camera is None:
            return found
        return replace(found, seen=self._fixed.mask(evidence.camera))

    @property
    def unfit(self) -> tuple[Finding, ...]:
        """What is fatal of that; spares what takes the doctor longest."""
        return fatal_findings(self._evidence())

    def _evidence(self) -> Evidence:
        evidence = self.examination.evidence
        evidence.fixed_share, evidence.doubted = self._fixed.share, self._fixed.doubts
        return evidence

    @property
    def fixed_share(self) -> float:
        """Share of the image that moves with the camera, and is left out."""
        return self._fixed.share

    @property
    def doubts(self) -> int:
        """Frames that leave open whether the camera or part of its image stood still."""
        return self._fixed.doubts

    def look_again(self) -> None:
        """Begins the drive again from its first frame, with what was learnt of the camera."""
        facts = self.examination.evidence.facts
        self.examination = Examination(self._settings.doctor)
        self.examination.evidence.facts = facts
        self._ahead.clear()
        self._fixed.doubts = 0
        self.restart()

    def match_again(self, live: Frame, best: Callable[[], Frame | None]) -> None:
        """Shows the doctor a frame and what it matched best in a map, if it asks for that."""
        if self.examination.wants_match() and (reference := best()) is not None:
            live = replace(live, further=None)  # the doctor keeps it, but not its images
            self.examination.match(reference, live, self._settings.localiser.matcher)

    def take_ahead(self, arrived: Arrived, outside: OutsideMotion | None = None) -> LoggedFrame:
        """Takes a frame before the robot does, which is then given the result."""
        frame, motion = self._taken(arrived, outside, StageClock())
        self._ahead.append(motion)
        most = self._settings.mapper.landmarks_for(frame.camera)
        if not most:  # nodes keep the landmarks of their live frames
            frame = replace(frame, further=None)
        elif frame.further is not None:  # now: its images are not kept until the robot drives
            further = frame.further(most)
            frame = replace(frame, further=lambda _: further)
        return LoggedFrame(frame, motion.odometry)

    def take(
        self,
        arrived: Arrived,
        motion: Motion | OutsideMotion | None = None,
        clock: StageClock | None = None,
    ) -> tuple[Frame, Motion]:
        """The frame and the camera's motion since the previous usable one.

        Args:
            arrived: a pair of images, or a frame of a log.
            motion: what wheels and gyroscope measured since the previous frame, or a `Motion` that
                replaces odometry; give the latter for all frames of the drive or for none.
        """
        if self._ahead and isinstance(arrived, LoggedFrame):
            return arrived.frame, self._ahead.popleft()
        return self._taken(arrived, motion, clock or StageClock())

    def left_out(self, motion: Motion | OutsideMotion | None) -> Motion:
        """The motion up to a frame that has no time: a guess, as for an unusable one."""
        if isinstance(motion, OutsideMotion):
            self._outside.add(motion)
        nothing = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
        return self._gaps.motion(nothing, self.clock.expected_ns, self._outside.guess())

    def _taken(
        self, arrived: Arrived, motion: Motion | OutsideMotion | None, clock: StageClock
    ) -> tuple[Frame, Motion]:
        measured = motion if isinstance(motion, OutsideMotion) else None
        if not isinstance(motion, Motion):
            self._outside.add(measured)
        frame = self._extracted(arrived, measured)
        clock.lap("frontend")
        look = self._fixed.look(
            frame, self._outside.guess(), None if measured is None else measured.prev_from_curr
        )
        frame = look.frame
        if not isinstance(motion, Motion):
            step = self._stepped(arrived, frame)
            if self._stands.add(step.prev_from_curr, self._trusted(measured)):
                frame = replace(frame, status=FrameStatus.FROZEN)
                step = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
            if astray := self._fixed.note(step.prev_from_curr, step.inliers):
                # Nobody knows how long it was led astray, nor how fast the robot is.
                self._gaps = GapFiller(self._settings.gaps)
            motion = self._moved(step, frame, doubted=astray or look.doubted)
        clock.lap("odometry")
        told = measured.prev_from_curr if measured is not None and measured.has_way else None
        turned_rad = None if measured is None else measured.turned_rad
        self.examination.see(arrived, frame, motion, told, turned_rad)
        clock.lap("doctor")
        return frame, motion

    def _extracted(self, arrived: Arrived, measured: OutsideMotion | None) -> Frame:
        """The frame of a pair or of a log; an old picture under a new stamp is unusable."""
        if isinstance(arrived, LoggedFrame):
            return arrived.frame
        frame = self._frontend.extract(arrived)
        repeats = self._repeats.sides(arrived)
        excused = all(repeats) and rests(self._trusted(measured), self._settings.frozen)
        if any(repeats) and not excused:
            return replace(frame, status=FrameStatus.FROZEN)
        return frame

    def _stepped(self, arrived: Arrived, frame: Frame) -> OdometryStep:
        """The step of odometry; that of a log holds as long as no landmark of it is left out."""
        if isinstance(arrived, LoggedFrame) and not self._again:
            if frame is arrived.frame:
                self._before = frame
                return arrived.odometry
            self._again = True
            if self._before is not None:
                self._odometry.step(self._before)
        return self._odometry.step(frame, self._outside.guess())

    def _trusted(self, measured: OutsideMotion | None) -> OutsideMotion | None:
        """What wheels and gyroscope measured since the last frame, while they can be trusted."""
        if measured is None or self._outside.guess() is None:
            return None
        return self._outside.corrected(measured)

    def _moved(self, step: OdometryStep, frame: Frame, *, doubted: bool) -> Motion:
        """Odometry's step weighed against those before it, and against wheels and gyroscope."""
        outside, landmarks = self._outside, len(frame.landmarks)
        doubted = doubted or outside.disproves(step, landmarks)
        motion = self._gaps.motion(
            step, frame.stamp_ns, outside.guess(), doubted=doubted, landmarks=landmarks
        )
        outside.compare(step)
        return motion


def check_motion(motion: Motion | OutsideMotion) -> None:
    """Refuses a motion that no robot makes: its position would rest on it from then on."""
    shape: tuple[int, ...]
    if isinstance(motion, OutsideMotion):
        number, array, shape, most = motion.seconds, motion.rates_rad_s, (3,), _LONGEST_S
    else:
        number, array, shape, most = motion.guessed_m, motion.covariance, (6, 6), inf
    pose = motion.prev_from_curr
    if pose is not None or isinstance(motion, OutsideMotion):
        if not isinstance(pose, SE3):
            raise InputError(f"motion.prev_from_curr is a {type(pose).__name__}, must be an SE3")
        way_m = np.abs(SE3.from_matrix(pose.matrix()).translation).max()
        if way_m > _FARTHEST_M:
            raise InputError(f"motion is {way_m:g} m long, at most {_FARTHEST_M:g}; give metres")
    given = np.zeros(shape) if array is None else np.asarray(array)
    if not 0 <= number <= most or given.shape != shape or not np.isfinite(given).all():
        raise InputError(
            f"motion: seconds or guessed_m is {number}, must be 0 to {most:g}; rates are (3,), "
            "covariances (6, 6) finite numbers"
        )


def check_position(position: Position, graph: ExperienceGraph) -> None:
    """Refuses a position at which no robot can be."""
    if not isinstance(position, Position):
        raise InputError(f"the place is a {type(position).__name__}, must be a Position")
    pose, covariance = position.node_from_live.matrix(), np.asarray(position.covariance)
    if covariance.shape != (6, 6) or not (
        np.isfinite(pose).all() and np.isfinite(covariance).all()
    ):
        raise InputError("a position's pose and (6, 6) covariance must be finite numbers")
    if position.node not in graph:
        raise InputError(
            f"the map has no node {position.node}; give a position in this map, or None: the "
            "robot then searches"
        )


def paced(items: Iterable[T], rate_hz: float | None) -> Iterator[tuple[float, T]]:
    """Each item with the time at which it arrives: at once, or at the given rate.

    At a rate, items arrive on schedule whether or not the consumer is ready, as on a robot: a late
    consumer finds the next item waiting.
    """
    first: float | None = None
    for count, item in enumerate(items):
        now = time.perf_counter()
        if rate_hz is None:
            yield now, item
            continue
        first = now if first is None else first
        due = first + count / rate_hz
        if due > now:
            time.sleep(due - now)
        yield due, item


def stamp_of(arrived: Arrived) -> int:
    """Stamp of a pair or logged frame, ns."""
    return int(arrived.stamp_ns if isinstance(arrived, StereoPair) else arrived.frame.stamp_ns)


def at_time(arrived: Arrived, time_ns: int) -> Arrived:
    """The same pair or logged frame with its time in place of its stamp."""
    if stamp_of(arrived) == time_ns:
        return arrived
    if isinstance(arrived, StereoPair):
        return replace(arrived, stamp_ns=time_ns)
    return replace(arrived, frame=replace(arrived.frame, stamp_ns=time_ns))


def arriving(sequence: Iterable[Arrived]) -> Generator[Arrived]:
    """The pairs or logged frames of a drive, decoded ahead of the consumer; see `read_ahead`."""
    return read_ahead(sequence, _READ_AHEAD)


def read_ahead(items: Iterable[T], depth: int) -> Generator[T]:
    """Iterates on its own thread, up to `depth` items ahead of the consumer.

    An error of the iteration is raised in place of the item. Close the generator when you leave it
    early: this ends the thread. Otherwise an error's traceback keeps the thread alive until the
    process ends, which crashes if the thread is inside C++ code.
    """
    queue: Queue[tuple[T | None, BaseException | None, bool]] = Queue(depth)
    stopped = Event()

    def produce() -> None:
        try:
            for item in items:
                queue.put((item, None, False))
                if stopped.is_set():
                    return
        except BaseException as error:  # raised again in the consumer's thread
            queue.put((None, error, True))
            return
        queue.put((None, None, True))

    producer = Thread(target=produce, name="engram-reader", daemon=True)
    producer.start()
    try:
        while True:
            item, error, last = queue.get()
            if error is not None:
                raise error
            if last:
                return
            yield item  # type: ignore[misc]  # an item comes with neither error nor end
    finally:
        stopped.set()
        while producer.is_alive():
            while not queue.empty():
                queue.get_nowait()
            producer.join(timeout=0.05)
