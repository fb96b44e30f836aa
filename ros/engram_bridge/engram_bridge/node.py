"""The ROS 2 node: images in; odometry, pose, transforms, status out; services.

A managed (lifecycle) node where `rclpy` has them, and it manages itself unless told otherwise. The
status is published in every state.
"""

from __future__ import annotations

import functools
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, NavSatFix
from std_srvs.srv import SetBool, Trigger

from engram_bridge import images, rigid
from engram_bridge.asking import Asking
from engram_bridge.belief import Belief
from engram_bridge.fixes import fix_of
from engram_bridge.frames import StaticFrames
from engram_bridge.gyro import Gyro
from engram_bridge.memory import keep_memory
from engram_bridge.output import Poses, StatusReport, TFMessage, Ticking
from engram_bridge.pairs import Pairs
from engram_bridge.parameters import PARAMETERS, RUNNING, checked, image_topic, live_command
from engram_bridge.supervisor import Supervisor
from engram_bridge.troubles import Troubles
from engram_bridge.wheels import Wheels

try:
    from rclpy.lifecycle import LifecycleNode as Base
    from rclpy.lifecycle import TransitionCallbackReturn as Done
except ImportError:  # before Humble: a plain node, active at once
    from rclpy.node import Node as Base

    Done = None
try:
    from engram_msgs.srv import SwitchMap
except ImportError:  # not built: the parameter `map` switches
    SwitchMap = None

_KEEP_UP_S = 0.05  # between two repetitions of map -> odom while no frame comes
_ANSWER_S = 10.0  # services and parameters wait so long for the live process
_MANY = 100  # fixed transforms that may wait


