"""Odometry and gyroscope topics of a bag as motion from outside."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import SequenceError
from engram.geometry import SE3
from engram.sequences.bags.bag import Bag
from engram.sequences.bags.calibrating import Transforms
from engram.sequences.bags.messages import Decoder, timed_messages
from engram.sequences.bags.records import DamageError
from engram.sequences.clocks import SteadyClock
from engram.sequences.motion import RigMotion, Sample, read_samples

ODOMETRY, TWIST, IMU = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TwistStamped",
    "sensor_msgs/msg/Imu",
)


class BagMotion:
    """The motion topics of a bag, and files given in addition.

    Args:
        bag: the bag.
        decoder: decodes its messages.
        names: topics or files: at most one of odometry and one of a gyroscope.
        transforms: static transforms, for the axes of the gyroscope.
        cam_from_rig: mounting of the camera, if known.

    Attributes:
        clocks: of the topics' stamps, in the latest pass.

    Raises:
        SequenceError: a name is neither a topic with motion nor a file, or two are of a kind.
    """

    def __init__(
        self,
        bag: Bag,
        decoder: Decoder,
        names: tuple[str, ...],
        transforms: Transforms,
        cam_from_rig: SE3 | None,
    ) -> None:
        self._bag, self._decoder, self._cam_from_rig = bag, decoder, cam_from_rig
        self.clocks: dict[str, SteadyClock] = {}
        self._sources: dict[bool, str] = {}
        for name in names:
            is_gyro = self._is_gyro(name)
            if is_gyro in self._sources:
                kind = "gyroscope" if is_gyro else "odometry"
                raise SequenceError(f"--motion {name}: is a second {kind}; give one of each kind")
            self._sources[is_gyro] = name
        self._rig_from_gyro = self._axes(transforms)

    @property
    def files(self) -> tuple[str, ...]:
        """Files that it reads in addition to the bag."""
        return tuple(one for one in self._sources.values() if one not in self._bag.topics)

    def source(self, shift_ns: int) -> RigMotion | None:
        """A new pass through the motion; None without one."""
        if not self._sources:
            return None
        wheels, gyro = (
            None if name is None else self._samples(name)
            for name in (self._sources.get(False), self._sources.get(True))
        )
        return RigMotion(wheels, gyro, self._cam_from_rig, self._rig_from_gyro, shift_ns)

    def _is_gyro(self, name: str) -> bool:
        topic = self._bag.topics.get(name)
        if topic is not None and topic.type in {ODOMETRY, TWIST, IMU}:
            return topic.type == IMU
        if topic is None and Path(name).is_file():
            return read_samples(Path(name))[0].velocity_m_s is None
        known = [
            one.name for one in self._bag.topics.values() if one.type in {ODOMETRY, TWIST, IMU}
        ]
        what = (
            f"holds {topic.type}"
            if topic is not None
            else "is neither a topic of the bag nor a file"
        )
        raise SequenceError(
            f"{self._bag.path}: --motion {name}: {what}; topics with motion: "
            f"{', '.join(known) or 'none'}"
        )

    def _axes(self, transforms: Transforms) -> Any:
        """Rotation of the gyroscope's axes to the rig's; None if they count as equal."""
        name = self._sources.get(True)
        if name is None or name not in self._bag.topics:
            return None
        record = next(self._bag.records({name}), None)
        if record is None:
            return None
        try:
            frame = str(self._decoder.message(record, IMU).header.frame_id).lstrip("/")
        except DamageError:
            return None
        base = transforms.base_of(frame)
        rig_from_gyro = None if base is None else transforms.between(base, frame)
        return None if rig_from_gyro is None else rig_from_gyro.rotation

    def _samples(self, name: str) -> Iterator[Sample]:
        topic = self._bag.topics.get(name)
        if topic is None:
            yield from read_samples(Path(name))
            return
        clock = self.clocks[name] = SteadyClock(waits=True)
        last_ns, last_pose = 0, None
        for one in timed_messages(self._bag, self._decoder, name, clock):
            message, stamp_ns = one.item[0], one.time_ns
            if topic.type == IMU:
                sample = Sample(stamp_ns, None, _vector(message.angular_velocity))
            else:
                pose = _pose(message) if topic.type == ODOMETRY else None
                twist = message.twist.twist if topic.type == ODOMETRY else message.twist
                velocity = _vector(twist.linear)
                sample = Sample(stamp_ns, velocity, _vector(twist.angular))
                still = not np.nan_to_num(velocity).any()
                if still and pose is not None and last_pose is not None:
                    sample = _between(last_pose, last_ns, pose, stamp_ns)
                last_pose = pose
            last_ns = stamp_ns
            way = 0.0 if sample.velocity_m_s is None else sample.velocity_m_s
            if np.isfinite(np.r_[way, sample.rates_rad_s]).all():
                yield sample
            else:  # not a robot at rest: nothing was measured
                self._bag.note(f"{name}: a measurement is not finite; left out")


def _pose(message: Any) -> SE3 | None:
    p, q = message.pose.pose.position, message.pose.pose.orientation
    try:
        return SE3.from_quaternion([q.w, q.x, q.y, q.z], [p.x, p.y, p.z])
    except ValueError:  # drivers that state no pose leave it at zero
        return None


def _between(before: SE3, before_ns: int, pose: SE3, stamp_ns: int) -> Sample:
    """Speeds of a driver that states poses and leaves its twist at zero."""
    twist = (before.inverse() @ pose).log() / ((stamp_ns - before_ns) / 1e9)
    return Sample(stamp_ns, twist[:3], twist[3:])


def _vector(value: Any) -> Any:
    return np.array([value.x, value.y, value.z], dtype=np.float64)
