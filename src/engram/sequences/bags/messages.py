"""Messages of a bag: calibration, odometry and gyroscope."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from engram.calibration.calibrated_pair import Cameras, lens_of, rectified_cameras
from engram.calibration.formats import CameraInfo, cameras_of_infos
from engram.errors import CalibrationError, InputError, SequenceError
from engram.geometry.se3 import SE3
from engram.sequences.bags.containers import Bag, DamageError, Record, needs_bags
from engram.sequences.bags.topics import StereoTopics, info_topics
from engram.sequences.calibrating import scaled_by
from engram.sequences.clocks import SteadyClock, Timed, in_time
from engram.sequences.motion_files import FORWARD, RigMotion, Sample, read_samples

_TF = "tf2_msgs/msg/TFMessage"
# Messages of which one has a stamp, if a topic has any.
_STATED_WITHIN = 100


class Decoder:
    """Decodes the messages of a bag.

    Args:
        is_ros1: whether they are serialised as in ROS 1, else as CDR.
    """

    def __init__(self, is_ros1: bool) -> None:
        self._store = _store(is_ros1)
        self._decode = self._store.deserialize_ros1 if is_ros1 else self._store.deserialize_cdr

    def knows(self, kind: str) -> bool:
        """Whether messages of this type can be decoded."""
        return kind in self._store.fielddefs

    def message(self, record: Record, kind: str) -> Any:
        """The decoded message; its fields as in ROS 2, arrays as NumPy.

        Raises:
            DamageError: its bytes are not a message of this type.
        """
        try:
            return self._decode(record.data, kind)
        except Exception as error:  # bytes of another type fail in many ways
            raise DamageError(f"is not a {kind}: {type(error).__name__} {error}"[:200]) from error


@functools.cache
def _store(is_ros1: bool) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise needs_bags(error) from error
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if _TF not in store.fielddefs:  # not among the types of ROS 1 that rosbags brings
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF))
    return store


class Stamps:
    """The capture times of a topic: of the headers, or of the recording if a driver states none.

    A single zero is a fault; only a topic whose first hundred stamps are all zero has none. The
    recorder's clock may be another: in simulation it is.
    """

    def __init__(self, bag: Bag, decoder: Decoder, topic: str) -> None:
        self._stated = False
        kind = bag.topics[topic].type
        for record in islice(bag.records({topic}), _STATED_WITHIN):
            with suppress(DamageError):
                self._stated = self._stated or _header_ns(decoder.message(record, kind)) != 0
            if self._stated:
                break

    def of(self, message: Any, record: Record) -> int:
        """Capture time of a message, ns."""
        return _header_ns(message) if self._stated else record.received_ns


def messages(bag: Bag, decoder: Decoder, topic: str) -> Iterator[tuple[Any, Record]]:
    """The messages of a topic that can be read; the others are noted."""
    kind = bag.topics[topic].type
    for record in bag.records({topic}):
        try:
            yield decoder.message(record, kind), record
        except DamageError as error:
            bag.note(f"{topic}: {error}")


def timed_messages(
    bag: Bag, decoder: Decoder, topic: str, clock: SteadyClock
) -> Iterator[Timed[tuple[Any, Record]]]:
    """The messages of a topic by rising time; see `engram.sequences.clocks`."""
    stamps = Stamps(bag, decoder, topic)
    return in_time(
        messages(bag, decoder, topic),
        lambda received: stamps.of(*received),
        clock,
        lambda received: received[1].received_ns,
    )


def clock_of(bag: Bag, decoder: Decoder, topic: str) -> SteadyClock:
    """The clock of a topic, after all its stamps."""
    clock = SteadyClock(waits=True)
    for _ in timed_messages(bag, decoder, topic, clock):
        pass
    return clock


def _header_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def same_type(kind: str) -> str:
    """The type's present name: ROS 1 has both tf/tfMessage and tf2_msgs/TFMessage."""
    return _TF if kind == "tf/msg/tfMessage" else kind


_INFO = "sensor_msgs/msg/CameraInfo"
# RealSense's own recorder states each stream's pose beside its images, in no frame.
_POSE, _POSE_TOPIC = "geometry_msgs/msg/Transform", "tf/0"
STATIC, MOVING = "/tf_static", "/tf"
# Frames that stand for the robot, the best first (REP 105, REP 120).
BASES = ("base_link", "base_footprint", "base", "body", "imu_link")
# Static transforms come once, or again and again from several publishers.
_MOST_MESSAGES = 50
# Messages of /tf in which a mounting must be constant: half a minute at usual rates.
_MOST_MOVING = 1500
# A joint that moves by less stands still: encoders tremble.
_STILL_M, _STILL_RAD = 1e-3, 2e-3


