"""What drivers and recorders write, odd but sound: it reads, or the error names the cure."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from engram.errors import CalibrationError, SequenceError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.sequences.bags import containers
from engram.sequences.bags.bag_sequence import BagSequence, describe_bag
from engram.sequences.bags.containers import Bag, Record
from engram.sequences.opening import open_drive
from engram_lab.bench.data import synthetic_drive

from .bag_maker import (
    LEFT,
    RIGHT,
    BagMaker,
    StereoBag,
    bag,
    bare_file,
    made,
    rectified_infos,
)
from .synthetic import (
    HEIGHT,
    PAIRS,
    START_NS,
    WIDTH,
    camera,
    interrupt_transaction,
    name_super_journal,
    picture,
    stamp_ns,
)

PICTURES = [(stamp_ns(index), picture(index, 0), picture(index, 1)) for index in range(PAIRS)]
CAMERA = camera()
Street = tuple[StereoPair, ...]
INFOS = rectified_infos(CAMERA)
WHOLE = StereoBag(PICTURES, INFOS)
ZEROS = {"p": np.zeros((3, 4)), "r": np.zeros((3, 3))}
SIDES = (SE3.identity(), SE3(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0])))
# Optical axes in a body's: x right is −y, y down is −z, z forward is x.
OPTICAL = SE3(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))


def infos(**changes: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """The calibration with the same changes on both sides."""
    return ({**INFOS[0], **changes}, {**INFOS[1], **changes})


def images(maker: BagMaker, topics: tuple[str, str] = (LEFT, RIGHT)) -> None:
    for stamp, *sides in PICTURES:
        for topic, image in zip(topics, sides, strict=True):
            maker.image(topic, stamp, image)


def assert_whole(sequence: Any, like: Any = CAMERA) -> None:
    """All pairs, bit for bit, by the right camera."""
    assert isinstance(sequence, BagSequence)
    assert sequence.camera == like
    pairs = list(sequence)
    assert len(pairs) == PAIRS
    for pair, (_, left, right) in zip(pairs, PICTURES, strict=True):
        np.testing.assert_array_equal(pair.left, left)
        np.testing.assert_array_equal(pair.right, right)
    assert sequence.lost == []


class TestRealSense:
    LEFT, RIGHT = (f"/device_0/sensor_0/Infrared_{number}/image/data" for number in (1, 2))

    @pytest.mark.parametrize("model", ["Brown Conrady", "Inverse Brown Conrady", "None"])
    @pytest.mark.parametrize("sign", [1, -1], ids=["pose of the sensor", "of its origin"])
    def test_its_own_recorder(self, tmp_path, model: str, sign: int) -> None:
        with bag(tmp_path / "viewer", "ros1") as maker:
            for side, name in enumerate(("Infrared_1", "Infrared_2")):
                base = f"/device_0/sensor_0/{name}"
                values = {**INFOS[side], **ZEROS, "model": model}
                maker.info(f"{base}/info/camera_info", START_NS, values)
                shift = sign * SIDES[side].translation
                maker.pose(f"{base}/tf/0", START_NS, SE3(np.eye(3), shift))
            images(maker, (self.LEFT, self.RIGHT))
        sequence = open_drive(tmp_path / "viewer.bag")
        assert_whole(sequence)
        assert describe_bag(tmp_path / "viewer.bag").question == ""

    def test_coefficients_of_a_model_that_is_not_read_are_refused(self, tmp_path) -> None:
        changed = infos(model="inverse_brown_conrady", d=np.full(5, 0.1))
        path = StereoBag(PICTURES, changed).write(tmp_path / "b", "mcap")
        with pytest.raises(CalibrationError, match=r"'inverse_brown_conrady'; known: .*calibrate"):
            open_drive(path)


class TestCameraInfo:
    @pytest.mark.parametrize(
        "changes",
        [
            pytest.param({"roi": (0, 0, HEIGHT, WIDTH), "binning": 1}, id="whole region"),
            pytest.param({"binning": 2}, id="binning of images that are whole"),
            pytest.param({"k": np.zeros((3, 3)), "r": np.zeros((3, 3))}, id="no K"),
            pytest.param({"d": np.zeros(0)}, id="no D"),
            pytest.param({"d": np.zeros(14), "model": "rational_polynomial"}, id="D of 14"),
            pytest.param({"model": "Plumb Bob"}, id="model in other letters"),
            pytest.param({"model": "pinhole"}, id="model pinhole"),
        ],
    )
    def test_what_drivers_leave_out_or_add(self, tmp_path, changes: dict[str, Any]) -> None:
        path = StereoBag(PICTURES, infos(**changes)).write(tmp_path / "b", "mcap")
        assert_whole(open_drive(path))

    def test_a_region_of_binned_pixels(self, tmp_path) -> None:
        x, y, binning = 20, 10, 2
        k = np.array(INFOS[0]["k"], np.float64)
        k[:2, 2] = (k[:2, 2] + 0.5) * binning - 0.5 + [x, y]
        k[[0, 1], [0, 1]] *= binning
        shifts = (0.0, -k[0, 0] * CAMERA.baseline_m)
        region = {"roi": (x, y, HEIGHT * binning, WIDTH * binning), "binning": binning}
        changed = tuple(
            {**info, "k": k, "p": np.c_[k, [shift, 0, 0]], "width": 400, "height": 300, **region}
            for info, shift in zip(INFOS, shifts, strict=True)
        )
        assert_whole(open_drive(StereoBag(PICTURES, changed).write(tmp_path / "b", "mcap")))

    def test_an_unknown_lens_does_not_matter_to_rectified_images(self, tmp_path) -> None:
        changed = infos(model="ftheta", d=np.full(3, 0.3))
        topics = ("/s/left/image_rect", "/s/right/image_rect")
        assert_whole(open_drive(StereoBag(PICTURES, changed, topics).write(tmp_path / "b", "mcap")))

    @pytest.mark.parametrize("rectified", [True, False])
    def test_without_p_the_transforms_state_the_baseline(self, tmp_path, rectified: bool) -> None:
        kind = "image_rect" if rectified else "image_raw"
        topics = (f"/s/left/{kind}", f"/s/right/{kind}")
        with bag(tmp_path / "b", "mcap") as maker:
            for name, topic, info, pose in zip("ab", topics, INFOS, SIDES, strict=True):
                maker.transform(START_NS, "rig", name, pose)
                maker.info(topic.replace(kind, "camera_info"), START_NS, {**info, **ZEROS}, name)
            images(maker, topics)
        assert_whole(open_drive(tmp_path / "b"))

    def test_without_p_turned_cameras_are_rectified(self, tmp_path) -> None:
        turned = SE3.exp([0, 0, 0, 0.0, 0.02, 0.0])
        with bag(tmp_path / "b", "mcap") as maker:
            for name, topic, info, pose in zip(
                "ab", (LEFT, RIGHT), INFOS, (SIDES[0], SIDES[1] @ turned), strict=True
            ):
                maker.transform(START_NS, "rig", name, pose)
                place = topic.replace("image_raw", "camera_info")
                maker.info(place, START_NS, {**info, **ZEROS}, name)
            images(maker)
        sequence = open_drive(tmp_path / "b")
        assert isinstance(sequence, BagSequence)
        assert sequence.cameras.raw is not None
        assert sequence.camera.baseline_m == pytest.approx(CAMERA.baseline_m)

    def test_frames_of_bodies_look_along_x(self, tmp_path) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            for name, topic, info, pose in zip(
                ("left_cam", "right_cam"), (LEFT, RIGHT), INFOS, SIDES, strict=True
            ):
                maker.transform(START_NS, "rig", name, OPTICAL @ pose @ OPTICAL.inverse())
                maker.info(
                    topic.replace("image_raw", "camera_info"),
                    START_NS,
                    {**info, "p": INFOS[0]["p"]},
                    name,
                )
            images(maker)
        assert_whole(open_drive(tmp_path / "b"))

    @pytest.mark.parametrize("topic", ["image_raw", "image_rect_raw", "image_rect"])
    def test_without_p_and_transforms_the_pair_is_asked_for(self, tmp_path, topic) -> None:
        topics = (f"/s/left/{topic}", f"/s/right/{topic}")
        path = StereoBag(PICTURES, infos(**ZEROS), topics).write(tmp_path / "b", "mcap")
        with pytest.raises(CalibrationError, match=r"no projection P.*--calibration FILE"):
            open_drive(path)

    def test_one_frame_for_both_cameras_is_no_pose(self, tmp_path) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            maker.transform(START_NS, "rig", "cam", SE3.identity())
            for topic, info in zip((LEFT, RIGHT), infos(**ZEROS), strict=True):
                maker.info(topic.replace("image_raw", "camera_info"), START_NS, info, "cam")
            images(maker)
        with pytest.raises(CalibrationError, match="no projection P"):
            open_drive(tmp_path / "b")

    def test_cameras_above_each_other_name_the_turn(self, tmp_path) -> None:
        p = np.array(INFOS[0]["p"])
        p[1, 3] = -CAMERA.fy * CAMERA.baseline_m
        path = StereoBag(PICTURES, (INFOS[0], {**INFOS[1], "p": p})).write(tmp_path / "b", "mcap")
        with pytest.raises(CalibrationError, match=r"one above the other.*90° anticlockwise"):
            open_drive(path)

    @pytest.mark.parametrize(
        "topics",
        [
            ("/stereo/left_camera_info", "/stereo/right_camera_info"),
            ("/stereo/left/image_raw/camera_info", "/stereo/right/image_raw/camera_info"),
            ("/info/left", "/info/right"),
            ("/left/camera_info", "/right/camera_info"),
        ],
    )
    def test_it_may_stand_elsewhere(self, tmp_path, topics: tuple[str, str]) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            images(maker)
            for topic, info in zip(topics, INFOS, strict=True):
                maker.info(topic, START_NS, info)
            maker.info("/colour/camera_info", START_NS, {**INFOS[0], "width": 640, "height": 480})
        assert_whole(open_drive(tmp_path / "b"))

    def test_scaled_images_name_the_factor(self, tmp_path) -> None:
        changed = infos(width=2 * WIDTH, height=2 * HEIGHT)
        path = StereoBag(PICTURES, changed).write(tmp_path / "b", "mcap")
        with pytest.raises(CalibrationError, match=r"by 0\.5, and state width 48 and height 32"):
            open_drive(path)

    def test_two_sizes_are_told_before_anything_else(self, tmp_path) -> None:
        small = {**INFOS[1], "width": WIDTH // 2, "height": HEIGHT // 2}
        path = StereoBag(PICTURES, (INFOS[0], small)).write(tmp_path / "b", "mcap")
        with pytest.raises(CalibrationError, match="needs equal sizes; set both cameras to one"):
            open_drive(path)


@pytest.fixture(scope="module")
def drawn() -> Street:
    """Three pairs of a rendered street."""
    return synthetic_drive(3)


class TestSignOfTheBaseline:
    """P[3] of the right camera is positive: a wrong sign, or exchanged sides? The images tell."""

    def written(self, street: Street, folder: Path, exchanged: bool) -> Path:
        left, right = rectified_infos(street[0].camera)
        p = np.array(right["p"])
        p[0, 3] *= -1
        pairs = [
            (
                one.stamp_ns + START_NS,
                *((one.right, one.left) if exchanged else (one.left, one.right)),
            )
            for one in street
        ]
        return StereoBag(pairs, (left, {**right, "p": p})).write(folder / "b", "mcap")

    def test_it_is_read_where_the_sides_are_in_order(self, drawn: Street, tmp_path: Path) -> None:
        sequence = open_drive(self.written(drawn, tmp_path, exchanged=False))
        assert isinstance(sequence, BagSequence)
        assert sequence.camera.baseline_m == pytest.approx(drawn[0].camera.baseline_m)
        (note,) = sequence.notes
        assert "−fx·baseline" in note
        assert len(list(sequence)) == 3

    def test_the_hint_for_exchanged_sides_ends_elsewhere(
        self, drawn: Street, tmp_path: Path
    ) -> None:
        path = self.written(drawn, tmp_path, exchanged=True)
        with pytest.raises(CalibrationError, match=r"exchange the two folders, or topics"):
            open_drive(path)
        sequence = open_drive(path, left=RIGHT, right=LEFT)
        np.testing.assert_array_equal(next(iter(sequence)).left, drawn[0].left)

    def test_the_wrong_hint_does_not_lead_back(self, drawn: Street, tmp_path: Path) -> None:
        """Exchanged topics of a wrong sign look right on paper; the doctor sees the images."""
        path = self.written(drawn, tmp_path, exchanged=False)
        sequence = open_drive(path, left=RIGHT, right=LEFT)
        assert sequence.camera.baseline_m == pytest.approx(drawn[0].camera.baseline_m)


class TestPlanarYuv:
    @pytest.mark.parametrize(
        ("encoding", "rows"),
        [("nv12", 0.5), ("nv21", 0.5), ("I420", 0.5), ("nv16", 1), ("nv24", 2)],
    )
    @pytest.mark.parametrize("stated", ["image", "all rows", "all bytes"])
    def test_the_first_plane_is_the_image(self, tmp_path, encoding, rows, stated) -> None:
        chroma = np.full((int(rows * HEIGHT), WIDTH), 128, np.uint8)
        facts = {
            "image": {"height": HEIGHT},
            "all rows": {},
            "all bytes": {"height": HEIGHT, "step": int(WIDTH * (1 + rows))},
        }[stated]
        with bag(tmp_path / "b", "mcap") as maker:
            for stamp, *sides in PICTURES:
                for topic, image, info in zip((LEFT, RIGHT), sides, INFOS, strict=True):
                    planes = np.vstack([image, chroma])
                    maker.image(topic, stamp, planes, encoding, **facts)
                    maker.info(topic.replace("image_raw", "camera_info"), stamp, info)
        assert_whole(open_drive(tmp_path / "b"))

    def test_a_reason_is_told_once_with_its_count(self, tmp_path) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            for stamp, *sides in PICTURES:
                for topic, image, info in zip((LEFT, RIGHT), sides, INFOS, strict=True):
                    maker.image(topic, stamp, image, "mono7")
                    maker.info(topic.replace("image_raw", "camera_info"), stamp, info)
        sequence = open_drive(tmp_path / "b")
        with pytest.raises(SequenceError, match=rf"image 0: .*\(and {PAIRS - 1} images more\)"):
            list(sequence)
        assert len(sequence.skipped_reasons) == 1
        assert sequence.skipped == PAIRS


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("/cam_l/image", "/cam_r/image"),
        ("/Stereo/Left/Image", "/Stereo/Right/Image"),
        ("/LEFT/image", "/RIGHT/image"),
        ("/image_left", "/image_right"),
        ("/fisheye1/image_raw", "/fisheye2/image_raw"),
        ("/camera_01/image_raw", "/camera_02/image_raw"),
        ("/left_arm/cam/left/image_raw", "/left_arm/cam/right/image_raw"),
        ("/camera/direct/left/image", "/camera/direct/right/image"),
        ("/infrared_1/image", "/infrared_2/image"),
    ],
)
def test_names_of_pairs(tmp_path, left: str, right: str) -> None:
    with bag(tmp_path / "b", "mcap") as maker:
        images(maker, (left, right))
        for topic, info in zip((left, right), INFOS, strict=True):
            maker.info(f"{topic}_camera_info", START_NS, info)
    sequence = open_drive(tmp_path / "b")
    assert_whole(sequence)
    assert (sequence.topics.left, sequence.topics.right) == (left, right)
    assert not sequence.topics.are_rectified


class TestContainers:
    def record(self, code: int, *parts: Any) -> bytes:
        content = b"".join(
            struct.pack("<I", len(part)) + part.encode() if isinstance(part, str) else part
            for part in parts
        )
        return struct.pack("<BQ", code, len(content)) + content

    def mcap(self, path: Path, channels: list[tuple[str, str, str]], records: list[Record]) -> Path:
        """An MCAP file without chunks and summary.

        Args:
            path: the file.
            channels: topic, type and encoding of each.
            records: the messages.
        """
        number = partial(struct.pack, "<H")
        body = [self.record(1, "ros1", "a converter")]
        for at, (topic, kind, encoding) in enumerate(channels):
            body.append(self.record(3, number(at + 1), kind, "ros1msg", struct.pack("<I", 0)))
            rest = struct.pack("<I", 0)
            body.append(self.record(4, number(at), number(at + 1), topic, encoding, rest))
        ids = {topic: at for at, (topic, *_) in enumerate(channels)}
        for one in records:
            head = struct.pack("<HIQQ", ids[one.topic], 0, one.received_ns, one.received_ns)
            body.append(self.record(5, head, one.data))
        end = [self.record(15, struct.pack("<I", 0)), self.record(2, struct.pack("<QQI", 0, 0, 0))]
        magic = b"\x89MCAP0\r\n"
        path.write_bytes(magic + b"".join(body + end) + magic)
        return path

    @pytest.mark.parametrize("kind", ["ros1", "mcap"])
    def test_mcap_with_messages_of_ros_1_or_with_others_beside(self, tmp_path, kind) -> None:
        source = Bag(WHOLE.write(tmp_path / "b", kind))
        encoding = "ros1" if kind == "ros1" else "cdr"
        channels = [
            (name, one.type.replace("/msg/", "/"), encoding) for name, one in source.topics.items()
        ]
        notes = [("/notes", "Note", "json")]
        records = [*source.records(), Record("/notes", START_NS, b"{}")]
        assert_whole(open_drive(self.mcap(tmp_path / "c.mcap", channels + notes, records)))

    def test_mcap_of_nothing_that_is_read(self, tmp_path) -> None:
        path = self.mcap(tmp_path / "c.mcap", [("/a", "foxglove.Image", "protobuf")], [])
        with pytest.raises(SequenceError, match=r"protobuf; only those of ROS 2 \(cdr\) and ROS 1"):
            open_drive(path)

    def killed(self, folder: Path) -> Path:
        """A bag whose recorder was killed: the messages lie in the log beside the file."""
        source = sqlite3.connect(bare_file(WHOLE.write(folder / "whole", "sqlite"), "sqlite"))
        live = sqlite3.connect(folder / "live.db3", isolation_level=None)
        live.execute("PRAGMA journal_mode = wal")
        live.execute("PRAGMA wal_autocheckpoint = 0")
        for line in source.iterdump():
            if not line.startswith(("BEGIN", "COMMIT")):
                live.execute(line)
        (folder / "killed").mkdir()
        for end in ("", "-wal"):
            content = (folder / f"live.db3{end}").read_bytes()
            (folder / "killed" / f"drive_0.db3{end}").write_bytes(content)
        source.close()
        live.close()
        return folder / "killed"

    def test_a_killed_recorder_on_a_disk_that_is_read_only(self, tmp_path, monkeypatch) -> None:
        path = self.killed(tmp_path)
        assert_whole(open_drive(path))
        (path / "drive_0.db3-shm").unlink(missing_ok=True)
        connect = containers._connected

        def read_only(file: Path, mode: str) -> sqlite3.Connection:
            """As SQLite fails where it cannot make its index: root may write anywhere."""
            opened = connect(file, mode)
            return _Refusing(opened) if file.parent == path else opened  # type: ignore[return-value]

        monkeypatch.setattr(containers, "_connected", read_only)
        assert_whole(open_drive(path))
        assert sorted(one.name for one in path.iterdir()) == ["drive_0.db3", "drive_0.db3-wal"]

    def test_a_recorder_killed_within_a_transaction(self, tmp_path) -> None:
        source = bare_file(WHOLE.write(tmp_path / "whole", "sqlite"), "sqlite")
        path = tmp_path / "killed" / "drive_0.db3"
        interrupt_transaction(source, "messages", path)
        assert path.read_bytes() != source.read_bytes()
        assert_whole(open_drive(path.parent))
        assert len(list(path.parent.iterdir())) == 2  # the recording itself is left alone

    def test_a_journal_deletes_no_file_that_it_names(self, tmp_path) -> None:
        source = bare_file(WHOLE.write(tmp_path / "whole", "sqlite"), "sqlite")
        path, named = tmp_path / "killed" / "drive_0.db3", tmp_path / "photographs.txt"
        interrupt_transaction(source, "messages", path)
        name_super_journal(path, named)
        named.write_text("mine")
        with pytest.raises(SequenceError, match="names another file"):
            open_drive(path.parent)
        assert named.read_text() == "mine"

    def test_what_a_killed_recorder_of_ros_1_leaves(self, tmp_path) -> None:
        path = WHOLE.write(tmp_path / "b", "ros1").rename(tmp_path / "b.bag.active")
        assert_whole(open_drive(path))


class _Refusing:
    """A connection to a database whose index cannot be made."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def execute(self, query: str) -> Any:
        raise sqlite3.OperationalError(f"unable to open database file: {query}")

    def close(self) -> None:
        self._connection.close()


