"""A process that localises while a robot drives."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, Thread
from typing import Any, TypeVar
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.doctor.table import Finding
from engram.errors import EngramError, InputError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.model import NodeId
from engram.live.driving import Driving, LiveOptions, Step, Watcher
from engram.live.served import Command, FrameEvent, Message, Transport
from engram.localiser.localisation import Position
from engram.robot.drive_session import Saving
from engram.sequences.bags.fixes import Fix

# A motion that was guessed for longer, or less surely, is no step: the robot may have stood.
_LONGEST_GUESS_NS, _LARGEST_SIGMA_M = 1_000_000_000, 1.0
# After a guess, a step may differ from going on as before by this share of it, and by so much;
# a guess itself, by wheels, by more.
_UNLIKE, _LONGER_BY, _LEAST_STEP_M, _LEAST_TURN_RAD = 0.5, 1.0, 0.05, 0.03
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Odometry since the start; while the camera sees nothing it continues by the guess.

    Where that turns out wrong, the track continues from the guess rather than jump to what was
    measured; once nothing bounds the motion it stays where it is. Its covariance keeps the
    possible error.

    Attributes:
        odom_from_live: pose of the camera in that of its first image.
        covariance: (6, 6) float64 of `odom_from_live`, left perturbation, [translation, rotation].
    """

    odom_from_live: SE3 = field(default_factory=SE3.identity)
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))
    # Of the newest usable frame, from which a guess goes ahead.
    _usable: tuple[SE3, NDArray[np.float64]] | None = None
    _stamp_ns: int | None = None
    # Of the newest step, (6,) m/s and rad/s; None before the first.
    _twist_per_s: NDArray[np.float64] | None = None
    # Whether the newest step was guessed, and taken.
    _guessed: bool = False

    def after(self, step: Step, stamp_ns: int) -> Track:
        """The track after one more frame; it holds still where the motion is unknown."""
        motion = step.motion
        since_ns = None if self._stamp_ns is None else stamp_ns - self._stamp_ns
        if motion is None:
            return self if since_ns is not None and since_ns <= 0 else self._at(stamp_ns)
        base, base_covariance = self._usable or (self.odom_from_live, self.covariance)
        ahead = motion.ahead
        if motion.prev_from_curr is not None and motion.covariance is not None:
            ahead = motion.prev_from_curr, motion.covariance
            measured = motion.odometry.prev_from_curr
            if not motion.guessed_m and measured is not None:
                # What it makes up for, from before odometry began, would be a jump.
                ahead = measured, _held(measured, *ahead)
        if ahead is None:
            return replace(self, _usable=None, _stamp_ns=stamp_ns)
        to = base @ ahead[0]
        covariance = propagate_covariance(base, base_covariance, ahead[1])
        guessed = motion.guessed_m > 0 or motion.ahead is not None
        moved = self.odom_from_live.inverse() @ to
        seconds = (since_ns or 0) / _NS_PER_S
        doubtful = guessed and (
            (since_ns or 0) > _LONGEST_GUESS_NS or ahead[1][:3, :3].max() > _LARGEST_SIGMA_M**2
        )
        taken = SE3.identity() if doubtful else self._without_jump(moved, seconds, guessed)
        stays = to if taken is moved else self.odom_from_live @ taken
        covariance = _held(stays, to, covariance)
        usable = None
        if motion.ahead is not None:
            # From where the guess would have led here: what comes next goes on from here.
            back = base if taken is moved or doubtful else stays @ ahead[0].inverse()
            usable = back, _held(stays, to, base_covariance)
        twist_per_s = taken.log() / seconds if seconds > 0 else self._twist_per_s
        return Track(stays, covariance, usable, stamp_ns, twist_per_s, guessed and not doubtful)

    def _without_jump(self, moved: SE3, seconds: float, guessed: bool) -> SE3:
        """A step; the same motion as before where the step would make up for a wrong guess."""
        blind = self._usable is not None or guessed or self._guessed
        if not blind or self._twist_per_s is None:
            return moved
        as_before = SE3.exp(self._twist_per_s * seconds)
        away = as_before.inverse() @ moved
        longer_by = _LONGER_BY if guessed else _UNLIKE
        most_m = longer_by * as_before.distance_m + _LEAST_STEP_M
        # A gyroscope may feel a turn that the camera does not see.
        most_rad = np.inf if guessed else _UNLIKE * as_before.angle_rad + _LEAST_TURN_RAD
        jumps = (
            min(moved.distance_m, away.distance_m) > most_m
            or min(moved.angle_rad, away.angle_rad) > most_rad
        )
        return as_before if jumps else moved

    def _at(self, stamp_ns: int) -> Track:
        return replace(self, _stamp_ns=stamp_ns)