class Transforms:
    """The constant transforms of a bag.

    Attributes:
        parents: child frame → its parent and parent_from_child, metres.
        moving: children of transforms that change during the drive.
    """

    def __init__(
        self, parents: Mapping[str, tuple[str, SE3]], moving: Collection[str] = ()
    ) -> None:
        self.parents = dict(parents)
        self.moving = frozenset(moving)

    def __len__(self) -> int:
        return len(self.parents)

    def between(self, target: str, source: str) -> SE3 | None:
        """target_from_source; None if the two frames are not connected."""
        from_target, from_source = self._chain(target), self._chain(source)
        for frame, root_from_target in from_target.items():
            if frame in from_source:
                return root_from_target.inverse() @ from_source[frame]
        return None

    def base_of(self, frame: str) -> str | None:
        """The robot's frame above a camera's; None if there is none of a usual name."""
        above = {name.rsplit("/", 1)[-1]: name for name in self._chain(frame)}
        return next((above[base] for base in BASES if base in above), None)

    def turning(self, frame: str) -> str | None:
        """The frame above a camera's that moves against its parent; None if none does."""
        return next((name for name in self._chain(frame) if name in self.moving), None)

    def _chain(self, frame: str) -> dict[str, SE3]:
        """Each frame above, with ancestor_from_frame; loops end."""
        frame = frame.lstrip("/")
        chain = {frame: SE3.identity()}
        while frame in self.parents:
            parent, parent_from_frame = self.parents[frame]
            if parent in chain:
                break
            chain[parent] = parent_from_frame @ chain[frame]
            frame = parent
        return chain


def read_transforms(bag: Bag, decoder: Decoder) -> Transforms:
    """The static transforms; those that cannot be used are left out."""
    parents: dict[str, tuple[str, SE3]] = {}
    for topic in _named(bag, STATIC):
        for child, parent, pose in _poses(bag, decoder, topic, _MOST_MESSAGES):
            parents[child] = (parent, pose)
    return Transforms(parents)


def with_constant(static: Transforms, bag: Bag, decoder: Decoder, frame: str) -> Transforms:
    """With the constant transforms of /tf, if the static ones do not lead to the robot's frame.

    A joint's, or those of robots that publish all transforms again and again.
    """
    topics = _named(bag, MOVING)
    if not frame or not topics or static.base_of(frame) is not None:
        return static
    first: dict[str, tuple[str, SE3]] = {}
    moving: set[str] = set()
    for topic in topics:
        for child, parent, pose in _poses(bag, decoder, topic, _MOST_MOVING):
            above, before = first.setdefault(child, (parent, pose))
            moved = before.inverse() @ pose
            if above != parent or moved.distance_m > _STILL_M or moved.angle_rad > _STILL_RAD:
                moving.add(child)
    constant = {child: parent for child, parent in first.items() if child not in moving}
    return Transforms({**constant, **static.parents}, moving - static.parents.keys())


def _named(bag: Bag, ending: str) -> list[str]:
    """The topics of transforms of this name, in any namespace."""
    return [
        name
        for name, topic in bag.topics.items()
        if name.endswith(ending) and same_type(topic.type) == _TF
    ]


def _poses(bag: Bag, decoder: Decoder, topic: str, most: int) -> Iterator[tuple[str, str, SE3]]:
    """Child, parent and parent_from_child of the transforms in the first messages of a topic."""
    for message in islice(_messages(bag, decoder, topic, _TF), most):
        for transform in message.transforms:
            pose = _pose_of_transform(transform.transform)
            if pose is None:
                bag.note(f"{topic}: {transform.child_frame_id[:60]!r} has no valid rotation")
                continue
            yield transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/"), pose


def _pose_of_transform(transform: Any) -> SE3 | None:
    q, t = transform.rotation, transform.translation
    try:
        return SE3.from_quaternion([q.w, q.x, q.y, q.z], [t.x, t.y, t.z])
    except InputError:
        return None


def read_infos(
    bag: Bag, decoder: Decoder, stereo: StereoTopics, size: tuple[int, int] | None = None
) -> tuple[CameraInfo, CameraInfo] | None:
    """The first `CameraInfo` of each camera; None if one is missing.

    Those that belong to the images by their names, or the only two that the bag has: the right one
    states the baseline.

    Args:
        size: of the images, px; None if unknown.
    """
    topics = [name for name, topic in bag.topics.items() if same_type(topic.type) == _INFO]
    named = info_topics(stereo, topics)
    chosen = topics if named is None else [named.left, named.right]
    if len(chosen) != 2:
        return None
    infos = []
    for topic in chosen:
        message = next(_messages(bag, decoder, topic, _INFO), None)
        if message is None:
            return None
        infos.append(_info(topic, message, size, rectified=stereo.are_rectified))
    if named is None:
        infos.sort(key=lambda info: -info.p[0, 3])
    left, right = infos
    return left, right