TOML = (
    "[rectified]\nfx = 40.0\nfy = 40.0\ncx = 23.5\ncy = 15.5\nbaseline_m = 0.1\n"
    f"width = {WIDTH}\nheight = {HEIGHT}\n"
)


class TestSideBySide:
    TOPIC = "/stereo/image_raw"

    @pytest.fixture
    def wide(self, tmp_path) -> Path:
        with bag(tmp_path / "wide", "mcap") as maker:
            for stamp, left, right in PICTURES:
                maker.image(self.TOPIC, stamp, np.hstack([left, right]))
        (tmp_path / "calibration.toml").write_text(TOML)
        return tmp_path

    def test_the_error_names_the_options_that_read_it(self, wide) -> None:
        with pytest.raises(
            SequenceError, match="--left /stereo/image_raw --right /stereo/image_raw"
        ):
            open_drive(wide / "wide")
        command = describe_bag(wide / "wide").command
        assert command.endswith(f"--left {self.TOPIC} --right {self.TOPIC} --calibration FILE")

    @pytest.mark.parametrize("named", [True, False], ids=["named", "by the calibration's size"])
    def test_a_topic_of_both(self, wide, named: bool) -> None:
        options = {"left": self.TOPIC, "right": self.TOPIC} if named else {}
        calibration = wide / "calibration.toml"
        assert_whole(open_drive(wide / "wide", calibration=calibration, **options))

    def test_the_calibration_is_asked_for(self, wide) -> None:
        with pytest.raises(CalibrationError, match=r"48×32 px.*--calibration FILE"):
            open_drive(wide / "wide", left=self.TOPIC, right=self.TOPIC)

    @pytest.mark.parametrize("name", ["both", "images"])
    @pytest.mark.parametrize("stamped", [True, False])
    def test_a_folder_of_both(self, tmp_path, name: str, stamped: bool) -> None:
        folder = tmp_path / "monday" / name
        folder.mkdir(parents=True)
        for number, (stamp, left, right) in enumerate(PICTURES):
            file = f"{stamp}.png" if stamped else f"{number:06d}.png"
            cv2.imwrite(str(folder / file), np.hstack([left, right]))
        (tmp_path / "monday/calibration.toml").write_text(TOML)
        if not stamped:
            lines = (f"{stamp / 1e9:.9f}\n" for stamp, *_ in PICTURES)
            (tmp_path / "monday/times.txt").write_text("".join(lines))
        pairs = list(open_drive(tmp_path / "monday"))
        assert len(pairs) == PAIRS
        for pair, (_, left, right) in zip(pairs, PICTURES, strict=True):
            np.testing.assert_array_equal(pair.left, left)
            np.testing.assert_array_equal(pair.right, right)


