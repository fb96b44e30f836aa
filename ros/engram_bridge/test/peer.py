"""A ROS 2 camera and listener, for tests of the bridge in a Python that has rclpy.

Publishes pairs of images there and back, and keeps what the bridge says with the time of hearing.
Run as a program it drives past a bridge once, uses its services, kills its live process, and
prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time

import cv2
import numpy as np
import rclpy
from engram_msgs.msg import Status
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from tf2_msgs.msg import TFMessage

# Where the camera is on the robot: optical axes, half a metre ahead and one up.
MOUNTED_AT, MOUNTED_XYZW = (0.5, 0.06, 1.0), (-0.5, 0.5, -0.5, 0.5)


class Peer(Node):
    """Publishes pairs in a loop at a rate, and keeps what it hears with the time of hearing.

    Attributes:
        shows: whether images are published; the robot moves on while they are not.
        shift_s: the camera's clock less the machine's.
        spoils: changes the pair before it is published: left, right -> left, right.
    """

    def __init__(self, pairs, rate_hz: float, compressed: bool = False) -> None:
        super().__init__("peer")
        self.pairs, self.places, self.sent, self.sent_at = pairs, 0, 0, {}
        self.odometry, self.status, self.poses, self.ages_s, self.transforms = [], [], [], [], []
        self.posed_at = []
        self.shows, self.shift_s, self.spoils = False, 0.0, None
        self._compressed = compressed
        kind, ending = (CompressedImage, "/compressed") if compressed else (Image, "")
        quality = qos_profile_sensor_data
        self._images = [
            self.create_publisher(kind, f"{side}/image_rect{ending}", quality)
            for side in ("left", "right")
        ]
        self._infos = [
            self.create_publisher(CameraInfo, f"{side}/camera_info", quality)
            for side in ("left", "right")
        ]
        self._gyro = self.create_publisher(Imu, "imu", quality)
        kept = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._static = self.create_publisher(TFMessage, "/tf_static", kept)
        self._static.publish(TFMessage(transforms=_mounting()))
        self.create_subscription(Odometry, "odom", self._hear_odometry, 100)
        self.create_subscription(PoseWithCovarianceStamped, "pose", self._hear_pose, 100)
        self.create_subscription(Status, "engram/status", self._hear_status, 100)
        self.create_subscription(TFMessage, "/tf", self._hear_transforms, 100)
        self.create_timer(1.0 / rate_hz, self._show)

    @property
    def ready(self) -> bool:
        """Whether the bridge subscribes and its live process says that it lives."""
        subscribed = all(one.get_subscription_count() for one in self._images)
        return subscribed and bool(self.status) and self.status[-1][1].status == "starting"

    def place(self, number: int) -> int:
        """Which pair the camera sees at a step: there and back, so that the drive has no jump.

        Pairs with a truth are a lap, which ends where it begins.
        """
        count = len(self.pairs["left"])
        if "map_from_camera" in self.pairs:
            return number % count
        place = number % (2 * count - 2) if count > 1 else 0
        return place if place < count else 2 * count - 2 - place

    def _show(self) -> None:
        number, self.places = self.places, self.places + 1
        if not self.shows:
            return
        now_ns = self.get_clock().now().nanoseconds + int(1e9 * self.shift_s)
        stamp = rclpy.time.Time(nanoseconds=now_ns).to_msg()
        still = Imu()
        still.header.stamp, still.header.frame_id = stamp, "mast"
        self._gyro.publish(still)
        both = [self.pairs[side][self.place(number)].copy() for side in ("left", "right")]
        for rows in both:  # at the turn, the same image again would count as a camera that froze
            rows[0, 0] = number % 256
        if self.spoils is not None:
            both = self.spoils(*both)
        self.sent_at[stamp.sec, stamp.nanosec] = time.monotonic(), number
        self.sent += 1
        for side, rows in enumerate(both):
            info, image = self._info(side, rows.shape), self._image(rows)
            for message in (info, image):
                message.header.stamp, message.header.frame_id = stamp, "left_optical"
            self._infos[side].publish(info)
            self._images[side].publish(image)

    def _info(self, side: int, shape):
        fx, fy, cx, cy, baseline_m = (float(one) for one in self.pairs["camera"])
        info = CameraInfo(width=shape[1], height=shape[0], distortion_model="plumb_bob")
        info.d, info.k = [0.0] * 5, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        shift = -fx * baseline_m if side else 0.0
        info.p = [fx, 0.0, cx, shift, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        return info

    def _image(self, rows):
        height, width = rows.shape
        if self._compressed:
            image = CompressedImage(format="png")
            image.data.frombytes(cv2.imencode(".png", rows)[1].tobytes())
        else:
            image = Image(width=width, height=height, encoding="mono8", step=width)
            image.data.frombytes(rows.tobytes())
        return image

    def _number(self, message):
        at = message.header.stamp
        return self.sent_at[at.sec, at.nanosec]

    def _hear_odometry(self, message) -> None:
        sent_s, number = self._number(message)
        self.ages_s.append(time.monotonic() - sent_s)
        where = message.pose.pose.position
        spread_m = float(np.sqrt(max(message.pose.covariance[0], message.pose.covariance[7])))
        self.odometry.append((number, where.x, where.y, where.z, spread_m))

    def _hear_pose(self, message) -> None:
        covariance = np.reshape(message.pose.covariance, (6, 6))[:3, :3]
        where = message.pose.pose.position
        spread_m = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        self.posed_at.append(time.monotonic())
        self.poses.append((self._number(message)[1], where.x, where.y, where.z, spread_m))

    def _hear_status(self, message) -> None:
        self.status.append((time.monotonic(), message))

    def _hear_transforms(self, message) -> None:
        now_ns = self.get_clock().now().nanoseconds
        for one in message.transforms:
            stamp_ns = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
            self.transforms.append((one.child_frame_id, stamp_ns, now_ns))


def _mounting():
    """base_link -> mast -> left_optical."""
    mast = TransformStamped(child_frame_id="mast")
    mast.header.frame_id = "base_link"
    mast.transform.translation.z = MOUNTED_AT[2]
    camera = TransformStamped(child_frame_id="left_optical")
    camera.header.frame_id = "mast"
    camera.transform.translation.x, camera.transform.translation.y = MOUNTED_AT[:2]
    turn = camera.transform.rotation
    turn.x, turn.y, turn.z, turn.w = MOUNTED_XYZW
    return [mast, camera]


def live_process(command: str):
    """The pid of the live process that serves the bridge with a map; None if there is none."""
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/cmdline", "rb") as file:
                arguments = file.read().decode(errors="replace").split("\0")
        except OSError:  # it ended meanwhile
            continue
        if "--socket" in arguments and command in arguments:
            return int(pid)
    return None


class Driver:
    """Runs a peer until something is so.

    Args:
        peer: the node.
    """

    def __init__(self, peer) -> None:
        self.peer = peer
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(peer)

    def until(self, wanted, patience_s: float = 60.0, what: str = "the bridge did not answer"):
        """Spins until ``wanted()``; returns what it gave.

        Raises:
            SystemExit: it was not so in time.
        """
        end = time.monotonic() + patience_s
        while not (found := wanted()):
            self._executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > end:
                last = self.peer.status[-1:]
                sys.exit(f"{what} within {patience_s} s; last status: {last}")
        return found

    def drive(self, seconds: float) -> None:
        """Spins for so long."""
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end, seconds + 60.0)

    def call(self, kind, name: str, **given):
        """Calls a service of the bridge."""
        client = self.peer.create_client(kind, name)
        self.until(client.service_is_ready, 20.0, f"{name} is not served")
        future = client.call_async(kind.Request(**given))
        self.until(future.done, 60.0, f"{name} was not answered")
        self.peer.destroy_client(client)
        return future.result()


def _services(driver, town: str):
    """What each service answers, and the state of the lifecycle before and after a pause."""
    from engram_msgs.srv import SwitchMap
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState, GetState
    from rcl_interfaces.srv import SetParameters
    from std_srvs.srv import SetBool, Trigger

    def state() -> str:
        return driver.call(GetState, "engram/get_state").current_state.label

    def change(number: int) -> bool:
        given = {"transition": Transition(id=number)}
        return driver.call(ChangeState, "engram/change_state", **given).success

    def parameter(name: str, value: str):
        made = rclpy.parameter.Parameter(name, value=value).to_parameter_msg()
        done = driver.call(SetParameters, "engram/set_parameters", parameters=[made]).results[0]
        return done.successful, done.reason

    asked = {
        "save": driver.call(Trigger, "engram/save"),
        "relocalise": driver.call(Trigger, "engram/relocalise"),
        "map": driver.call(SetBool, "engram/map", data=False),
        "switch": driver.call(SwitchMap, "engram/switch_map", map=town),
        "refused": driver.call(SwitchMap, "engram/switch_map", map=town + ".none"),
    }
    said = {name: (one.success, one.message) for name, one in asked.items()}
    said["parameter"] = parameter("map", town)
    said["parameter_refused"] = parameter("map", town + ".none")
    said["states"] = [state()]
    change(Transition.TRANSITION_DEACTIVATE)
    driver.until(lambda: driver.peer.status[-1][1].status == "inactive")
    said["states"].append(state())
    change(Transition.TRANSITION_ACTIVATE)
    driver.until(lambda: driver.peer.status[-1][1].status != "inactive")
    said["states"].append(state())
    return said


def _summary(peer, began: float):
    times = [at for at, _ in peer.status if at >= began]
    steps = np.diff(np.array(peer.odometry)[:, :4], axis=0)
    # Frames that were dropped lie between: what counts is how far it went for each of them.
    steps_m = np.linalg.norm(steps[:, 1:], axis=1) / np.maximum(steps[:, 0], 1)
    ahead_ns = [stamp_ns - now_ns for _, stamp_ns, now_ns in peer.transforms]
    last = peer.status[-1][1]
    return {
        "sent": peer.sent,
        "odometry": len(peer.odometry),
        "first_x_m": peer.odometry[0][1],
        "longest_silence_s": float(np.diff(times).max()),
        "largest_step_m": float(steps_m.max()),
        "statuses": sorted({one.status for _, one in peer.status}),
        "troubles": sorted({one.trouble for _, one in peer.status}),
        "last": {name: getattr(last, name) for name in ("status", "trouble", "saving")},
        "poses": len(peer.poses),
        "frames_of_tf": sorted({one[0] for one in peer.transforms}),
        "tf_ahead_s": max(ahead_ns) / 1e9,
    }


def main() -> None:
    """Drives the pairs past the bridge, uses its services, kills its process, and drives on."""
    parser = argparse.ArgumentParser()
    parser.add_argument("pairs")
    parser.add_argument("map")
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--compressed", action="store_true")
    parser.add_argument("--kill", action="store_true")
    given = parser.parse_args()
    rclpy.init()
    peer = Peer(dict(np.load(given.pairs)), given.rate, given.compressed)
    driver, said = Driver(peer), {}
    driver.until(lambda: peer.ready, 60.0)
    peer.shows, began = True, time.monotonic()
    driver.until(lambda: peer.poses, 60.0, "no pose came")
    driver.drive(given.seconds)
    if given.kill:
        said = _services(driver, given.map)
        before = len(peer.odometry)
        driver.until(lambda: len(peer.odometry) > before + 10)
        os.kill(live_process(given.map), signal.SIGKILL)
        before = len(peer.odometry)
        driver.until(lambda: len(peer.odometry) > before + 10)
    peer.shows = False
    before = len(peer.transforms)
    driver.until(lambda: len(peer.transforms) > before + 20, 20.0, "map -> odom is not kept up")
    print(json.dumps({**_summary(peer, began), **said}))
    peer.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