def mounting(transforms: Transforms, frame: str) -> SE3 | None:
    """The robot's frame in a camera's, camera_from_base; None if nothing fixed leads there."""
    base = transforms.base_of(frame)
    return None if base is None else transforms.between(frame, base)


def mounted(cameras: Cameras, camera_from_base: SE3 | None) -> Cameras:
    """With this mounting of the left camera, if they have none of their own."""
    camera, raw = cameras.camera, cameras.raw
    if camera.cam_from_rig is not None or camera_from_base is None:
        return cameras
    if raw is not None:
        raw = replace(raw, left_from_rig=camera_from_base)
        return rectified_cameras(raw, cameras.field_of_view_deg, cameras.topics)
    if cameras.rectification is not None:
        camera_from_base = cameras.rectification.rectified_from_raw @ camera_from_base
    return replace(cameras, camera=replace(camera, cam_from_rig=camera_from_base))


def read_cameras(
    bag: Bag,
    decoder: Decoder,
    stereo: StereoTopics,
    size: tuple[int, int],
    field_of_view_deg: float | None,
) -> Cameras:
    """The stereo pair as the bag describes it.

    Args:
        size: of the images, px.
        field_of_view_deg: of rectified images; None for the largest.
    """
    if stereo.are_halves:
        raise CalibrationError(
            f"{bag.path}: each image of {stereo.left} holds both sides, of {size[0]}×{size[1]} px; "
            "give the calibration of the two halves with --calibration FILE (Kalibr's "
            "camchain.yaml, ROS's left.yaml with right.yaml, OpenCV's, or calibration.toml)"
        )
    infos = read_infos(bag, decoder, stereo, size)
    if infos is None:
        others = [name for name, topic in bag.topics.items() if same_type(topic.type) == _INFO]
        also = f" (those of {', '.join(others)} belong to other topics)" if others else ""
        raise CalibrationError(
            f"{bag.path}: has no CameraInfo for {stereo.left} and {stereo.right}{also}; give the "
            "calibration with --calibration FILE (Kalibr's camchain.yaml, ROS's left.yaml with "
            "right.yaml, OpenCV's, or calibration.toml)"
        )
    left, right = infos
    if (left.width, left.height) != size:
        raise CalibrationError(
            f"{bag.path}: the CameraInfo of the left camera is for {left.width}×{left.height} "
            f"px, the images of {stereo.left} are {size[0]}×{size[1]}: give the calibration of "
            f"these images with --calibration FILE{scaled_by((left.width, left.height), size)}"
        )
    transforms = with_constant(read_transforms(bag, decoder), bag, decoder, left.frame)
    try:
        return cameras_of_infos(
            left,
            right,
            rectified=stereo.are_rectified,
            right_from_left=_right_from_left(bag, decoder, stereo, transforms, left, right),
            left_from_rig=mounting(transforms, left.frame),
            field_of_view_deg=field_of_view_deg,
        )
    except InputError as error:
        names = f"CameraInfo of {stereo.left} and {stereo.right}"
        raise CalibrationError(f"{bag.path}: {names}: {error}") from error


def _right_from_left(
    bag: Bag,
    decoder: Decoder,
    stereo: StereoTopics,
    transforms: Transforms,
    left: CameraInfo,
    right: CameraInfo,
) -> SE3 | None:
    """Pose of the left camera in the right one by the bag's transforms; None without one."""
    if left.frame != right.frame:
        right_from_left = transforms.between(right.frame, left.frame)
        if right_from_left is not None:
            return _optical(right_from_left, left.frame, right.frame)
    poses = [_stream_pose(bag, decoder, topic) for topic in (stereo.left, stereo.right)]
    if poses[0] is None or poses[1] is None:
        return None
    # Of the two readings of such a pose, that by which the first camera is the left one.
    right_from_left = poses[1] @ poses[0].inverse()
    other = poses[1].inverse() @ poses[0]
    return right_from_left if right_from_left.translation[0] < other.translation[0] else other


def _optical(right_from_left: SE3, *frames: str) -> SE3:
    """The same between optical frames: bodies have x forward and y left (REP 103)."""
    x, y, _ = np.abs(right_from_left.translation)
    if y <= x or any("optical" in frame for frame in frames):
        return right_from_left
    return FORWARD @ right_from_left @ FORWARD.inverse()


def _stream_pose(bag: Bag, decoder: Decoder, image: str) -> SE3 | None:
    """The pose that RealSense's recorder stores with a stream's images."""
    topic = f"{image.removesuffix('/image/data')}/{_POSE_TOPIC}"
    message = next(_messages(bag, decoder, topic, _POSE), None)
    return None if message is None else _pose_of_transform(message)