class TestKalibr:
    """A chain may have the right camera first."""

    def chain(self, path: Path, topics: bool = True) -> Path:
        lens = {
            "camera_model": "pinhole",
            "distortion_model": "radtan",
            "distortion_coeffs": [0.0] * 4,
            "intrinsics": [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy],
            "resolution": [WIDTH, HEIGHT],
        }
        imu = SE3.exp([0.1, 0.2, 0.3, 0, 0, 0.1])
        cams = {
            "cam0": {**lens, "T_cam_imu": imu.matrix().tolist()},
            "cam1": {**lens, "T_cn_cnm1": SIDES[1].matrix().tolist()},
        }
        for name, one in cams.items() if topics else ():
            one["rostopic"] = f"/{name}/image_raw"
        path.write_text(yaml.safe_dump(cams))
        return path

    @pytest.mark.parametrize("topics", [True, False])
    @pytest.mark.parametrize("asked", [True, False])
    def test_its_second_camera_is_the_left_one(self, tmp_path, topics, asked) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            images(maker, ("/cam1/image_raw", "/cam0/image_raw"))
        chain = self.chain(tmp_path / "camchain.yaml", topics)
        options = {"left": "/cam1/image_raw", "right": "/cam0/image_raw"} if asked else {}
        sequence = open_drive(tmp_path / "b", calibration=chain, **options)
        assert isinstance(sequence, BagSequence)
        assert (sequence.topics.left, sequence.topics.right) == (
            "/cam1/image_raw",
            "/cam0/image_raw",
        )
        assert sequence.camera.baseline_m == pytest.approx(CAMERA.baseline_m)
        imu = SE3.exp([0.1, 0.2, 0.3, 0, 0, 0.1])
        mounting = sequence.camera.cam_from_rig
        assert mounting is not None
        np.testing.assert_allclose(mounting.matrix(), (SIDES[1] @ imu).matrix(), atol=1e-6)
        assert "right camera first" in sequence.notes[0]

    def test_topics_that_are_called_left_and_right_stay(self, tmp_path) -> None:
        path = WHOLE.write(tmp_path / "b", "mcap")
        chain = self.chain(tmp_path / "camchain.yaml", topics=False)
        assert open_drive(path, calibration=chain).topics.left == LEFT

    def test_compressed_images_are_those_of_the_topic(self, tmp_path) -> None:
        topics = ("/cam1/image_raw", "/cam0/image_raw")
        path = StereoBag(PICTURES, None, topics, png=True).write(tmp_path / "b", "mcap")
        sequence = open_drive(path, calibration=self.chain(tmp_path / "camchain.yaml"))
        assert sequence.topics.left == "/cam1/image_raw/compressed"