class Bridge(Base):
    """Subscribes to a stereo camera, keeps `engram live` running, and publishes what it says."""

    def __init__(self) -> None:
        super().__init__("engram")
        for name, value in PARAMETERS.items():
            self.declare_parameter(name, value)
        self.add_on_set_parameters_callback(self._changed)
        self._troubles = Troubles(self.get_logger())
        self._belief = Belief()
        self._supervisor = self._pairs = None
        self._active = False
        self._made = []
        rate_hz, robot = (self.get_parameter(one).value for one in ("status_rate", "robot"))
        self._status = StatusReport(self, self._state, max(rate_hz, 1.0), robot)

    # Lifecycle: each returns whether it was done.

    def on_configure(self, _state=None):
        """Reads the parameters, and starts the live process."""
        try:
            self._given = checked({one: self.get_parameter(one).value for one in PARAMETERS})
            self._configure()
        except Exception as error:  # the status says why; it can be tried again
            self._troubles.add("configure", f"not configured: {error}", lasting=True)
            self._clean_up()
            return _done(False)
        self._troubles.forget("configure")
        return _done(True)

    def on_activate(self, _state=None):
        """Hands images over from now on."""
        self._active = True
        return _done(True)

    def on_deactivate(self, _state=None):
        """Leaves images alone; the position waits."""
        self._active = False
        return _done(True)

    def on_cleanup(self, _state=None):
        """Ends the live process, which commits what it mapped."""
        self._clean_up()
        return _done(True)

    def on_shutdown(self, _state=None):
        """As `on_cleanup`."""
        self._clean_up()
        return _done(True)

    def close(self) -> None:
        """Ends everything: the live process commits what it mapped."""
        self._clean_up()
        self._status.close()

    def _configure(self) -> None:
        given = self._given
        mounting = list(given["base_from_camera"])
        self._base_from_camera = rigid.of_xyz_rpy(mounting) if len(mounting) == 6 else None
        self._belief = Belief(self._base_from_camera)
        self._pairs = Pairs(int(1e6 * given["pair_tolerance_ms"]))
        self._wheels, self._gyro, self._frames = Wheels(), Gyro(), StaticFrames()
        self._gyro_frame = None
        self._infos, self._camera_frame = [None, None], given["camera_frame"]
        self._poses = Poses(self, given)
        self._supervisor = Supervisor(live_command(given), self._hear, self._process_said)
        self._asking = Asking(self._supervisor.ask)
        self._subscribe()
        self._serve()
        self._keeping_up = Ticking(self, _KEEP_UP_S, self._keep_up)
        self._supervisor.start()

    def _clean_up(self) -> None:
        self._active = False
        for destroy, made in self._made:
            destroy(made)
        self._made = []
        supervisor, self._supervisor = self._supervisor, None
        if supervisor is not None:
            supervisor.close()
            self._keeping_up.close()
            self._poses.destroy(self)

    def _subscribe(self) -> None:
        given = self._given
        grey = functools.partial(images.grey, depth=images.Depth())
        for side, name in enumerate(("left", "right")):
            topic, compressed = image_topic(given, name)
            decode = images.uncompressed if compressed else grey
            kind = CompressedImage if compressed else Image
            self._listen(kind, topic, functools.partial(self._image, side, decode))
            self._listen(CameraInfo, given[name + "_info"], functools.partial(self._info, side))
            self._troubles.expect(side, topic, given[name + "_info"])
        if given["wheels"]:
            self._listen(Odometry, given["wheels"], self._turned)
        if given["gyro"]:
            self._listen(Imu, given["gyro"], self._rotated)
        if given["gps"]:
            self._listen(NavSatFix, given["gps"], self._located)
        self._listen(PoseWithCovarianceStamped, "initialpose", self._placed, 10)
        if TFMessage is not None:
            kept = QoSProfile(depth=_MANY, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._listen(TFMessage, "/tf_static", self._fixed, kept)

    def _listen(self, kind, topic: str, take, quality=qos_profile_sensor_data) -> None:
        def taken(message) -> None:
            try:
                take(message)
            except Exception as error:  # whatever comes, the node goes on and says so
                self._troubles.add(topic, f"{topic}: {error}")

        made = self.create_subscription(kind, topic, taken, quality)
        self._made.append((self.destroy_subscription, made))

    def _serve(self) -> None:
        served = [
            (Trigger, "~/save", lambda _: {"do": "save"}),
            (Trigger, "~/relocalise", lambda _: {"do": "relocalise"}),
            (SetBool, "~/map", lambda request: {"do": "map", "on": request.data}),
        ]
        if SwitchMap is not None:
            served.append((SwitchMap, "~/switch_map", lambda one: {"do": "switch", "map": one.map}))
        for kind, name, wanted in served:
            made = self.create_service(kind, name, functools.partial(self._answer, wanted))
            self._made.append((self.destroy_service, made))

    def _answer(self, wanted, request, response):
        """Answers when the live process did: what became of it, not that it was asked.

        Images wait meanwhile; the live process, which commits or opens a map, would take none.
        """
        message = wanted(request)
        response.success, response.message = self._asking.wait(message, _ANSWER_S)
        if response.success:
            self._remember(message)
        return response

    def _changed(self, parameters):
        """`ros2 param set`: only what can change while the node runs, and only if it was done."""
        for one in parameters if self._supervisor is not None else ():
            if one.name not in RUNNING:
                reason = f"{one.name} is read when the node is configured: restart it"
                return SetParametersResult(successful=False, reason=reason)
            message = {"do": "switch", "map": one.value}
            if one.name == "mapping":
                message = {"do": "map", "on": one.value}
            done, text = self._asking.wait(message, _ANSWER_S)
            if not done:
                return SetParametersResult(successful=False, reason=text)
            self._remember(message)
        return SetParametersResult(successful=True)

    def _remember(self, message) -> None:
        """What was changed holds for the next process, too."""
        if message["do"] in ("switch", "map"):
            key = "map" if message["do"] == "switch" else "mapping"
            self._given[key] = message[key] if key in message else message["on"]
            self._supervisor.command = live_command(self._given)

    # What comes in.

    def _info(self, side: int, message) -> None:
        self._troubles.saw_info(side)
        said = images.camera_info(message)
        if self._infos[side] == said:
            return
        self._infos[side] = said
        if all(self._infos):
            camera = {"rectified": self._given["rectified"]}
            camera.update(zip(("left", "right"), self._infos))  # Python 3.8
            self._supervisor.see(camera, said["image_width"], said["image_height"])

    def _turned(self, message) -> None:
        pose = message.pose.pose
        at, turn = pose.position, pose.orientation
        xyzw = [turn.x, turn.y, turn.z, turn.w]
        self._wheels.add(_stamp_ns(message), [at.x, at.y, at.z], xyzw)

    def _rotated(self, message) -> None:
        """Rates of a gyroscope; its axes on the robot come from /tf_static."""
        base = self._given["base_frame"]
        frame = message.header.frame_id or base
        if self._gyro_frame != frame:
            self._base_from_gyro = self._frames.between(base, frame)
            if self._base_from_gyro is None:
                raise ValueError(f"no transform {base} -> {frame} in /tf_static; left out")
            self._gyro_frame = frame
        if message.angular_velocity_covariance[0] == -1.0:
            raise ValueError("its messages hold no turn rates; left out")
        rates = message.angular_velocity
        turned = self._base_from_gyro[:3, :3] @ [rates.x, rates.y, rates.z]
        if not np.isfinite(turned).all():
            raise ValueError("a turn rate is not finite; left out")
        self._gyro.add(_stamp_ns(message), turned)

    def _located(self, message) -> None:
        """A satellite fix: in a map that is anchored to the earth, a lost robot looks near it."""
        fix = fix_of(message, _stamp_ns(message))
        if fix is not None:
            self._supervisor.ask({"do": "fix", **fix})

    def _outside(self, stamp_ns: int):
        """Where wheels and gyroscope see the camera at a time, by the names of the link."""
        if not self._belief.mounted:
            return {}
        wheels, turn = self._wheels.at(stamp_ns), self._gyro.at(stamp_ns)
        seen = {} if wheels is None else {"wheels_from_live": wheels @ self._base_from_camera}
        if turn is not None:
            seen["gyro_from_live"] = turn[:3, :3] @ self._base_from_camera[:3, :3]
        return seen

    def _fixed(self, message) -> None:
        for one in message.transforms:
            at, turn = one.transform.translation, one.transform.rotation
            xyzw = [turn.x, turn.y, turn.z, turn.w]
            names = one.header.frame_id, one.child_frame_id
            self._frames.add(*names, [at.x, at.y, at.z], xyzw)
        if not self._belief.mounted:
            self._mount()

    def _mount(self) -> None:
        """Where the camera is on the robot, once its frame and the fixed transforms are known."""
        base, camera = self._given["base_frame"], self._camera_frame
        if not camera:
            return
        base_from_camera = self._frames.between(base, camera)
        if base_from_camera is None:
            text = f"no transform {base} -> {camera} in /tf_static: set base_from_camera"
            self._troubles.add("mounting", text, lasting=True)
            return
        self._troubles.forget("mounting")
        x, y, z = base_from_camera[:3, 3]
        ahead = ", ".join(f"{one:.2f}" for one in base_from_camera[:3, 2])
        text = f"{camera} is at {x:.3f} {y:.3f} {z:.3f} m on {base} and looks along ({ahead})"
        self.get_logger().info(f"by /tf_static, {text}")
        if abs(base_from_camera[2, 2]) > 0.9:
            text += f"; if {camera} is no optical frame (z ahead), set camera_frame to that"
            self._troubles.add("mounting", text, lasting=True)
        self._base_from_camera = base_from_camera
        self._belief.mount(base_from_camera)

    def _image(self, side: int, decode, message) -> None:
        self._troubles.saw_image(side)
        if side == 0 and not self._belief.mounted:
            self._camera_frame = self._camera_frame or message.header.frame_id
            self._mount()
        pair = self._pairs.add(side, _stamp_ns(message), message)
        if pair is None or not self._active or not all(self._infos):
            return
        stamp_ns, *both = pair
        left, right = (decode(one) for one in both)
        self._supervisor.show(stamp_ns, left, right, self._outside(stamp_ns))
        self._troubles.saw_pair()

    def _placed(self, message) -> None:
        """The pose that a person set in RViz, of the robot in the map frame."""
        if not self._belief.mounted:
            raise ValueError("the camera's mounting is unknown")
        pose = message.pose.pose
        at, turn = pose.position, pose.orientation
        xyzw = [turn.x, turn.y, turn.z, turn.w]
        map_from_base = rigid.of_quaternion(xyzw, [at.x, at.y, at.z])
        map_from_camera = map_from_base @ self._base_from_camera
        x, y = (float(one) for one in map_from_camera[:2, 3])
        yaw = float(np.arctan2(map_from_camera[1, 2], map_from_camera[0, 2]))
        here = {"do": "here", "x_m": x, "y_m": y, "yaw_rad": yaw}
        self._asking.ask(here, lambda _, text: self.get_logger().info(f"initialpose: {text}"))

    # What goes out.

    def _hear(self, message) -> None:
        kind = message.get("is")
        if kind == "hello":
            self._belief.began()
        elif kind == "gone":
            self._asking.gone()
        elif kind == "reply" and not self._asking.hear(message) and not message.get("ok"):
            self._troubles.add("live", f"{message.get('do')}: {message.get('text')}")
        if self._belief.hear(message, time.monotonic()):
            self._poses.say(self._belief)

    def _process_said(self, text: str) -> None:
        self._troubles.add("process", text)

    def _keep_up(self) -> None:
        if self._belief.mounted:
            self._poses.keep_up(self._belief, self.get_clock().now().nanoseconds)

    def _state(self):
        """(level, summary, facts) for the status, at a fixed rate, whatever happened."""
        level, summary, facts = self._belief.report(time.monotonic())
        supervisor, pairs = self._supervisor, self._pairs
        facts["restarts"] = 0 if supervisor is None else supervisor.restarts
        facts["single_images"] = 0 if pairs is None else pairs.single
        own = self._troubles.text(waiting=self._active)
        if supervisor is None or not self._active:
            facts["status"] = "unconfigured" if supervisor is None else "inactive"
            level, summary = max(level, 1), facts["status"]
        if own:
            facts["trouble"] = "; ".join(filter(None, (facts.get("trouble"), own)))
            level, summary = max(level, 1), f"{facts.get('status')}: {facts['trouble']}"
        return level, summary, facts


def _stamp_ns(message) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def _done(done: bool):
    if Done is None:
        return done
    return Done.SUCCESS if done else Done.FAILURE


def _start(node) -> None:
    """Configures and activates the node, unless somebody else manages it."""
    if Done is None:
        if node.on_configure():
            node.on_activate()
    elif node.get_parameter("autostart").value and node.trigger_configure() == Done.SUCCESS:
        node.trigger_activate()


def main() -> None:
    """Runs the node until it is interrupted."""
    keep_memory()
    rclpy.init()
    node = Bridge()
    try:
        _start(node)
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
