"""Writes small bags with `rosbags`: ROS 1, SQLite or MCAP, raw or compressed."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from engram.geometry.se3 import SE3

KINDS = ("ros1", "sqlite", "mcap")
LEFT, RIGHT = "/stereo/left/image_raw", "/stereo/right/image_raw"


def store(kind: str) -> Any:
    if kind != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    made = get_typestore(Stores.ROS1_NOETIC)
    name = "tf2_msgs/msg/TFMessage"
    if name not in made.fielddefs:
        made.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return made


class BagMaker:
    """Writes messages of a bag; ROS 1 if `kind` says so."""

    def __init__(self, writer: Any, kind: str) -> None:
        self.store = store(kind)
        self.types = self.store.types
        self._writer, self._is1 = writer, kind == "ros1"
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, kind: str, message: Any, stamp_ns: int) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self.store
            )
        serialise = self.store.serialize_ros1 if self._is1 else self.store.serialize_cdr
        self._writer.write(self._connections[topic], stamp_ns, bytes(serialise(message, kind)))

    def header(self, stamp_ns: int, frame: str = "") -> Any:
        time = self.types["builtin_interfaces/msg/Time"](
            int(stamp_ns // 10**9), int(stamp_ns % 10**9)
        )
        fields = {"stamp": time, "frame_id": frame}
        if self._is1:
            fields["seq"] = 0
        return self.types["std_msgs/msg/Header"](**fields)

    def image(
        self,
        topic: str,
        stamp_ns: int,
        image: np.ndarray,
        encoding: str = "mono8",
        received_ns: int | None = None,
        big_endian: bool = False,
        **stated: int,
    ) -> None:
        stored = image.astype(image.dtype.newbyteorder(">")) if big_endian else image
        message = self.types["sensor_msgs/msg/Image"](
            header=self.header(stamp_ns),
            height=stated.get("height", image.shape[0]),
            width=image.shape[1],
            encoding=encoding,
            is_bigendian=int(big_endian),
            step=stated.get("step", image[0].nbytes),
            data=np.frombuffer(stored.tobytes(), np.uint8),
        )
        self.write(topic, "sensor_msgs/msg/Image", message, received_ns or stamp_ns)

    def compressed(self, topic: str, stamp_ns: int, content: bytes, format: str = "png") -> None:  # noqa: A002
        message = self.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(stamp_ns), format=format, data=np.frombuffer(content, np.uint8)
        )
        self.write(topic, "sensor_msgs/msg/CompressedImage", message, stamp_ns)

    def info(self, topic: str, stamp_ns: int, values: dict[str, Any], frame: str = "") -> None:
        names = {name: name.upper() if self._is1 else name for name in ("d", "k", "r", "p")}
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](
            *values.get("roi", (0, 0, 0, 0)), do_rectify=False
        )
        arrays = {names[key]: np.asarray(values[key], np.float64).ravel() for key in names}
        message = self.types["sensor_msgs/msg/CameraInfo"](
            header=self.header(stamp_ns, frame),
            height=values["height"],
            width=values["width"],
            distortion_model=values.get("model", "plumb_bob"),
            binning_x=values.get("binning", 0),
            binning_y=values.get("binning", 0),
            roi=roi,
            **arrays,
        )
        self.write(topic, "sensor_msgs/msg/CameraInfo", message, stamp_ns)

    def transform(
        self,
        stamp_ns: int,
        parent: str,
        child: str,
        parent_from_child: SE3,
        topic: str = "/tf_static",
    ) -> None:
        stamped = self.types["geometry_msgs/msg/TransformStamped"](
            self.header(stamp_ns, parent), child, self._transform(parent_from_child)
        )
        message = self.types["tf2_msgs/msg/TFMessage"]([stamped])
        self.write(topic, "tf2_msgs/msg/TFMessage", message, stamp_ns)

    def pose(self, topic: str, stamp_ns: int, pose: SE3) -> None:
        """A pose in no frame, as RealSense's recorder writes it."""
        self.write(topic, "geometry_msgs/msg/Transform", self._transform(pose), stamp_ns)

    def _transform(self, pose: SE3) -> Any:
        types = self.types
        w, x, y, z = map(float, pose.quaternion_wxyz())
        return types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](*map(float, pose.translation)),
            types["geometry_msgs/msg/Quaternion"](x, y, z, w),
        )

    def odometry(
        self,
        topic: str,
        stamp_ns: int,
        forward_m_s: float,
        turn_rad_s: float,
        received_ns: int | None = None,
    ) -> None:
        types = self.types
        vector = types["geometry_msgs/msg/Vector3"]
        twist = types["geometry_msgs/msg/Twist"](
            vector(forward_m_s, 0.0, 0.0), vector(0.0, 0.0, turn_rad_s)
        )
        pose = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0),
            types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        )
        none = np.zeros(36)
        message = types["nav_msgs/msg/Odometry"](
            self.header(stamp_ns, "odom"),
            "base_link",
            types["geometry_msgs/msg/PoseWithCovariance"](pose, none),
            types["geometry_msgs/msg/TwistWithCovariance"](twist, none),
        )
        self.write(topic, "nav_msgs/msg/Odometry", message, received_ns or stamp_ns)

    def twist(self, topic: str, stamp_ns: int, forward_m_s: float, turn_rad_s: float) -> None:
        vector = self.types["geometry_msgs/msg/Vector3"]
        twist = self.types["geometry_msgs/msg/Twist"](
            vector(forward_m_s, 0.0, 0.0), vector(0.0, 0.0, turn_rad_s)
        )
        stamped = self.types["geometry_msgs/msg/TwistStamped"](self.header(stamp_ns, "rig"), twist)
        self.write(topic, "geometry_msgs/msg/TwistStamped", stamped, stamp_ns)

    def fix(
        self,
        topic: str,
        stamp_ns: int,
        place: tuple[float, float],
        status: int = 0,
        received_ns: int | None = None,
    ) -> None:
        types = self.types
        message = types["sensor_msgs/msg/NavSatFix"](
            self.header(stamp_ns, "gps"),
            types["sensor_msgs/msg/NavSatStatus"](status, 1),
            *place,
            250.0,
            np.diag([0.25, 0.25, 1.0]).ravel(),
            2,
        )
        self.write(topic, "sensor_msgs/msg/NavSatFix", message, received_ns or stamp_ns)

    def imu(self, topic: str, stamp_ns: int, rates_rad_s: Iterable[float]) -> None:
        types = self.types
        vector, none = types["geometry_msgs/msg/Vector3"], np.zeros(9)
        message = types["sensor_msgs/msg/Imu"](
            self.header(stamp_ns, "imu_link"),
            types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            none,
            vector(*map(float, rates_rad_s)),
            none,
            vector(0.0, 0.0, 9.81),
            none,
        )
        self.write(topic, "sensor_msgs/msg/Imu", message, stamp_ns)