class TestMountingOnTf:
    MOUNT = SE3(np.eye(3), np.array([0.2, 0.0, 1.0])) @ OPTICAL

    def written(self, folder: Path, poses: Callable[[int], SE3], topic: str = "/tf") -> Path:
        with bag(folder / "b", "mcap") as maker:
            for number, (stamp, *sides) in enumerate(PICTURES):
                for name, image, info in zip(("left", "right"), sides, INFOS, strict=True):
                    maker.image(f"/stereo/{name}/image_raw", stamp, image)
                    maker.info(f"/stereo/{name}/camera_info", stamp, info, name)
                maker.transform(stamp, "odom", "base_link", SE3.exp([number, 0, 0, 0, 0, 0]), "/tf")
                maker.transform(stamp, "base_link", "head", poses(number), topic)
            maker.transform(START_NS, "head", "left", SE3.identity())
        return made(folder / "b", "mcap")

    def test_a_constant_one_is_used_and_told(self, tmp_path) -> None:
        sequence = open_drive(self.written(tmp_path, lambda _: self.MOUNT))
        mounting = sequence.camera.cam_from_rig
        assert mounting is not None
        np.testing.assert_allclose(mounting.matrix(), self.MOUNT.inverse().matrix(), atol=1e-9)
        assert "mounting on base_link is that of /tf" in sequence.notes[0]

    def test_a_moving_one_is_told_and_not_used(self, tmp_path) -> None:
        moving = self.written(tmp_path, lambda at: self.MOUNT @ SE3.exp([0, 0, 0, 0, 0.1 * at, 0]))
        sequence = open_drive(moving)
        assert sequence.camera.cam_from_rig is None
        assert "/tf moves head during the drive" in sequence.notes[0]
        assert describe_bag(moving).notes == sequence.notes

    def test_in_a_namespace(self, tmp_path) -> None:
        path = self.written(tmp_path, lambda _: self.MOUNT, "/robot7/tf_static")
        sequence = open_drive(path)
        assert sequence.camera.cam_from_rig is not None
        assert sequence.notes == []


