"""From the messages of the live process to what a robot's other nodes need: frames and status.

Frames follow REP-103 and REP-105: ``odom_from_base`` is continuous and never jumps, whatever the
map says and however often the live process is started again; ``map_from_odom`` carries the
corrections, stays as it is while nothing is seen, and is unknown before the first fix.
"""

from __future__ import annotations

import threading

import numpy as np

from engram_bridge import rigid

# Without a message for so long, nobody knows anything any more.
_SILENT_S = 1.0
# A stamp that is earlier by less is a frame that came late; by more, a clock that was set back.
_LATE_FRAME_NS = 1_000_000_000
# What a robot that nobody watched may have done meanwhile: it drove on, or set off at a walk.
_LEAST_SPEED_M_S, _TURN_RAD_S = 0.5, 0.5


class Belief:
    """What is known, from all messages so far; threads may share it.

    Args:
        base_from_camera: (4, 4), pose of the left camera (x right, y down, z ahead) on the robot;
            None while it is unknown: then nothing moves until `mount`.
    """

    def __init__(self, base_from_camera=None) -> None:
        self.map_from_odom = None
        self.odom_from_base = np.eye(4)
        self.odom_covariance = np.zeros((6, 6))
        self.stamp_ns = None
        self.lock = threading.Lock()
        self._base_from_camera = self._camera_from_base = None
        if base_from_camera is not None:
            self.mount(base_from_camera)
        # Odometry when the process that now runs began its own.
        self._odom_from_start = np.eye(4)
        self._covariance_at_start = np.zeros((6, 6))
        self._last = {}
        self._alive = {}
        self._heard_s = None
        self._speed_m_s = 0.0
        self._unwatched = False

    def mount(self, base_from_camera) -> None:
        """Sets where the left camera is on the robot, (4, 4)."""
        self._base_from_camera = base_from_camera
        self._camera_from_base = rigid.inverse(base_from_camera)

    @property
    def mounted(self) -> bool:
        """Whether the camera's place on the robot is known."""
        return self._base_from_camera is not None

    def began(self) -> None:
        """A live process began anew: its odometry starts from where the robot is."""
        with self.lock:
            self._odom_from_start = self.odom_from_base
            self._covariance_at_start = self.odom_covariance
            # What the old process said of itself is not true of the new one.
            self._last, self._alive = {}, {}
            self._unwatched = True

    def hear(self, message, now_s: float) -> bool:
        """Takes a message; True if it moved the robot."""
        with self.lock:
            self._heard_s = now_s
            if message.get("is") == "alive":
                self._alive = message
            if message.get("is") != "seen":
                return False
            if message.get("left_out"):
                return False  # its stamp is wrong: nothing must be published with it
            since_ns = None if self.stamp_ns is None else message["stamp_ns"] - self.stamp_ns
            if since_ns is not None and -_LATE_FRAME_NS < since_ns <= 0:
                return False  # a frame that came late, and was left out
            if since_ns is not None and since_ns < 0:
                self.map_from_odom = None  # the clock went back: that was of another time
            self._last = message
            self.stamp_ns = message["stamp_ns"]
            if not self.mounted:
                return False
            self._move(message, None if since_ns is None else max(since_ns, 0) / 1e9)
            return True

    def _move(self, message, since_s) -> None:
        before = self.odom_from_base
        if self._unwatched and since_s is not None:
            self._covariance_at_start = self._covariance_at_start + self._doubt(since_s)
        self._unwatched = False
        start_from_camera = _matrix(message["odom_from_live"], 4)
        moved = self._base_from_camera @ start_from_camera @ self._camera_from_base
        self.odom_from_base = self._odom_from_start @ moved
        own = rigid.adjoint(self._odom_from_start @ self._base_from_camera)
        since = own @ _matrix(message["odom_covariance"], 6) @ own.T
        self.odom_covariance = self._covariance_at_start + since
        if since_s:
            moved_m = np.linalg.norm(self.odom_from_base[:3, 3] - before[:3, 3])
            self._speed_m_s = float(moved_m) / since_s
        if self.localised and message.get("map_from_live") is not None:
            map_from_base = _matrix(message["map_from_live"], 4) @ self._camera_from_base
            self.map_from_odom = map_from_base @ rigid.inverse(self.odom_from_base)

    def _doubt(self, seconds: float):
        """(6, 6): what may have happened between two processes, around the robot."""
        way_m = seconds * max(self._speed_m_s, _LEAST_SPEED_M_S)
        turn_rad = min(seconds * _TURN_RAD_S, np.pi)
        around = np.diag(np.repeat([way_m**2, turn_rad**2], 3))
        own = rigid.adjoint(self._odom_from_start)
        return own @ around @ own.T

    @property
    def localised(self) -> bool:
        """Whether the newest frame was matched with the map."""
        return self._last.get("status") == "localised"

    @property
    def map_pose(self):
        """(map_from_base (4, 4), covariance (6, 6) as ROS states it) of the newest frame, or None.

        None while the robot is lost or the map has no frame: never a pose with a covariance that
        is smaller than what is known.
        """
        if self._last.get("map_covariance") is None or self._last.get("map_from_live") is None:
            return None
        if not self.mounted or self._last.get("status") not in ("localised", "dead_reckoning"):
            return None
        map_from_base = _matrix(self._last["map_from_live"], 4) @ self._camera_from_base
        covariance = _matrix(self._last["map_covariance"], 6)
        return map_from_base, rigid.at_its_own_origin(map_from_base, covariance)

    def report(self, now_s: float):
        """(level 0, 1 or 2, summary, facts by name): how the robot is, whatever happened."""
        with self.lock:
            facts = {
                **self._alive,
                **{key: self._last.get(key) for key in _TOLD if key in self._last},
            }
            facts.pop("is", None)
            if self._heard_s is None or now_s - self._heard_s > _SILENT_S:
                since = "yet" if self._heard_s is None else f"for {now_s - self._heard_s:.1f} s"
                facts["status"] = "no process"
                return 2, f"engram live has said nothing {since}", facts
            status = facts.setdefault("status", "starting")
            trouble = self._alive.get("trouble")
            summary = f"{status}: {trouble}" if trouble else status
            if status in ("fault", "no images"):
                return 2, summary, facts
            return (0 if status == "localised" and not trouble else 1), summary, facts


_TOLD = ("node", "attempts", "inliers", "confidence", "open_loop_m", "late", "ms")


def _matrix(values, side: int):
    return np.array(values, np.float64).reshape(side, side)
