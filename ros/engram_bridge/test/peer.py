"""A ROS 2 camera and listener: publishes pairs of images, prints what the bridge publishes.

Run by `make test-ros` in a Python that has rclpy. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String
from std_srvs.srv import Trigger


class Peer(Node):
    """Publishes pairs in a loop at a rate, and keeps what it hears with the time of hearing."""

    def __init__(self, pairs, rate_hz: float) -> None:
        super().__init__("peer")
        self.pairs, self.sent, self.sent_at = pairs, 0, {}
        self.odometry, self.status, self.poses, self.ages_s = [], [], [], []
        self._images = [
            self.create_publisher(Image, side + "/image_rect", qos_profile_sensor_data)
            for side in ("left", "right")
        ]
        self._infos = [
            self.create_publisher(CameraInfo, side + "/camera_info", qos_profile_sensor_data)
            for side in ("left", "right")
        ]
        self.create_subscription(Odometry, "odom", self._hear_odometry, 10)
        self.create_subscription(PoseWithCovarianceStamped, "pose", self.poses.append, 10)
        self.create_subscription(String, "engram/status", self._hear_status, 10)
        self.relocalise = self.create_client(Trigger, "engram/relocalise")
        self.shows = False
        self.create_timer(1.0 / rate_hz, self._show)

    @property
    def ready(self) -> bool:
        """Whether the bridge subscribes and its live process says that it lives."""
        subscribed = all(one.get_subscription_count() for one in self._images)
        return subscribed and bool(self.status) and self.status[-1][1]["status"] == "starting"

    def _show(self) -> None:
        if not self.shows:
            return
        stamp = self.get_clock().now().to_msg()
        # There and back, so that the drive has no jump.
        count = len(self.pairs["left"])
        place = self.sent % (2 * count - 2) if count > 1 else 0
        place = place if place < count else 2 * count - 2 - place
        fx, fy, cx, cy, baseline_m = self.pairs["camera"]
        for side, name in enumerate(("left", "right")):
            rows = self.pairs[name][place]
            height, width = rows.shape
            info = CameraInfo(width=width, height=height, distortion_model="plumb_bob")
            info.d, info.k = [0.0] * 5, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
            info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
            shift = -fx * baseline_m if side else 0.0
            info.p = [fx, 0.0, cx, shift, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
            image = Image(width=width, height=height, encoding="mono8", step=width)
            image.data.frombytes(rows.tobytes())
            for message in (info, image):
                message.header.stamp = stamp
            self._infos[side].publish(info)
            self._images[side].publish(image)
        self.sent_at[(stamp.sec, stamp.nanosec)] = time.monotonic(), self.sent
        self.sent += 1

    def _hear_odometry(self, message) -> None:
        at = message.header.stamp
        sent_s, number = self.sent_at[(at.sec, at.nanosec)]
        self.ages_s.append(time.monotonic() - sent_s)
        where = message.pose.pose.position
        self.odometry.append((number, where.x, where.y, where.z))

    def _hear_status(self, message) -> None:
        self.status.append((time.monotonic(), json.loads(message.data)))


def live_process(command: str):
    """The pid of the live process that serves the bridge; None if there is none."""
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/cmdline", "rb") as file:
                arguments = file.read().decode(errors="replace").split("\0")
        except OSError:  # it ended meanwhile
            continue
        if "--socket" in arguments and command in arguments:
            return int(pid)
    return None


def spin(peer, until, patience_s: float) -> None:
    """Runs the peer until something is so.

    Raises:
        SystemExit: it was not so in time.
    """
    end = time.monotonic() + patience_s
    while not until():
        rclpy.spin_once(peer, timeout_sec=0.05)
        if time.monotonic() > end:
            sys.exit(f"the bridge did not answer; last status: {peer.status[-1:]}")


def main() -> None:
    """Drives the pairs past the bridge, kills its live process once, and drives on."""
    parser = argparse.ArgumentParser()
    parser.add_argument("pairs")
    parser.add_argument("map")
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--kill", action="store_true")
    given = parser.parse_args()
    rclpy.init()
    peer = Peer(dict(np.load(given.pairs)), given.rate)
    spin(peer, lambda: peer.ready, 60.0)
    peer.shows = True
    began = time.monotonic()
    spin(peer, lambda: time.monotonic() - began > given.seconds, 2 * given.seconds + 60)
    if given.kill:
        os.kill(live_process(given.map), signal.SIGKILL)
        before = len(peer.odometry)
        spin(peer, lambda: len(peer.odometry) > before + 10, 60.0)
    peer.shows = False
    times = [at for at, _ in peer.status if at >= began]
    steps = np.diff(np.array(peer.odometry), axis=0)
    # Frames that were dropped lie between: what counts is how far it went for each of them.
    steps_m = np.linalg.norm(steps[:, 1:], axis=1) / steps[:, 0]
    print(
        json.dumps(
            {
                "sent": peer.sent,
                "odometry": len(peer.odometry),
                "longest_silence_s": float(np.diff(times).max()),
                "largest_step_m": float(steps_m.max()),
                "age_ms_median": 1e3 * float(np.median(peer.ages_s)),
                "age_ms_99": 1e3 * float(np.quantile(peer.ages_s, 0.99)),
                "statuses": sorted({one["status"] for _, one in peer.status}),
                "last": peer.status[-1][1],
                "poses": len(peer.poses),
            }
        )
    )
    peer.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