def plain_folder(path: Path, names: Callable[[int, str], str], size: int = 1) -> Path:
    for number, (_, *sides) in enumerate(PICTURES):
        for name, image in zip(("left", "right"), sides, strict=True):
            (path / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path / name / names(number, name)), image[::size, ::size])
    (path / "calibration.toml").write_text(TOML)
    (path / "times.txt").write_text("".join(f"{0.1 * at:.1f}\n" for at in range(PAIRS)))
    return path


class TestFolders:
    @pytest.mark.parametrize(
        "names",
        [
            lambda at, side: f"frame{at:04d}_{side}.png",
            lambda at, side: f"{side[0].upper()}_{at:04d}.png",
            lambda at, side: f"{side}{at:04d}.png",
            lambda at, side: f"town_{at:06d}_{side}Img8bit.png",
        ],
        ids=["behind", "a letter", "before", "within"],
    )
    def test_names_that_tell_the_side_pair(self, tmp_path, names) -> None:
        pairs = list(open_drive(plain_folder(tmp_path / "monday", names)))
        for pair, (_, left, right) in zip(pairs, PICTURES, strict=True):
            np.testing.assert_array_equal(pair.left, left)
            np.testing.assert_array_equal(pair.right, right)

    def test_names_without_anything_in_common_are_asked_for(self, tmp_path) -> None:
        path = plain_folder(tmp_path / "m", lambda at, side: f"{'xy'[side == 'left']}{at}.png")
        with pytest.raises(SequenceError, match="same name on both sides"):
            open_drive(path)

    def test_all_images_scaled_name_the_factor(self, tmp_path) -> None:
        path = plain_folder(tmp_path / "m", lambda at, _: f"{at:03d}.png", size=2)
        with pytest.raises(SequenceError, match=r"multiply fx, fy, cx and cy .* by 0\.5") as raised:
            open_drive(path)
        assert "drive.skip_bad" not in str(raised.value)

    def test_skip_bad_is_no_cure_where_all_are_bad(self, tmp_path) -> None:
        path = plain_folder(tmp_path / "m", lambda at, _: f"{at:03d}.png")
        for file in (path / "left").iterdir():
            file.write_text("nothing")
        with pytest.raises(SequenceError, match="not a readable image") as raised:
            list(open_drive(path))
        assert "drive.skip_bad" not in str(raised.value)

    @pytest.mark.parametrize(
        ("stamp", "unit"),
        [("1718000000000", "milliseconds"), ("1718000000000000", "microseconds")],
    )
    def test_the_unit_of_stamps_is_asked_for(self, tmp_path, stamp: str, unit: str) -> None:
        path = plain_folder(tmp_path / "m", lambda at, _: f"{at:03d}.png")
        (path / "times.txt").write_text(f"{stamp}\n" * PAIRS)
        with pytest.raises(SequenceError, match=f"is it in {unit}"):
            open_drive(path)

    def test_names_in_milliseconds(self, tmp_path) -> None:
        path = plain_folder(tmp_path / "m", lambda at, _: f"{1_718_000_000_000 + 100 * at}.png")
        (path / "times.txt").unlink()
        with pytest.raises(SequenceError, match=r"stamps in ms.*append 000000"):
            open_drive(path)

    def test_a_missing_calibration_names_the_option_and_a_template(self, tmp_path) -> None:
        path = plain_folder(tmp_path / "m", lambda at, _: f"{at:03d}.png")
        (path / "calibration.toml").unlink()
        with pytest.raises(CalibrationError, match="--calibration FILE") as raised:
            open_drive(path)
        # The template is a calibration, once it has the numbers of these images.
        template = str(raised.value).split("\n", 1)[1]
        given = template.replace("1226", str(WIDTH)).replace("370", str(HEIGHT))
        given = given.replace("601.9", "23.5").replace("183.1", "15.5")
        (path / "calibration.toml").write_text(given)
        assert len(list(open_drive(path))) == PAIRS


@pytest.mark.parametrize("name", ["street.mp4", "my drive.AVI"])
def test_a_video_names_the_command_that_extracts_its_frames(tmp_path, name: str) -> None:
    (tmp_path / name).write_bytes(b"video")
    with pytest.raises(SequenceError, match=r"(?s)is a video.*ffmpeg -i .*/both/%06d\.png"):
        open_drive(tmp_path / name)


def test_a_folder_of_images_names_the_layout(tmp_path) -> None:
    (tmp_path / "x").mkdir()
    cv2.imwrite(str(tmp_path / "x" / "0.png"), PICTURES[0][1])
    with pytest.raises(SequenceError, match=r"(?s)into left/.*both/.*times\.txt.*\[rectified\]"):
        open_drive(tmp_path / "x")
