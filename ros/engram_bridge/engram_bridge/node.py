"""The ROS 2 node: images in; odometry, pose, transforms, status out; services."""

from __future__ import annotations

import functools
import json
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from engram_bridge import images, rigid
from engram_bridge.belief import Belief
from engram_bridge.pairs import Pairs
from engram_bridge.supervisor import Supervisor
from engram_bridge.wheels import Wheels

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # an installation without tf: poses go out as topics only
    TFMessage = None
try:
    from engram_msgs.msg import Status
except ImportError:  # not built: the same is said as JSON
    Status = None

_PARAMETERS = {
    "command": ["engram"],
    "map": "",
    "robot": "robot",
    "mapping": False,
    "deadline_ms": 40.0,
    "settings": [""],
    "left": "left/image_rect",
    "right": "right/image_rect",
    "left_info": "left/camera_info",
    "right_info": "right/camera_info",
    "wheels": "",
    "compressed": False,
    "rectified": True,
    "pair_tolerance_ms": 2.0,
    "map_frame": "map",
    "odom_frame": "odom",
    "base_frame": "base_link",
    "publish_odom_tf": True,
    "publish_map_tf": True,
    "base_from_camera": [0.0, 0.0, 0.0, -1.5707963, 0.0, -1.5707963],
    "status_rate": 5.0,
}
_PATH = 1000  # poses of the path that is shown
_QUIET_S = 5.0  # between two warnings of one kind