def _messages(bag: Bag, decoder: Decoder, topic: str, kind: str) -> Iterator[Any]:
    stated = bag.topics.get(topic)
    if stated is None or same_type(stated.type) != kind:
        return
    for number, record in enumerate(bag.records({topic}), start=1):
        try:
            yield decoder.message(record, kind)
        except DamageError as error:
            bag.note(f"{topic}: message {number} {error}")
        if number == stated.count:
            return


def _info(topic: str, message: Any, size: tuple[int, int] | None, *, rectified: bool) -> CameraInfo:
    names = ("d", "k", "r", "p") if hasattr(message, "k") else ("D", "K", "R", "P")
    d, k, r, p = (np.asarray(getattr(message, name), dtype=np.float64) for name in names)
    try:
        if not all(np.isfinite(matrix).all() for matrix in (d, k, r, p)):
            raise CalibrationError("has a number that is not finite")
        # The lens of rectified images has no part in them.
        model = "none" if rectified and p[0] > 0 else message.distortion_model
        lens = lens_of(model, lambda counts: _counted(d, counts))
    except CalibrationError as error:
        raise CalibrationError(f"{topic}: {error}") from error
    whole = CameraInfo(
        int(message.width),
        int(message.height),
        *lens,
        k.reshape(3, 3),
        r.reshape(3, 3),
        p.reshape(3, 4),
        str(message.header.frame_id).lstrip("/"),
    )
    return _cut_out(whole, message, size)


def _cut_out(info: CameraInfo, message: Any, size: tuple[int, int] | None) -> CameraInfo:
    """The camera of the images that are sent: a region of the sensor, its pixels joined.

    Some drivers state a region or binning and send whole images; the size of the images decides.
    """
    roi, joined = message.roi, (max(message.binning_x, 1), max(message.binning_y, 1))
    region = (int(roi.width) or info.width, int(roi.height) or info.height)
    if (*region, *joined) == (info.width, info.height, 1, 1):
        return info
    sent = (region[0] // joined[0], region[1] // joined[1])
    if size is not None and sent != size:
        return info
    at = np.array([roi.x_offset, roi.y_offset], np.float64)
    k, p = info.k.copy(), info.p.copy()
    for matrix in (k, p):
        matrix[:2, 2] = (matrix[:2, 2] - at * matrix[2, 2] + 0.5) / joined - 0.5
        matrix[[0, 1], [0, 1]] /= joined
    p[:2, 3] /= joined
    return replace(info, width=sent[0], height=sent[1], k=k, p=p)


def _counted(d: Any, counts: set[int]) -> list[float]:
    if len(d) == 0:  # drivers of rectified cameras leave it empty
        return [0.0] * min(counts)
    used = np.trim_zeros(np.asarray(d), "b")
    fitting = [count for count in sorted(counts) if count >= len(used)]
    if not fitting:
        wanted = " or ".join(map(str, sorted(counts)))
        raise CalibrationError(f"D has {len(d)} coefficients, must be {wanted}")
    padded = np.pad(used, (0, fitting[0] - len(used)))
    return [float(value) for value in padded]


ODOMETRY, TWIST, IMU = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TwistStamped",
    "sensor_msgs/msg/Imu",
)


class BagMotion:
    """The motion topics of a bag, and files given in addition.

    Args:
        names: topics or files: at most one of odometry and one of a gyroscope.
        transforms: static transforms, for the axes of the gyroscope.

    Attributes:
        clocks: of the topics' stamps, in the latest pass.
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
        return tuple(source for source in self._sources.values() if source not in self._bag.topics)

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
            topic.name
            for topic in self._bag.topics.values()
            if topic.type in {ODOMETRY, TWIST, IMU}
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
        for timed in timed_messages(self._bag, self._decoder, name, clock):
            message, stamp_ns = timed.item[0], timed.time_ns
            if topic.type == IMU:
                sample = Sample(stamp_ns, None, _vector(message.angular_velocity))
            else:
                pose = _pose_of_odometry(message) if topic.type == ODOMETRY else None
                twist = message.twist.twist if topic.type == ODOMETRY else message.twist
                velocity = _vector(twist.linear)
                sample = Sample(stamp_ns, velocity, _vector(twist.angular))
                still = not np.nan_to_num(velocity).any()
                if still and pose is not None and last_pose is not None:
                    sample = _between(last_pose, last_ns, pose, stamp_ns)
                last_pose = pose
            last_ns = stamp_ns
            speed_m_s = 0.0 if sample.velocity_m_s is None else sample.velocity_m_s
            if np.isfinite(np.r_[speed_m_s, sample.rates_rad_s]).all():
                yield sample
            else:  # not a robot at rest: nothing was measured
                self._bag.note(f"{name}: a measurement is not finite; left out")


def _pose_of_odometry(message: Any) -> SE3 | None:
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