@contextmanager
def bag(path: Path, kind: str, *, compress: str = "") -> Iterator[BagMaker]:
    """Writes a bag; `path` has the ending of its container afterwards, see `ending`.

    Args:
        path: without ending.
        kind: "ros1", "sqlite" or "mcap".
        compress: ROS 1: "bz2" or "lz4"; else "message", "file" or "storage".
    """
    if kind == "ros1":
        writer = Writer1(path.with_suffix(".bag"))
        if compress:
            writer.set_compression(Writer1.CompressionFormat[compress.upper()])
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if compress:
            writer.set_compression(CompressionMode[compress.upper()], CompressionFormat.ZSTD)
    with writer:
        yield BagMaker(writer, kind)


def made(path: Path, kind: str) -> Path:
    """What `bag` made of a path: a file, or a folder."""
    return path.with_suffix(".bag") if kind == "ros1" else path


def bare_file(path: Path, kind: str) -> Path:
    """The one file of a bag."""
    if kind == "ros1":
        return path.with_suffix(".bag")
    return next(path.glob("*.db3" if kind == "sqlite" else "*.mcap"))


@dataclass
class StereoBag:
    """What a test's stereo bag holds: pictures, stamps, calibration."""

    pairs: list[tuple[int, np.ndarray, np.ndarray]]
    infos: tuple[dict[str, Any], dict[str, Any]] | None
    topics: tuple[str, str] = (LEFT, RIGHT)
    png: bool = False
    offset_ns: int = 0
    encodings: dict[str, Any] = field(default_factory=dict)

    def write(self, path: Path, kind: str, *, compress: str = "") -> Path:
        with bag(path, kind, compress=compress) as maker:
            for number, (stamp_ns, *images) in enumerate(self.pairs):
                for side, image in enumerate(images):
                    self._write(maker, number, stamp_ns + side * self.offset_ns, side, image)
        return made(path, kind)

    def _write(self, maker: BagMaker, number: int, stamp_ns: int, side: int, image) -> None:
        topic = self.topics[side]
        if self.png:
            ok, content = cv2.imencode(".png", image)
            assert ok
            maker.compressed(topic + "/compressed", stamp_ns, content.tobytes(), "mono8; png")
        else:
            maker.image(topic, stamp_ns, image)
        if self.infos is not None:
            name = topic.rsplit("/", 1)[0] + "/camera_info"
            maker.info(name, stamp_ns, self.infos[side], ("left", "right")[side])


def rectified_infos(camera: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """`CameraInfo` of a rectified pair."""
    k = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    infos = []
    for shift in (0.0, -camera.fx * camera.baseline_m):
        p = np.c_[np.array(k), [shift, 0, 0]]
        size = {"width": camera.width, "height": camera.height}
        infos.append({**size, "d": np.zeros(5), "k": k, "r": np.eye(3), "p": p})
    return infos[0], infos[1]


def split(folder: Path, files: Iterable[Path]) -> Path:
    """A folder with bag files as the parts of one split bag."""
    folder.mkdir()
    for number, file in enumerate(files):
        shutil.copy(file, folder / f"drive_{number}{file.suffix}")
    return folder


def kalibr_chain(raw: Any, topics: tuple[str, str]) -> str:
    """Kalibr's camchain of a raw calibration with radtan lenses."""
    parts = []
    for number, (lens, topic) in enumerate(zip((raw.left, raw.right), topics, strict=True)):
        name, pose = (
            ("T_cam_imu", raw.left_from_rig) if number == 0 else ("T_cn_cnm1", raw.right_from_left)
        )
        parts.append(
            f"cam{number}:\n  camera_model: pinhole\n  distortion_model: radtan\n"
            f"  distortion_coeffs: {list(lens.coefficients)}\n"
            f"  intrinsics: {[lens.fx, lens.fy, lens.cx, lens.cy]}\n"
            f"  resolution: {[lens.width, lens.height]}\n"
            f"  {name}: {pose.matrix().tolist()}\n  rostopic: {topic}\n"
        )
    return "".join(parts)