class Bridge(Node):
    """Subscribes to a stereo camera, keeps `engram live` running, and publishes what it says."""

    def __init__(self) -> None:
        super().__init__("engram")
        for name, value in _PARAMETERS.items():
            self.declare_parameter(name, value)
        self._base_from_camera = rigid.of_xyz_rpy(self._given("base_from_camera"))
        self._belief = Belief(self._base_from_camera)
        self._pairs = Pairs(int(1e6 * self._given("pair_tolerance_ms")))
        self._wheels = Wheels()
        self._infos = [None, None]
        self._path = Path()
        self._publish()
        self._supervisor = Supervisor(self._command(), self._hear, self.get_logger().warning)
        self._subscribe()
        self._serve()
        self.add_on_set_parameters_callback(self._changed)
        self.create_timer(1.0 / self._given("status_rate"), self._report)
        self._supervisor.start()

    def close(self) -> None:
        """Ends the live process, which commits what it mapped."""
        self._supervisor.close()

    def _given(self, name: str):
        return self.get_parameter(name).value

    def _command(self):
        command = [*self._given("command"), "live", self._given("map")]
        command += ["--robot", self._given("robot")]
        if self._given("mapping"):
            command.append("--map")
        if self._given("deadline_ms") > 0:
            command += ["--deadline", str(self._given("deadline_ms"))]
        for setting in filter(None, self._given("settings")):
            command += ["--set", setting]
        return command

    def _publish(self) -> None:
        queue = QoSProfile(depth=10)
        self._odometry = self.create_publisher(Odometry, "odom", queue)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "pose", queue)
        self._driven = self.create_publisher(Path, "path", queue)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", queue)
        self._status = self.create_publisher(Status or String, "~/status", queue)
        self._tf = None if TFMessage is None else self.create_publisher(TFMessage, "/tf", queue)

    def _subscribe(self) -> None:
        kind = CompressedImage if self._given("compressed") else Image
        for side, name in enumerate(("left", "right")):
            self.create_subscription(
                kind,
                self._given(name),
                functools.partial(self._image, side),
                qos_profile_sensor_data,
            )
            self.create_subscription(
                CameraInfo,
                self._given(name + "_info"),
                functools.partial(self._info, side),
                qos_profile_sensor_data,
            )

        if self._given("wheels"):
            topic = self._given("wheels")
            self.create_subscription(Odometry, topic, self._turned, qos_profile_sensor_data)

    def _serve(self) -> None:
        self.create_service(Trigger, "~/save", self._asked("save"))
        self.create_service(Trigger, "~/relocalise", self._asked("relocalise"))
        self.create_service(SetBool, "~/map", self._map)

    def _asked(self, do: str):
        def answer(_, response):
            response.success = self._supervisor.ask({"do": do})
            response.message = "asked" if response.success else "engram live is not connected"
            return response

        return answer

    def _map(self, request, response):
        response.success = self._supervisor.ask({"do": "map", "on": request.data})
        response.message = "asked" if response.success else "engram live is not connected"
        return response

    def _changed(self, parameters):
        for one in parameters:
            if one.name == "map":
                self._supervisor.ask({"do": "switch", "map": one.value})
            elif one.name not in ("mapping",):
                reason = f"{one.name} is read at the start: restart the node"
                return SetParametersResult(successful=False, reason=reason)
            else:
                self._supervisor.ask({"do": "map", "on": one.value})
        return SetParametersResult(successful=True)

    def _info(self, side: int, message) -> None:
        said = {
            "image_width": message.width,
            "image_height": message.height,
            "distortion_model": message.distortion_model,
            "distortion_coefficients": _entries(message.d, 1),
            "camera_matrix": _entries(message.k, 3),
            "rectification_matrix": _entries(message.r, 3),
            "projection_matrix": _entries(message.p, 3),
        }
        if self._infos[side] == said:
            return
        self._infos[side] = said
        if all(self._infos):
            camera = {"rectified": self._given("rectified")}
            camera.update(zip(("left", "right"), self._infos))  # Python 3.8
            self._supervisor.see(camera, said["image_width"], said["image_height"])

    def _turned(self, message) -> None:
        stamp, pose = message.header.stamp, message.pose.pose
        at, turn = pose.position, pose.orientation
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        self._wheels.add(stamp_ns, [at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w])

    def _image(self, side: int, message) -> None:
        stamp = message.header.stamp
        pair = self._pairs.add(side, stamp.sec * 10**9 + stamp.nanosec, message)
        if pair is None or not all(self._infos):
            return
        stamp_ns, *both = pair
        try:
            decode = images.uncompressed if self._given("compressed") else images.grey
            left, right = (decode(one) for one in both)
            wheels = self._wheels.at(stamp_ns)
            wheels = None if wheels is None else wheels @ self._base_from_camera
            self._supervisor.show(stamp_ns, left, right, wheels)
        except Exception as error:  # whatever a camera sends, the node goes on and says so
            self.get_logger().error(f"images: {error}", throttle_duration_sec=_QUIET_S)

    def _hear(self, message) -> None:
        if message.get("is") == "hello":
            self._belief.began()
        if message.get("is") == "reply":
            log = self.get_logger().info if message.get("ok") else self.get_logger().warning
            log(f"{message.get('do')}: {message.get('text')}")
        if self._belief.hear(message, time.monotonic()):
            self._say()

    def _say(self) -> None:
        """What the newest frame changed, stamped with its time: never with a later one."""
        belief, stamp = self._belief, Time(nanoseconds=self._belief.stamp_ns).to_msg()
        odometry = Odometry()
        odometry.header.stamp, odometry.header.frame_id = stamp, self._given("odom_frame")
        odometry.child_frame_id = self._given("base_frame")
        _put(odometry.pose.pose, belief.odom_from_base)
        own = rigid.at_its_own_origin(belief.odom_from_base, belief.odom_covariance)
        odometry.pose.covariance = own.ravel().tolist()
        self._odometry.publish(odometry)
        transforms = []
        if self._given("publish_odom_tf"):
            transforms.append(
                _transform(
                    stamp, odometry.header.frame_id, odometry.child_frame_id, belief.odom_from_base
                )
            )
        if belief.map_from_odom is not None and self._given("publish_map_tf"):
            parent, child = self._given("map_frame"), self._given("odom_frame")
            transforms.append(_transform(stamp, parent, child, belief.map_from_odom))
        if self._tf is not None and transforms:
            self._tf.publish(TFMessage(transforms=transforms))
        if belief.map_pose is not None:
            self._say_pose(stamp, *belief.map_pose)

    def _say_pose(self, stamp, map_from_base, covariance) -> None:
        pose = PoseWithCovarianceStamped()
        pose.header.stamp, pose.header.frame_id = stamp, self._given("map_frame")
        _put(pose.pose.pose, map_from_base)
        pose.pose.covariance = covariance.ravel().tolist()
        self._pose.publish(pose)
        self._path.header = pose.header
        self._path.poses.append(PoseStamped(header=pose.header, pose=pose.pose.pose))
        del self._path.poses[:-_PATH]
        self._driven.publish(self._path)

    def _report(self) -> None:
        """At a fixed rate, whatever happened to camera, map, disk or the live process."""
        level, summary, facts = self._belief.report(time.monotonic())
        facts.update(restarts=self._supervisor.restarts, single_images=self._pairs.single)
        status = DiagnosticStatus(level=bytes([level]), name="engram", message=summary)
        status.hardware_id = self._given("robot")
        status.values = [KeyValue(key=key, value=str(value)) for key, value in facts.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)
        if Status is None:
            self._status.publish(String(data=json.dumps({"summary": summary, **facts})))
            return
        self._status.publish(
            Status(
                header=array.header,
                status=str(facts.get("status", "starting")),
                trouble=str(facts.get("trouble") or ""),
                node=str(facts.get("node") or ""),
                confidence=float(facts.get("confidence") or 0.0),
                attempts=int(facts.get("attempts") or 0),
                inliers=int(facts.get("inliers") or 0),
                open_loop_m=float(facts.get("open_loop_m") or 0.0),
                age_s=float(facts.get("age_s") or -1.0),
                frames=int(facts.get("frames") or 0),
                dropped=int(facts.get("dropped") or 0),
                map=str(facts.get("map") or ""),
                saving=str(facts.get("saving") or ""),
            )
        )


def _entries(values, rows: int):
    data = [float(one) for one in values]
    return {"rows": rows, "cols": len(data) // rows, "data": data}


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


def main() -> None:
    """Runs the node until it is interrupted."""
    rclpy.init()
    node = Bridge()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
