"""Motion from outside as files and topics: what is read, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from engram.errors import SequenceError
from engram.geometry.se3 import SE3
from engram.sequences.bags.bag_sequence import describe_bag
from engram.sequences.motion_files import FORWARD, read_samples
from engram.sequences.opening import open_drive

from .bag_maker import KINDS, LEFT, RIGHT, bag, made, rectified_infos
from .synthetic import LAYOUTS, PAIRS, PERIOD_NS, START_NS, camera, picture, stamp_ns

SPEED_M_S, TURN_RAD_S = 5.0, 0.4


def expected(seconds: float) -> SE3:
    """The camera's motion: forward, turning left, as the rig does."""
    rig = SE3.exp(np.array([SPEED_M_S, 0, 0, 0, 0, TURN_RAD_S]) * seconds)
    return FORWARD @ rig @ FORWARD.inverse()


def assert_moves(motion, shift_ns: int = 0) -> None:
    source = motion
    for index in range(1, PAIRS):
        start, end = stamp_ns(index - 1) + shift_ns, stamp_ns(index) + shift_ns
        found = source.between(start, end)
        assert found is not None
        assert found.seconds == pytest.approx(PERIOD_NS / 1e9)
        error = found.prev_from_curr.inverse() @ expected(found.seconds)
        np.testing.assert_allclose(error.matrix(), np.eye(4), atol=1e-6)


def samples(first_ns: int = START_NS - 10**8, count: int = 40, every_ns: int = 20_000_000):
    return [first_ns + index * every_ns for index in range(count)]


def write_wheels(path: Path) -> Path:
    rows = [f"{stamp},{SPEED_M_S},{TURN_RAD_S}" for stamp in samples()]
    path.write_text("\n".join(["stamp_ns,forward_m_s,turn_rad_s", *rows]) + "\n")
    return path


def write_poses(path: Path) -> Path:
    lines = []
    for stamp in samples():
        rig = SE3.exp(np.array([SPEED_M_S, 0, 0, 0, 0, TURN_RAD_S]) * ((stamp - START_NS) / 1e9))
        w, x, y, z = rig.quaternion_wxyz()
        numbers = (*rig.translation, x, y, z, w)
        lines.append(
            f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(f"{one:.12f}" for one in numbers)
        )
    path.write_text("\n".join(lines) + "\n")
    return path


HOUR_NS = 3600 * 10**9
# What happens to the clock of the motion alone, at the tenth of its forty samples.
CLOCKS: dict[str, Callable[[int, int], int]] = {
    "one zero": lambda number, stamp: 0 if number == 10 else stamp,
    "one ahead": lambda number, stamp: stamp + HOUR_NS * (number == 10),
    "set back": lambda number, stamp: stamp - HOUR_NS * (number >= 10),
    "set back twice": lambda number, stamp: stamp - HOUR_NS * ((number >= 10) + (number >= 20)),
    "set forwards and back": lambda number, stamp: stamp + HOUR_NS * (10 <= number < 13),
}


class TestFiles:
    @pytest.mark.parametrize("clock", [name for name in CLOCKS if "forwards" not in name])
    def test_a_wrong_clock_costs_a_sample_and_is_told(self, tmp_path, clock) -> None:
        file = tmp_path / "wheels.csv"
        stamps = [CLOCKS[clock](*one) for one in enumerate(samples())]
        rows = [f"{stamp},{SPEED_M_S},{TURN_RAD_S}" for stamp in stamps]
        file.write_text("\n".join(["stamp_ns,forward_m_s,turn_rad_s", *rows]) + "\n")
        drive = open_drive(LAYOUTS["folder"].write(tmp_path), motion=[str(file)])
        assert_moves(drive.motion())
        assert any(str(file) in fact for fact in drive.stamp_facts)

    @pytest.mark.parametrize("write", [write_wheels, write_poses])
    def test_speeds_and_poses_give_the_cameras_motion(self, tmp_path, write) -> None:
        name = "wheels.csv" if write is write_wheels else "wheels.tum"
        file = write(tmp_path / name)
        path = LAYOUTS["folder"].write(tmp_path)
        assert_moves(open_drive(path, motion=[str(file)]).motion())

    def test_a_gyroscope_in_eurocs_form_gives_turns(self, tmp_path) -> None:
        file = tmp_path / "imu.csv"
        head = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a"
        rows = [f"{stamp},0.0,0.0,{TURN_RAD_S},9.81" for stamp in samples()]
        file.write_text("\n".join([head, *rows]) + "\n")
        path = LAYOUTS["folder"].write(tmp_path)
        motion = open_drive(path, motion=[str(file)]).motion()
        assert motion is not None
        found = motion.between(stamp_ns(0), stamp_ns(1))
        assert found is not None
        assert not found.has_way
        np.testing.assert_allclose(found.rates_rad_s, [0, -TURN_RAD_S, 0], atol=1e-9)

    def test_a_gap_in_it_is_no_motion(self, tmp_path) -> None:
        file = tmp_path / "wheels.csv"
        stamps = [stamp for stamp in samples() if not stamp_ns(1) < stamp < stamp_ns(1) + 10**9]
        rows = [f"{stamp},{SPEED_M_S}" for stamp in stamps]
        file.write_text("\n".join(["stamp_ns,forward_m_s", *rows]) + "\n")
        path = LAYOUTS["folder"].write(tmp_path)
        motion = open_drive(path, motion=[str(file)]).motion()
        assert motion is not None
        assert motion.between(stamp_ns(0), stamp_ns(1)) is not None
        assert motion.between(stamp_ns(1), stamp_ns(2)) is None

    def test_it_follows_a_drive_whose_start_is_given(self, tmp_path) -> None:
        path = LAYOUTS["kitti"].write(tmp_path)  # whose clock begins at 0
        file = tmp_path / "wheels.csv"
        rows = [
            f"{(stamp - START_NS + 10**9) / 1e9:.9f},{SPEED_M_S},{TURN_RAD_S}"
            for stamp in samples(START_NS - 10**9, 100)
        ]
        file.write_text("\n".join(["seconds,forward_m_s,turn_rad_s", *rows]) + "\n")
        drive = open_drive(path, motion=[str(file)], recorded_at=START_NS)
        assert_moves(drive.motion())

    @pytest.mark.parametrize(
        ("text", "fact"),
        [
            ("", "first line must name the columns"),
            ("stamp_ns,speed\n1,2\n", "first line must name the columns"),
            ("stamp_ns,forward_m_s\n", "holds no motion"),
            ("stamp_ns,forward_m_s\n5,nan\n", "line 2"),
            ("stamp_ns,forward_m_s\n5,1\n4,1\n", "stamps do not increase"),
        ],
    )
    def test_what_cannot_be_used_is_said_at_once(self, tmp_path, text, fact) -> None:
        file = tmp_path / "wheels.csv"
        file.write_text(text)
        with pytest.raises(SequenceError, match=fact):
            read_samples(file)
        with pytest.raises(SequenceError, match=fact):
            open_drive(LAYOUTS["folder"].write(tmp_path), motion=[str(file)])

    def test_two_of_a_kind(self, tmp_path) -> None:
        file = write_wheels(tmp_path / "wheels.csv")
        with pytest.raises(SequenceError, match="second odometry"):
            open_drive(LAYOUTS["folder"].write(tmp_path), motion=[str(file)] * 2)


