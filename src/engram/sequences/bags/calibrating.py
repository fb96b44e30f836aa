"""The calibration that a bag carries: `CameraInfo` and `/tf_static`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from engram.calibration import Cameras
from engram.calibration.camera_info import CameraInfo, cameras_of_infos
from engram.calibration.cameras import rectified_cameras
from engram.calibration.entries import coefficients, distortion_model
from engram.errors import CalibrationError, InputError
from engram.geometry import SE3
from engram.sequences.bags.bag import Bag
from engram.sequences.bags.messages import Decoder, same_type
from engram.sequences.bags.records import DamageError
from engram.sequences.bags.topics import StereoTopics, info_topic

_INFO = "sensor_msgs/msg/CameraInfo"
_TF = "tf2_msgs/msg/TFMessage"
STATIC = "/tf_static"
# Frames that stand for the robot, the best first (REP 105, REP 120).
BASES = ("base_link", "base_footprint", "base", "body", "imu_link")
# Static transforms come once, or again and again from several publishers.
_MOST_MESSAGES = 50


class Transforms:
    """The static transforms of a bag.

    Attributes:
        parents: child frame → its parent and parent_from_child, metres.
    """

    def __init__(self, parents: Mapping[str, tuple[str, SE3]]) -> None:
        self.parents = dict(parents)

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
    for message in islice(_messages(bag, decoder, STATIC, _TF), _MOST_MESSAGES):
        for one in message.transforms:
            q, t = one.transform.rotation, one.transform.translation
            try:
                parent_from_child = SE3.from_quaternion([q.w, q.x, q.y, q.z], [t.x, t.y, t.z])
            except InputError:
                bag.note(f"{STATIC}: {one.child_frame_id[:60]!r} has no valid rotation")
                continue
            parents[one.child_frame_id.lstrip("/")] = (
                one.header.frame_id.lstrip("/"),
                parent_from_child,
            )
    return Transforms(parents)


def read_infos(
    bag: Bag, decoder: Decoder, stereo: StereoTopics
) -> tuple[CameraInfo, CameraInfo] | None:
    """The first `CameraInfo` of each camera; None if the bag lacks one.

    Those beside the images, or the only two that the bag has: the right one states the baseline.

    Raises:
        CalibrationError: one is malformed.
    """
    beside = [info_topic(image, bag.topics) for image in (stereo.left, stereo.right)]
    topics = [name for name, one in bag.topics.items() if same_type(one.type) == _INFO]
    elsewhere = None in beside and len(topics) == 2
    infos = []
    for topic in topics if elsewhere else beside:
        message = None if topic is None else next(_messages(bag, decoder, topic, _INFO), None)
        if topic is None or message is None:
            return None
        infos.append((topic, _info(topic, message)))
    if elsewhere:
        infos.sort(key=lambda one: -one[1].p[0, 3])
    (_, left), (_, right) = infos
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
        bag: the bag.
        decoder: decodes its messages.
        stereo: the image topics.
        size: of the images, px.
        field_of_view_deg: of rectified images; None for the largest.

    Raises:
        CalibrationError: it does not, or what it says is not of a stereo pair.
    """
    infos = read_infos(bag, decoder, stereo)
    if infos is None:
        others = [name for name, one in bag.topics.items() if same_type(one.type) == _INFO]
        also = f" (those of {', '.join(others)} belong to other topics)" if others else ""
        raise CalibrationError(
            f"{bag.path}: has no CameraInfo for {stereo.left} and {stereo.right}{also}; give the "
            "calibration with --calibration FILE (Kalibr's camchain.yaml, ROS's left.yaml beside "
            "right.yaml, OpenCV's, or calibration.toml)"
        )
    left, right = infos
    if (left.width, left.height) != size:
        raise CalibrationError(
            f"{bag.path}: the CameraInfo of the left camera is of {left.width}×{left.height} "
            f"px, the images of {stereo.left} are {size[0]}×{size[1]}: give the calibration of "
            "these images with --calibration FILE"
        )
    transforms = read_transforms(bag, decoder)
    try:
        return cameras_of_infos(
            left,
            right,
            rectified=stereo.are_rectified,
            right_from_left=transforms.between(right.frame, left.frame),
            left_from_rig=mounting(transforms, left.frame),
            field_of_view_deg=field_of_view_deg,
        )
    except InputError as error:
        names = f"CameraInfo of {stereo.left} and {stereo.right}"
        raise CalibrationError(f"{bag.path}: {names}: {error}") from error


def _messages(bag: Bag, decoder: Decoder, topic: str, kind: str) -> Iterator[Any]:
    """The messages of a topic that can be decoded; ends with the last one."""
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


def _info(topic: str, message: Any) -> CameraInfo:
    names = ("d", "k", "r", "p") if hasattr(message, "k") else ("D", "K", "R", "P")
    d, k, r, p = (np.asarray(getattr(message, name), dtype=np.float64) for name in names)
    try:
        if not all(np.isfinite(one).all() for one in (d, k, r, p)):
            raise CalibrationError("has a number that is not finite")
        if max(message.binning_x, message.binning_y) > 1 or message.roi.width:
            raise CalibrationError(
                "states binning or a region of interest, which is not supported; give the pair's "
                "calibration with --calibration FILE"
            )
        model, coefficients_ = coefficients(
            distortion_model(message.distortion_model), lambda counts: _counted(d, counts)
        )
    except CalibrationError as error:
        raise CalibrationError(f"{topic}: {error}") from error
    return CameraInfo(
        int(message.width),
        int(message.height),
        model,
        coefficients_,
        k.reshape(3, 3),
        r.reshape(3, 3),
        p.reshape(3, 4),
        str(message.header.frame_id),
    )


def _counted(d: Any, counts: set[int]) -> list[float]:
    if len(d) == 0:  # drivers of rectified cameras leave it empty
        return [0.0] * min(counts)
    if len(d) not in counts:
        wanted = " or ".join(map(str, sorted(counts)))
        raise CalibrationError(f"D has {len(d)} coefficients, must be {wanted}")
    return [float(one) for one in d]
