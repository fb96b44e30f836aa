"""One live drive: frames and motion in, results out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from engram.doctor.table import Finding
from engram.errors import EngramError, InputError
from engram.frontend.frame import DescriptorKind, StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.localiser.localisation import Localisation, LocalisationStatus, Position
from engram.maps.map import Map, open_map
from engram.odometry.motion import Motion
from engram.odometry.outside import OutsideMotion
from engram.robot.anchors import ReceiverFix
from engram.robot.drive_session import RobotSetup, Saving, SavingState
from engram.robot.front import Arrived, Front, at_time, stamp_of
from engram.robot.robot import DisplayPose, Robot
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_in
from engram.sequences.bags.fixes import Fix
from engram.sequences.clocks import SteadyClock


@dataclass(frozen=True, slots=True, eq=False)
class Outside:
    """Where wheels and gyroscope see the camera; what counts is how it changes.

    Attributes:
        wheels_from_live: its pose by wheel odometry, in a frame that stays; None without wheels.
        gyro_from_live: its rotation by a gyroscope, in a frame that stays, as a pose without a
            translation; None without one. It replaces the rotation of the wheels.
    """

    wheels_from_live: SE3 | None = None
    gyro_from_live: SE3 | None = None

    def since(self, before: Outside, seconds: float) -> OutsideMotion | None:
        """The motion since an earlier frame by what was there at both; None for nothing.

        Frames that repeat a stamp, or go back, measure nothing: there is no rate without time.

        The bias is still in it. What wheels measure at the camera holds the turn of its mounting
        by the wheels: the error is the length of the mounting times that of the turn.
        """
        if seconds <= 0:
            return None
        wheels = _between(before.wheels_from_live, self.wheels_from_live)
        gyro = _between(before.gyro_from_live, self.gyro_from_live)
        if gyro is None:
            return None if wheels is None else OutsideMotion(wheels, seconds)
        way = np.zeros(3) if wheels is None else wheels.translation
        rates_rad_s = gyro.log()[3:] / seconds
        return OutsideMotion(SE3(gyro.rotation, way), seconds, wheels is not None, rates_rad_s)


def _between(before: SE3 | None, after: SE3 | None) -> SE3 | None:
    return None if before is None or after is None else before.inverse() @ after


# Between attempts to open a map that cannot be opened.
_AGAIN_AFTER_S = 2.0
# What a robot found is then no longer kept.
_KEEPS_NO_MORE = {SavingState.FAILED, SavingState.UNCOMMITTED}
# Added to a position that was kept over a restart: wide enough that it proposes and proves nothing.
_KEPT_SIGMA_M, _KEPT_SIGMA_RAD = 2.0, 0.3


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """What a live process drives with.

    Attributes:
        map_path: the map; made if it does not exist and the robot maps.
        name: name of the robot.
        maps: whether it saves frames that it does not localise.
        settings: the resolved configuration.
        robot: policy, budget, deadline, relocaliser.
    """

    map_path: Path
    name: str = "robot"
    maps: bool = False
    settings: Settings = field(default_factory=Settings)
    robot: RobotOptions = field(default_factory=RobotOptions)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """Result of one frame.

    Attributes:
        motion: motion since the previous usable frame; None if the frame was not taken.
        found: the localisation; None without a robot, or if the frame was not taken.
        trouble: what went wrong; "" if nothing did.
        map_from_live: pose in the map frame; None where it is not known.
        proposed: whether the position still rests on a hint that no match has confirmed.
        time_ns: about when it was, ns: its stamp, unless that is wrong or the clock was set back.
        left_out: whether its stamp is wrong, so that it was not used.
    """

    motion: Motion | None = None
    found: Localisation | None = None
    trouble: str = ""
    map_from_live: SE3 | None = None
    proposed: bool = False
    time_ns: int = 0
    left_out: bool = False

    @property
    def status(self) -> str:
        """Status of the localisation, `fault` without one; who has but a hint is lost."""
        if self.found is None:
            return "fault"
        if self.proposed and self.found.status is LocalisationStatus.DEAD_RECKONING:
            return LocalisationStatus.LOST.value
        return self.found.status.value


class Watcher(Protocol):
    """Shows people what a robot does, such as `engram.viewing.viewer.Viewer`."""

    def watch(self, robot: Robot, opened: Map) -> None:
        """Shows a map, and from now on each frame of a robot in it."""


class Driving:
    """Takes frames whatever happens to the map, and reports what went wrong.

    Odometry continues over a switch of maps, an error and a map that cannot be opened. A position
    is kept over these, so vague that it only proposes where to look. One thread uses it.

    Args:
        now: the clock, seconds.
        watcher: shows each robot that drives; None to show none.
    """

    def __init__(
        self,
        options: LiveOptions,
        now: Callable[[], float] = time.monotonic,
        watcher: Watcher | None = None,
    ) -> None:
        self.options = options
        self._watcher = watcher
        self.trouble = ""
        # Of the drives so far: why what was said is not to be trusted.
        self.unfit: tuple[Finding, ...] = ()
        self._now = now
        self._camera: StereoCamera | None = None
        self._front: tuple[DescriptorKind, Front] | None = None
        self._map: Map | None = None
        self._display_pose: DisplayPose | None = None
        self._robot: Robot | None = None
        self._saved = Saving()
        self._belief: Position | None = None
        # Whether the robot's position is one that it was only told.
        self._proposed = False
        self._outside: Outside | None = None
        self._fix = ReceiverFix()
        self._open_after = -np.inf

    @property
    def saving(self) -> Saving:
        """Whether and where the drive is saved; of the last drive while none runs."""
        return self._saved if self._robot is None else self._robot.saving

    def step(
        self,
        arrived: Arrived,
        arrived_s: float | None = None,
        outside: Outside | None = None,
    ) -> Step:
        """Takes a frame: opens the map if it is not open, localises, and survives its errors.

        Args:
            arrived: the frame.
            arrived_s: `time.perf_counter` when it arrived; None for now.
            outside: what wheels and gyroscope say at its time.
        """
        frame = arrived if isinstance(arrived, StereoPair) else arrived.frame
        if self._camera is not None and frame.camera != self._camera:
            self.pause()
            self._front = None
        self._camera = frame.camera
        robot = self._robot or self._begun()
        front = self._front_for(None) if self._front is None else self._front[1]
        motion = self._driven(front.clock.elapsed_ns(frame.stamp_ns), outside)
        if robot is None:
            return self._only_moved(front, arrived, motion)
        steps = len(front.clock.steps)
        try:
            found = robot.step(arrived, motion=motion, arrived_s=arrived_s)
        except EngramError as error:
            self.pause()
            self.trouble, self._open_after = str(error), self._now() + _AGAIN_AFTER_S
            time_ns = front.clock.expected_ns
            taken = (result.motion for result in robot.track[-1:] if result.stamp_ns == time_ns)
            return Step(next(taken, None), trouble=self.trouble, time_ns=time_ns)
        self._belief = found.position
        map_from_live = None if self._display_pose is None else self._display_pose.after(found)
        if found.status is LocalisationStatus.LOCALISED or found.position is None or found.saved:
            self._proposed = False
        keeps_no_more = robot.saving.state in _KEEPS_NO_MORE
        self.trouble = robot.saving.reason if keeps_no_more else _untrusted(robot.unfit)
        clock = front.clock
        trouble = self.trouble or _stamp_trouble(clock, frame.stamp_ns, steps)
        place = map_from_live, self._proposed, clock.expected_ns, clock.newest_waits
        return Step(found.motion, found, trouble, *place)

    def _only_moved(self, front: Front, arrived: Arrived, motion: OutsideMotion | None) -> Step:
        """Takes a frame without a map: it yields only motion."""
        stamp_ns, steps = stamp_of(arrived), len(front.clock.steps)
        placed = front.clock.take(stamp_ns)
        if placed:
            moved = front.take(at_time(arrived, placed[-1].time_ns), motion)[1]
        else:
            moved = front.left_out(motion)
        trouble = _stamp_trouble(front.clock, stamp_ns, steps) or self.trouble
        time_ns = front.clock.expected_ns
        return Step(moved, trouble=trouble, time_ns=time_ns, left_out=not placed)

    def _driven(self, elapsed_ns: int, outside: Outside | None) -> OutsideMotion | None:
        """What wheels and gyroscope measured since the frame before; None if they did not."""
        before, self._outside = self._outside, outside
        if before is None or outside is None:
            return None
        return outside.since(before, elapsed_ns / 1e9)

    def map_on(self, on: bool) -> str:
        """Starts or ends mapping; ending commits what was mapped."""
        said = self.pause()
        self.options = replace(self.options, maps=on)
        return said or f"mapping is {'on' if on else 'off'}"

    def switch(self, path: Path) -> str:
        """Continues in another map, or in the newest revision of the same, with its odometry.

        Raises:
            EngramError: it cannot be opened; the robot stays in the old one.
        """
        if not self.options.maps or path.exists():
            open_map(path).close()
        said = self.pause()
        self.options = replace(self.options, map_path=path)
        return said or f"the map is {path}"

    def lose(self) -> str:
        """Discards the position: the robot was carried elsewhere."""
        self._belief = None
        if self._robot is not None:
            self._robot.lose()
        return "the robot searches the whole map for its place"

    def place(self, position: Position) -> str:
        """Takes a position as a hint, such as the last one before a restart: it only proposes."""
        self._belief = position
        self._use_belief()
        return "the hint is accepted"

    def here(self, x_m: float, y_m: float, yaw_rad: float) -> str:
        """Takes the camera's place in the map frame as a hint, from a person who looks at the map.

        Raises:
            InputError: no map is open yet, it has no nodes, or a number is not finite.
        """
        if self._map is None:
            raise InputError("no map is open yet: it is opened with the first image")
        goal = self._map.frame.goal(x_m, y_m, yaw_rad)
        self.lose()
        return self.place(Position(goal.node, goal.node_from_goal, np.zeros((6, 6))))

    def fixed(self, fix: Fix) -> str:
        """Takes a satellite fix: near it a lost robot looks, in a map anchored to the earth."""
        clock = None if self._front is None else self._front[1].clock
        if clock is not None and clock.time_ns is not None:
            # The receiver's clock is that of the camera, or one that was not set with it.
            newest_ns, times = clock.time_ns, (fix.time_ns, fix.time_ns + clock.shift_ns)
            fix = replace(fix, time_ns=min(times, key=lambda one: abs(one - newest_ns)))
        self._fix.tell(fix)
        return "the fix is accepted"

    def pause(self) -> str:
        """Closes robot and map, and so commits what was mapped; the next frame opens them again.

        Returns:
            Outcome of the drive; "" if none was saved.
        """
        robot, self._robot = self._robot, None
        self._proposed = False
        if self._front is not None and self._front[1].clock.shift_ns:
            self._front = self._outside = None  # times of the next drive are stamps again
        opened, self._map, self._display_pose = self._map, None, None
        self._open_after = -np.inf
        if robot is None or opened is None:
            return ""
        try:
            robot.close()
        except EngramError as error:
            self.trouble = str(error)
        finally:
            self.unfit = self.unfit or robot.unfit
            self._saved = robot.saving
            with suppress(EngramError):  # the drive is what counts, and it is committed or reported
                opened.close()
        return "" if self._saved.state is SavingState.OFF else self._saved.text()

    def _begun(self) -> Robot | None:
        """A robot in the map; None while that cannot be opened."""
        if self._now() < self._open_after:
            return None
        assert self._camera is not None
        options = self.options
        try:
            self._map = self._map_of(options)
            setup = RobotSetup(self._camera, options.settings, options.robot, options.name)
            front = self._front_for(self._map.descriptor)
            self._robot = robot_in(self._map, setup, maps=options.maps, front=front, fix=self._fix)
        except EngramError as error:
            if self._map is not None:
                self._map.close()
            self._map = None
            self.trouble, self._open_after = str(error), self._now() + _AGAIN_AFTER_S
            return None
        self._use_belief()
        self._display_pose = DisplayPose(self._map.frame, self._robot.graph)
        if self._watcher is not None:
            self._watcher.watch(self._robot, self._map)
        self.trouble = ""
        return self._robot

    def _use_belief(self) -> None:
        """Gives the robot the position that was kept, if its map contains the node."""
        if self._robot is None or self._map is None:
            return
        belief, self._belief = self._belief, None
        if belief is not None and belief.node in self._map.graph:
            self._robot.place_at(_vague(belief))
            self._proposed = True

    @staticmethod
    def _map_of(options: LiveOptions) -> Map:
        path = options.map_path
        if path.exists():
            return open_map(path)
        if not options.maps:
            raise InputError(f"{path} does not exist; make it with engram map, or switch maps")
        return open_map(path, create=True)

    def _front_for(self, descriptor: DescriptorKind | None) -> Front:
        """Front-end and odometry; the same as before unless the kind of descriptor changes."""
        settings = self.options.settings.for_descriptor(descriptor)
        kind = settings.frontend.descriptor
        if self._front is None or self._front[0] != kind:
            self._front = kind, Front(settings)
        return self._front[1]


def _stamp_trouble(clock: SteadyClock, stamp_ns: int, steps: int) -> str:
    """What is wrong with the newest stamp; "" if nothing is.

    Args:
        clock: the clock, which has taken it.
        steps: how often the clock had been set before.
    """
    if len(clock.steps) > steps:
        return f"{clock.steps[-1].text()}; the drive continues"
    if clock.time_ns is None or not clock.newest_waits:
        return ""
    off_ms = (stamp_ns + clock.shift_ns - clock.time_ns) / 1e6
    return f"a frame is stamped {off_ms:+.0f} ms from the newest good one; left out"


def _vague(position: Position) -> Position:
    doubt = np.diag(np.repeat([_KEPT_SIGMA_M**2, _KEPT_SIGMA_RAD**2], 3))
    return Position(position.node, position.node_from_live, position.covariance + doubt)


def _untrusted(unfit: Sequence[Finding]) -> str:
    """The warning about a drive with these fatal findings."""
    return "" if not unfit else "not to be trusted: " + "; ".join(one.message for one in unfit)