def _held(held: SE3, believed: SE3, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of the held pose, including its offset from the current estimate."""
    error = (believed @ held.inverse()).log()
    return covariance + np.outer(error, error)


T = TypeVar("T")

# Between two messages that the process is alive.
_HEARTBEAT_S = 0.2
# Without a frame for longer, the camera counts as silent.
_SILENT_S = 1.0


@dataclass(frozen=True, slots=True)
class Health:
    """The status message of the process, five times a second.

    Attributes:
        status: `starting`, `no images`, `fault`, or the status of the newest frame.
        trouble: what is wrong, for people; "" if nothing is.
        frames, dropped: frames taken, and dropped for newer ones, since the start.
        seen_s: `time.monotonic` at the newest frame; None before the first.
    """

    status: str = "starting"
    trouble: str = ""
    frames: int = 0
    dropped: int = 0
    seen_s: float | None = None


class LiveProcess:
    """Runs a robot from a transport until that ends or a stop is requested.

    Args:
        transport: brings frames and commands.
        now: the clock, seconds.
        watcher: shows each robot that drives; None to show none.
    """

    def __init__(
        self,
        transport: Transport,
        options: LiveOptions,
        now: Callable[[], float] = time.monotonic,
        watcher: Watcher | None = None,
    ) -> None:
        self._transport = transport
        self._driving = Driving(options, now, watcher)
        self._now = now
        self._health = Health()
        self._track = Track()
        self._answers: dict[str, Callable[[Message], str]] = {
            "map": lambda given: self._driving.map_on(_of(bool, given.get("on", True))),
            "save": lambda _: self._driving.pause() or "nothing was to be saved",
            "switch": lambda given: self._driving.switch(Path(_of(str, given["map"]))),
            "relocalise": lambda _: self._driving.lose(),
            "place": lambda given: self._driving.place(_position(given)),
            "fix": lambda given: self._driving.fixed(_fix(given)),
            "here": lambda given: self._driving.here(
                *(float(given[name]) for name in ("x_m", "y_m", "yaw_rad"))
            ),
        }

    @property
    def saving(self) -> Saving:
        """Whether and where the drive is saved."""
        return self._driving.saving

    @property
    def unfit(self) -> tuple[Finding, ...]:
        """Fatal findings about the drives that ended: why their results cannot be trusted."""
        return self._driving.unfit

    def run(self) -> None:
        """Serves frames and commands; on leaving, what was mapped is committed."""
        ended = Event()
        pulse = Thread(target=self._beat, args=(ended,), name="engram-pulse", daemon=True)
        pulse.start()
        try:
            for event in self._transport.events():
                if isinstance(event, FrameEvent):
                    self._take(event)
                elif isinstance(event, Command) and not self._obey(event):
                    break
        finally:
            said = self._driving.pause()
            ended.set()
            pulse.join()
            unfit = [one.code for one in self.unfit]
            self._transport.tell({"is": "ended", "text": said, "unfit": unfit, **self._saving()})

    def _take(self, event: FrameEvent) -> None:
        step = self._driving.step(event.arrived, event.arrived_s, event.outside)
        arrived = event.arrived
        stamp_ns = (arrived if isinstance(arrived, StereoPair) else arrived.frame).stamp_ns
        self._track = self._track.after(step, step.time_ns)
        status = step.status
        before = self._health
        self._health = replace(
            before,
            status=status,
            trouble=step.trouble,
            frames=before.frames + 1,
            dropped=before.dropped + event.dropped,
            seen_s=self._now(),
        )
        self._transport.tell(
            {
                "is": "seen",
                "stamp_ns": stamp_ns,
                "status": status,
                "trouble": step.trouble,
                "odom_from_live": _flat(self._track.odom_from_live.matrix()),
                "odom_covariance": _flat(self._track.covariance),
                "ms": 1e3 * (time.perf_counter() - event.arrived_s),
                **({"left_out": True} if step.left_out else {}),
                **_found(step),
                **self._placed(step),
            }
        )

    def _placed(self, step: Step) -> Message:
        """The pose in the map frame, where the belief's node has a place in it."""
        position = None if step.found is None else step.found.position
        if position is None or step.map_from_live is None or step.proposed:
            return {}
        adjoint = (step.map_from_live @ position.node_from_live.inverse()).adjoint()
        return {
            "map_from_live": _flat(step.map_from_live.matrix()),
            "map_covariance": _flat(adjoint @ position.covariance @ adjoint.T),
        }

    def _obey(self, command: Command) -> bool:
        """Answers a command; False after `stop`."""
        if command.do == "stop":
            return False
        done, text = False, f"{command.do!r} is not a command: " + ", ".join(self._answers)
        if command.do in self._answers:
            try:
                done, text = True, self._answers[command.do](command.given)
            except EngramError as error:
                done, text = False, str(error)
            except KeyError as error:
                done, text = False, f"{command.do} needs {error}"
            except (TypeError, ValueError, OverflowError) as error:
                done, text = False, f"{command.do} is not understood: {error}"
        reply = {"is": "reply", "id": command.id, "do": command.do, "ok": done, "text": text}
        self._transport.tell(reply)
        return True

    def _beat(self, ended: Event) -> None:
        while not ended.wait(_HEARTBEAT_S):
            with suppress(OSError):  # nobody listens: whoever does next hears the next
                self._transport.tell(self.alive())

    def alive(self) -> Message:
        """The message that the process is alive, and how it is."""
        health = self._health
        age_s = None if health.seen_s is None else self._now() - health.seen_s
        status = health.status
        if age_s is not None and age_s > _SILENT_S:
            status = "no images"
        options = self._driving.options
        return {
            "is": "alive",
            "status": status,
            "trouble": health.trouble or self._driving.trouble,
            "age_s": age_s,
            "frames": health.frames,
            "dropped": health.dropped,
            "map": str(options.map_path),
            "maps": options.maps,
            **self._saving(),
        }

    def _saving(self) -> Message:
        saving = self.saving
        return {
            "saving": saving.state.value,
            "nodes": saving.nodes,
            "revision": saving.revision,
            "recovered": list(saving.recovered),
        }


def _found(step: Step) -> Message:
    """The message for a localisation; a pose only where there is one, with its covariance."""
    found = step.found
    if found is None:
        return {}
    said: dict[str, Any] = {
        "attempts": found.attempts,
        "inliers": found.inliers,
        "confidence": found.confidence if math.isfinite(found.confidence) else None,
        "late": found.late,
        "withdraws": list(found.withdraws),
        "open_loop_m": found.open_loop_m,
        "saved": None if found.saved is None else str(found.saved),
    }
    if found.position is not None and not step.proposed:
        said["node"] = str(found.position.node)
        said["node_from_live"] = _flat(found.position.node_from_live.matrix())
        said["covariance"] = _flat(found.position.covariance)
    return said


def _of(kind: type[T], value: Any) -> T:
    """A value of a message that must be of this kind: "off" is no false."""
    if not isinstance(value, kind):
        raise TypeError(f"{value!r} is not a {kind.__name__}")
    return value


def _position(given: Message) -> Position:
    """The position of a message, as `_found` writes it."""
    pose = SE3.from_matrix(np.array(given["node_from_live"], np.float64).reshape(4, 4))
    covariance = np.array(given["covariance"], np.float64).reshape(6, 6)
    if not np.isfinite(covariance).all():
        raise InputError("the covariance of a position must be finite")
    return Position(NodeId(UUID(str(given["node"]))), pose, covariance)


def _fix(given: Message) -> Fix:
    """The satellite fix of a message."""
    at = float(given["latitude_deg"]), float(given["longitude_deg"])
    sigma_m = None if given.get("sigma_m") is None else float(given["sigma_m"])
    known = sigma_m is None or 0 < sigma_m < math.inf
    if not (abs(at[0]) <= 90 and abs(at[1]) <= 180 and known):
        raise InputError(
            f"not a valid satellite fix: latitude and longitude {at} degrees, deviation "
            f"{sigma_m} m, must be > 0"
        )
    return Fix(int(given["stamp_ns"]), *at, None, sigma_m)


def _flat(array: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in array.ravel()]