class TestTopics:
    @pytest.fixture(params=KINDS)
    def path(self, request, tmp_path) -> Path:
        with bag(tmp_path / "b", request.param) as maker:
            for side, topic in enumerate((LEFT, RIGHT)):
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
            for index in range(PAIRS):
                for side, topic in enumerate((LEFT, RIGHT)):
                    maker.image(topic, stamp_ns(index), picture(index, side))
            for stamp in samples():
                maker.odometry("/odom", stamp, SPEED_M_S, TURN_RAD_S)
                maker.imu("/imu/data", stamp, (0.0, 0.0, TURN_RAD_S + 0.01))
            maker.transform(START_NS, "base_link", "imu_link", SE3.identity())
        return made(tmp_path / "b", request.param)

    @pytest.mark.parametrize("clock", CLOCKS)
    def test_a_wrong_clock_costs_a_message_and_is_told(self, tmp_path, clock) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            for side, topic in enumerate((LEFT, RIGHT)):
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
                for index in range(PAIRS):
                    maker.image(topic, stamp_ns(index), picture(index, side))
            for number, stamp in enumerate(samples()):
                wrong = CLOCKS[clock](number, stamp)
                maker.odometry("/odom", wrong, SPEED_M_S, TURN_RAD_S, received_ns=stamp)
        drive = open_drive(made(tmp_path / "b", "mcap"), motion=["/odom"])
        assert_moves(drive.motion())
        assert any("/odom" in fact for fact in drive.stamp_facts)
        assert any("/odom" in fact for fact in describe_bag(tmp_path / "b").stamps)

    def test_an_odometry_topic_gives_the_cameras_motion(self, path) -> None:
        drive = open_drive(path, motion=["/odom"])
        assert_moves(drive.motion())
        assert_moves(drive.motion())  # a second pass

    def test_what_is_not_finite_is_no_measurement_of_a_robot_at_rest(self, tmp_path) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            for side, topic in enumerate((LEFT, RIGHT)):
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
                for index in range(PAIRS):
                    maker.image(topic, stamp_ns(index), picture(index, side))
            for number, stamp in enumerate(samples()):
                speed_m_s = float("nan") if number % 3 else SPEED_M_S
                maker.twist("/odom", stamp, speed_m_s, TURN_RAD_S)
        drive = open_drive(made(tmp_path / "b", "mcap"), motion=["/odom"])
        assert_moves(drive.motion())

    def test_the_gyroscope_replaces_the_wheels_turn(self, path) -> None:
        motion = open_drive(path, motion=["/odom", "/imu/data"]).motion()
        assert motion is not None
        found = motion.between(stamp_ns(0), stamp_ns(1))
        assert found is not None
        assert found.has_way
        np.testing.assert_allclose(found.rates_rad_s, [0, -TURN_RAD_S - 0.01, 0], atol=1e-9)

    def test_a_wrong_name_lists_the_right_ones(self, path) -> None:
        with pytest.raises(SequenceError, match=r"/wheels: is neither a topic.*/imu/data"):
            open_drive(path, motion=["/wheels"])
        with pytest.raises(SequenceError, match="holds sensor_msgs/msg/Image"):
            open_drive(path, motion=[LEFT])
