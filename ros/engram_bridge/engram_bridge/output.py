"""What the bridge publishes: odometry, pose, path, transforms; and status, whatever happens."""

from __future__ import annotations

import json
import threading

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import QoSProfile
from rclpy.time import Time
from std_msgs.msg import String

from engram_bridge import rigid

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # an installation without tf: poses go out as topics only
    TFMessage = None
try:
    from engram_msgs.msg import Status
except ImportError:  # not built: the same is said as JSON
    Status = None

_PATH = 1000  # poses of the path that is shown
_PATH_EVERY_NS = 1_000_000_000  # between two publications of it, to whoever subscribes
# After so long without a frame, map -> odom is kept up by itself.
_NO_FRAME_NS = 250_000_000
# A stamp that is earlier by more is a clock that was set back, not a message out of order.
_SET_BACK_NS = 1_000_000_000


class Poses:
    """Publishes what a frame changed, stamped with its time: never with a later one.

    Threads may share it.

    Args:
        node: the ROS node.
        given: its parameters.
    """

    def __init__(self, node, given) -> None:
        queue = QoSProfile(depth=10)
        self._given = given
        self._odometry = node.create_publisher(Odometry, "odom", queue)
        self._pose = node.create_publisher(PoseWithCovarianceStamped, "pose", queue)
        self._driven = node.create_publisher(Path, "path", queue)
        self._tf = None if TFMessage is None else node.create_publisher(TFMessage, "/tf", queue)
        self._path, self._path_ns = Path(), 0
        self._lock = threading.Lock()
        self._map_stamp_ns = None
        self._publishers = [self._odometry, self._pose, self._driven, self._tf]

    def destroy(self, node) -> None:
        """Ends publishing."""
        for one in filter(None, self._publishers):
            node.destroy_publisher(one)

    def say(self, belief) -> None:
        """Publishes the newest frame of a belief."""
        stamp_ns, odom_from_base = belief.stamp_ns, belief.odom_from_base
        stamp = Time(nanoseconds=stamp_ns).to_msg()
        odometry = Odometry()
        odometry.header.stamp, odometry.header.frame_id = stamp, self._given["odom_frame"]
        odometry.child_frame_id = self._given["base_frame"]
        _put(odometry.pose.pose, odom_from_base)
        own = rigid.at_its_own_origin(odom_from_base, belief.odom_covariance)
        odometry.pose.covariance = own.ravel().tolist()
        self._odometry.publish(odometry)
        transforms = []
        if self._given["publish_odom_tf"]:
            parent, child = odometry.header.frame_id, odometry.child_frame_id
            transforms.append(_transform(stamp, parent, child, odom_from_base))
        self._send(transforms + self._corrections(belief.map_from_odom, stamp_ns))
        map_pose = belief.map_pose
        if map_pose is not None:
            self._say_pose(stamp, *map_pose)
            self._say_path(stamp_ns)

    def keep_up(self, belief, now_ns: int) -> None:
        """Repeats map -> odom, stamped with now, while no frame comes."""
        last_ns = belief.stamp_ns
        if last_ns is not None and 0 <= now_ns - last_ns < _NO_FRAME_NS:
            return
        self._send(self._corrections(belief.map_from_odom, now_ns))

    def _corrections(self, map_from_odom, stamp_ns: int):
        """The transform map -> odom; stamps only rise, or an older one would hold again."""
        if map_from_odom is None or not self._given["publish_map_tf"]:
            return []
        with self._lock:
            since_ns = None if self._map_stamp_ns is None else stamp_ns - self._map_stamp_ns
            if since_ns is not None and -_SET_BACK_NS < since_ns <= 0:
                return []
            self._map_stamp_ns = stamp_ns
        stamp = Time(nanoseconds=stamp_ns).to_msg()
        parent, child = self._given["map_frame"], self._given["odom_frame"]
        return [_transform(stamp, parent, child, map_from_odom)]

    def _send(self, transforms) -> None:
        if self._tf is not None and transforms:
            self._tf.publish(TFMessage(transforms=transforms))

    def _say_pose(self, stamp, map_from_base, covariance) -> None:
        pose = PoseWithCovarianceStamped()
        pose.header.stamp, pose.header.frame_id = stamp, self._given["map_frame"]
        _put(pose.pose.pose, map_from_base)
        pose.pose.covariance = covariance.ravel().tolist()
        self._pose.publish(pose)
        self._path.header = pose.header
        self._path.poses.append(PoseStamped(header=pose.header, pose=pose.pose.pose))
        del self._path.poses[:-_PATH]

    def _say_path(self, stamp_ns: int) -> None:
        """A thousand poses cost more than all else that a frame brings: not with every one."""
        late = not 0 <= stamp_ns - self._path_ns < _PATH_EVERY_NS
        if late and self._driven.get_subscription_count():
            self._path_ns = stamp_ns
            self._driven.publish(self._path)


class Ticking:
    """Does something at a fixed rate on a thread of its own: no callback holds it up.

    Args:
        node: the ROS node.
        every_s: seconds between two calls.
        act: what it does.
    """

    def __init__(self, node, every_s: float, act) -> None:
        self._node, self._every_s, self._act = node, every_s, act
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends it."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(self._every_s):
            try:
                self._act()
            except Exception as error:  # noqa: PERF203  # one that fails is said, and the next one is tried
                if self._node.context.ok():
                    self._node.get_logger().error(repr(error), throttle_duration_sec=5.0)


class StatusReport:
    """Publishes the status at a fixed rate.

    Args:
        node: the ROS node.
        state: gives (level, summary, facts by name), as `Belief.report` does.
        rate_hz: reports a second.
        robot: its name.
    """

    def __init__(self, node, state, rate_hz: float, robot: str) -> None:
        queue = QoSProfile(depth=10)
        self._node, self._state, self._robot = node, state, robot
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", queue)
        self._status = node.create_publisher(Status or String, "~/status", queue)
        self._ticking = Ticking(node, 1.0 / rate_hz, self._report)

    def close(self) -> None:
        """Ends reporting."""
        self._ticking.close()

    def _report(self) -> None:
        level, summary, facts = self._state()
        status = DiagnosticStatus(level=bytes([level]), name="engram", message=summary)
        status.hardware_id = self._robot
        status.values = [KeyValue(key=key, value=str(value)) for key, value in facts.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(array)
        said = String(data=json.dumps({"summary": summary, **facts}))
        self._status.publish(said if Status is None else _status(array.header, facts))


def _status(header, facts):
    """The facts as a message of `engram_msgs`."""
    said = Status(header=header, age_s=-1.0)
    for name, kind in said.get_fields_and_field_types().items():
        value = facts.get(name)
        if value is None or name == "header":
            continue
        made = str if kind == "string" else float if kind == "double" else int
        setattr(said, name, made(value))
    return said


def _put(pose, matrix) -> None:
    pose.position.x, pose.position.y, pose.position.z = (float(one) for one in matrix[:3, 3])
    turn = pose.orientation
    turn.x, turn.y, turn.z, turn.w = (float(one) for one in rigid.quaternion(matrix))


def _transform(stamp, parent: str, child: str, matrix):
    said = TransformStamped()
    said.header.stamp, said.header.frame_id, said.child_frame_id = stamp, parent, child
    shift, turn = said.transform.translation, said.transform.rotation
    shift.x, shift.y, shift.z = (float(one) for one in matrix[:3, 3])
    turn.x, turn.y, turn.z, turn.w = (float(one) for one in rigid.quaternion(matrix))
    return said
