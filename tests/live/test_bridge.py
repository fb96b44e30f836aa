"""The parts of the ROS 2 bridge that need no ROS: images, pairs, frames, and the watchdog."""

from __future__ import annotations

import ast
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Queue
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import engram.live.link
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.localiser.localisation import LocalisationStatus
from engram.robot.mapping import map_drive
from engram.sequences.bags.topics import IMAGE, StereoTopics, info_topics, stereo_topics
from engram.sequences.opening import open_drive

PACKAGE = Path(__file__).parents[2] / "ros" / "engram_bridge"
if not PACKAGE.exists():
    pytest.skip("the bridge is not part of this checkout", allow_module_level=True)
sys.path.insert(0, str(PACKAGE))

from engram_bridge import images, rigid  # noqa: E402
from engram_bridge.asking import Asking  # noqa: E402
from engram_bridge.belief import Belief  # noqa: E402
from engram_bridge.fixes import fix_of  # noqa: E402
from engram_bridge.frames import StaticFrames  # noqa: E402
from engram_bridge.gyro import Gyro  # noqa: E402
from engram_bridge.pairs import Pairs  # noqa: E402
from engram_bridge.parameters import PARAMETERS, checked, image_topic, live_command  # noqa: E402
from engram_bridge.supervisor import Supervisor  # noqa: E402
from engram_bridge.troubles import Troubles  # noqa: E402
from engram_bridge.wheels import Wheels  # noqa: E402

TWIST = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6)
LIVE = [sys.executable, "-c", "from engram.cli import main; main()", "live"]


def image(encoding: str, rows: np.ndarray, pad: int = 0) -> Any:
    """A sensor_msgs/Image, with padding at the end of each row."""
    height, width = rows.shape[:2]
    flat = rows.reshape(height, -1).view(np.uint8)
    padded = np.pad(flat, ((0, 0), (0, pad)))
    return SimpleNamespace(
        encoding=encoding,
        height=height,
        width=width,
        step=padded.shape[1],
        data=padded.tobytes(),
        is_bigendian=0,
    )


def test_the_link_is_the_same_file() -> None:
    ours = Path(str(engram.live.link.__file__))  # of an installed package, maybe
    assert (PACKAGE / "engram_bridge" / "link.py").read_bytes() == ours.read_bytes()


def test_it_runs_on_python_3_8() -> None:
    for path in (PACKAGE / "engram_bridge").glob("*.py"):
        ast.parse(path.read_text(), feature_version=(3, 8))


@pytest.mark.parametrize("pad", [0, 3])
def test_grey_and_coloured_images(pad: int) -> None:
    colours = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    wanted = cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY)
    assert (
        np.abs(images.grey(image("rgb8", colours, pad), images.Depth()).astype(int) - wanted).max()
        <= 1
    )
    assert (
        np.abs(
            images.grey(image("bgr8", colours[..., ::-1].copy(), pad), images.Depth()).astype(int)
            - wanted
        ).max()
        <= 1
    )
    np.testing.assert_array_equal(images.grey(image("mono8", wanted, pad), images.Depth()), wanted)
    ten_bits = wanted.astype(np.uint16) << 2 | 3
    ten_bits[0, 0] = 1023
    found = images.grey(image("mono16", ten_bits, 2 * pad), images.Depth())
    np.testing.assert_array_equal(found[1:], wanted[1:])


def test_the_brightness_of_16_bit_images_does_not_flicker() -> None:
    depth = images.Depth()
    bright = np.full((5, 7), 4000, np.uint16)
    dim = np.full((5, 7), 500, np.uint16)
    assert images.grey(image("mono16", bright), depth).max() == 4000 >> 4
    assert images.grey(image("mono16", dim), depth).max() == 500 >> 4


def test_images_that_cannot_be_used_say_why() -> None:
    with pytest.raises(images.ImageError, match="'32FC1' of a 7 × 5"):
        images.grey(image("32FC1", np.zeros((5, 7, 4), np.uint8)), images.Depth())
    short = image("mono8", np.zeros((5, 7), np.uint8))
    short.data = short.data[:-1]
    with pytest.raises(images.ImageError, match="34 bytes"):
        images.grey(short, images.Depth())
    with pytest.raises(images.ImageError, match="cannot be decoded"):
        images.uncompressed(SimpleNamespace(format="png", data=b"none"))


def test_compressed_images() -> None:
    grey = np.random.default_rng(0).integers(0, 256, (5, 7), np.uint8)
    data = cv2.imencode(".png", grey)[1].tobytes()
    np.testing.assert_array_equal(
        images.uncompressed(SimpleNamespace(format="png", data=data)), grey
    )


def test_pairs_are_of_one_instant() -> None:
    pairs = Pairs(tolerance_ns=2)
    assert pairs.add(0, 100, "l100") is None
    assert pairs.add(1, 103, "r103") is None
    assert pairs.add(1, 101, "r101") == (100, "l100", "r101")
    assert pairs.add(0, 104, "l104") == (104, "l104", "r103")
    assert pairs.single == 0


def test_images_without_a_partner_do_not_pile_up() -> None:
    pairs = Pairs(tolerance_ns=2, waiting=3)
    for stamp in range(0, 1000, 10):
        assert pairs.add(0, stamp, stamp) is None
    assert pairs.single == 97


@given(TWIST)
def test_transforms_agree_with_engrams(twist: list[float]) -> None:
    a_from_b = SE3.exp(twist)
    matrix = a_from_b.matrix()
    np.testing.assert_allclose(rigid.inverse(matrix), a_from_b.inverse().matrix(), atol=1e-12)
    np.testing.assert_allclose(rigid.adjoint(matrix), a_from_b.adjoint(), atol=1e-12)
    x, y, z, w = rigid.quaternion(matrix)
    again = SE3.from_quaternion([w, x, y, z], matrix[:3, 3])
    np.testing.assert_allclose(again.matrix(), matrix, atol=1e-9)


def test_roll_pitch_yaw_are_those_of_urdf() -> None:
    """The usual optical frame: x right, y down, z ahead on a robot whose x is ahead."""
    optical = rigid.of_xyz_rpy([1.0, 2.0, 3.0, -np.pi / 2, 0.0, -np.pi / 2])
    np.testing.assert_allclose(optical @ [0, 0, 1, 1], [2.0, 2.0, 3.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(optical @ [1, 0, 0, 1], [1.0, 1.0, 3.0, 1.0], atol=1e-12)


@given(TWIST)
def test_ros_states_covariance_at_the_childs_origin(twist: list[float]) -> None:
    """Of position and rotation errors around b itself: turning it does not move it."""
    a_from_b = SE3.exp(twist)
    only_turns = np.zeros((6, 6))
    only_turns[3:, 3:] = np.eye(3)
    shift = SE3(np.eye(3), a_from_b.translation).adjoint()
    moved = rigid.at_its_own_origin(a_from_b.matrix(), shift @ only_turns @ shift.T)
    np.testing.assert_allclose(moved, only_turns, atol=1e-9)


def test_the_wheels_pose_at_the_time_of_an_image() -> None:
    """A robot that drives a circle with 1 m/s and 0.2 rad/s, reported at 50 Hz."""
    wheels = Wheels()

    def circle(seconds: float) -> SE3:
        return SE3.exp(seconds * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.2]))

    assert wheels.at(0) is None
    for number in range(50):
        w, x, y, z = circle(number / 50).quaternion_wxyz()
        wheels.add(number * 20_000_000, circle(number / 50).translation, [x, y, z, w])
    for seconds in (0.5, 0.513, 0.995):
        matrix = wheels.at(int(seconds * 1e9))
        np.testing.assert_allclose(matrix, circle(seconds).matrix(), atol=1e-4)
    assert wheels.at(int(1.2e9)) is None
    wheels.add(0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    assert wheels.at(10) is None, "the clock went back"


def test_the_turn_of_a_gyroscope_at_the_time_of_an_image() -> None:
    """200 Hz around an axis that turns with the robot; then a pause, and on."""
    gyro, rates = Gyro(), np.array([0.1, -0.2, 0.6])

    def turned(seconds: float) -> np.ndarray:
        return SE3.exp(np.r_[np.zeros(3), seconds * rates]).rotation

    def add(first: int, last: int) -> None:
        for number in range(first, last):
            gyro.add(number * 5_000_000, rates)

    add(0, 200)
    for seconds in (0.5, 0.7512, 1.001):
        matrix = gyro.at(int(seconds * 1e9))
        np.testing.assert_allclose(matrix[:3, :3], turned(seconds), atol=1e-5)
    add(240, 300)
    np.testing.assert_allclose(gyro.at(1_495_000_000)[:3, :3], turned(1.495), atol=1e-5)
    add(500, 600)
    assert gyro.at(2_600_000_000) is None, "nobody knows how it turned in the pause"
    assert gyro.at(2_650_000_000) is not None
    assert gyro.at(4_000_000_000) is None


@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_a_rotation_vector_is_that_of_engram(vector: list[float]) -> None:
    wanted = SE3.exp([0.0, 0.0, 0.0, *vector]).matrix()
    np.testing.assert_allclose(rigid.of_turn(vector), wanted, atol=1e-9)


def test_fixes_of_satellites() -> None:
    message = SimpleNamespace(
        latitude=50.0,
        longitude=14.0,
        status=SimpleNamespace(status=0),
        position_covariance=[4.0, 0, 0, 0, 9.0, 0, 0, 0, 1.0],
        position_covariance_type=2,
    )
    at = {"stamp_ns": 7, "latitude_deg": 50.0, "longitude_deg": 14.0}
    assert fix_of(message, 7) == {**at, "sigma_m": 3.0}
    message.position_covariance_type = 0
    assert fix_of(message, 7) == at
    message.status.status = -1
    assert fix_of(message, 7) is None


PLACED = {LocalisationStatus.LOCALISED, LocalisationStatus.DEAD_RECKONING}
BASE_FROM_CAMERA = rigid.of_xyz_rpy([0.5, 0.1, 1.2, -np.pi / 2, 0.0, -np.pi / 2])


def seen(
    stamp_ns: int, ahead_m: float, status: str = "lost", map_from_live: SE3 | None = None
) -> dict[str, Any]:
    message: dict[str, Any] = {
        "is": "seen",
        "stamp_ns": stamp_ns,
        "status": status,
        "odom_from_live": SE3(np.eye(3), np.array([0.0, 0.0, ahead_m])).matrix().ravel().tolist(),
        "odom_covariance": (np.eye(6) * 0.01 * ahead_m).ravel().tolist(),
    }
    if map_from_live is not None:
        message["map_from_live"] = map_from_live.matrix().ravel().tolist()
        message["map_covariance"] = (np.eye(6) * 0.01).ravel().tolist()
    return message


def test_odometry_does_not_jump_when_the_process_is_started_again() -> None:
    belief = Belief(BASE_FROM_CAMERA)
    for metre in range(4):
        belief.hear(seen(metre, float(metre)), 0.0)
    np.testing.assert_allclose(belief.odom_from_base[:3, 3], [3.0, 0.0, 0.0], atol=1e-12)
    spread = np.trace(belief.odom_covariance)
    belief.began()
    belief.hear(seen(4, 0.0), 0.0)
    np.testing.assert_allclose(belief.odom_from_base[:3, 3], [3.0, 0.0, 0.0], atol=1e-12)
    belief.hear(seen(5, 1.0), 0.0)
    np.testing.assert_allclose(belief.odom_from_base[:3, 3], [4.0, 0.0, 0.0], atol=1e-12)
    assert np.trace(belief.odom_covariance) > spread


def test_the_map_corrects_and_stays_while_nothing_is_seen() -> None:
    belief = Belief(BASE_FROM_CAMERA)
    belief.hear(seen(0, 0.0), 0.0)
    assert belief.map_from_odom is None
    assert belief.map_pose is None
    map_from_base = np.eye(4)
    map_from_base[:3, 3] = 10.0, 20.0, 0.0
    map_from_live = SE3.from_matrix(map_from_base @ BASE_FROM_CAMERA)
    belief.hear(seen(1, 1.0, "localised", map_from_live), 0.0)
    kept = belief.map_from_odom
    np.testing.assert_allclose((kept @ belief.odom_from_base)[:3, 3], [10.0, 20.0, 0.0], atol=1e-9)
    assert belief.map_pose is not None
    belief.hear(seen(2, 2.0, LocalisationStatus.DEAD_RECKONING, map_from_live), 0.0)
    assert belief.map_pose is not None, "carried on by odometry, with its covariance"
    unplaced = [one for one in LocalisationStatus if one not in PLACED]
    for ahead in range(3, 40):
        status = unplaced[ahead % len(unplaced)]
        belief.hear(seen(ahead, float(ahead), status, map_from_live), 0.0)
        assert belief.map_pose is None, "no pose of a lost robot"
    np.testing.assert_array_equal(belief.map_from_odom, kept)


def test_a_late_frame_changes_nothing_and_a_clock_set_back_forgets_the_correction() -> None:
    belief = Belief(BASE_FROM_CAMERA)
    now_ns = 10**12
    belief.hear(seen(now_ns, 1.0, "localised", SE3.identity()), 0.0)
    kept = belief.map_from_odom
    assert not belief.hear(seen(now_ns - 10**8, 9.0), 0.0)
    assert belief.map_from_odom is kept
    assert belief.stamp_ns == now_ns
    before = belief.odom_from_base
    for wrong_ns in (0, now_ns + 10**13):
        assert not belief.hear({**seen(wrong_ns, 9.0), "left_out": True}, 0.0)
        assert belief.stamp_ns == now_ns
    assert belief.map_from_odom is kept
    assert belief.hear(seen(now_ns - 10**10, 1.0), 0.0)
    assert belief.map_from_odom is None
    np.testing.assert_allclose(belief.odom_from_base, before, atol=1e-12)


def test_what_nobody_watched_makes_odometry_less_certain() -> None:
    """At 10 m/s, a process that is away for two seconds misses twenty metres."""
    belief = Belief(BASE_FROM_CAMERA)
    for tenth in range(5):
        belief.hear(seen(tenth * 10**8, float(tenth)), 0.0)
    belief.began()
    belief.hear(seen(24 * 10**8, 0.0), 0.0)
    assert np.sqrt(belief.odom_covariance[0, 0]) == pytest.approx(20.0, rel=0.1)


def test_nothing_moves_before_the_mounting_is_known() -> None:
    belief = Belief()
    assert not belief.hear(seen(0, 0.0, "localised", SE3.identity()), 0.0)
    assert belief.map_pose is None
    belief.mount(BASE_FROM_CAMERA)
    assert belief.hear(seen(1, 1.0, "localised", SE3.identity()), 0.0)
    assert belief.map_pose is not None


def test_the_mounting_is_found_over_the_tree_of_fixed_frames() -> None:
    frames, upright = StaticFrames(), [0.0, 0.0, 0.0, 1.0]
    frames.add("base_link", "mast", [0.0, 0.0, 1.0], upright)
    frames.add("/mast", "optical", [0.5, 0.0, 0.0], [-0.5, 0.5, -0.5, 0.5])
    frames.add("chassis", "base_link", [9.0, 9.0, 9.0], upright)
    frames.add("chassis", "lidar", [9.0, 9.0, 11.0], upright)
    found = frames.between("base_link", "/optical")
    np.testing.assert_allclose(found @ [0, 0, 2, 1], [2.5, 0, 1, 1], atol=1e-12)
    np.testing.assert_allclose(frames.between("base_link", "lidar")[:3, 3], [0, 0, 2], atol=1e-12)
    assert frames.between("base_link", "nowhere") is None
    frames.add("optical", "chassis", [0.0, 0.0, 0.0], upright)
    assert frames.between("nowhere", "optical") is None, "a circle ends"
    with pytest.raises(ValueError, match="not finite"):
        frames.add("a", "b", [np.nan, 0.0, 0.0], upright)


def test_each_command_is_answered_once() -> None:
    sent: list[dict[str, Any]] = []
    asking = Asking(lambda message: sent.append(message) or len(sent) < 3)
    answers: list[tuple[bool, str]] = []
    asking.ask({"do": "save"}, lambda *answer: answers.append(answer))
    asking.ask({"do": "map", "on": True}, lambda *answer: answers.append(answer))
    assert asking.hear({"id": sent[0]["id"], "ok": True, "text": "revision 3"})
    assert not asking.hear({"id": sent[0]["id"], "ok": True, "text": "again"})
    asking.gone()
    assert answers == [(True, "revision 3"), (False, "engram live ended before it answered")]
    done, text = asking.wait({"do": "save"}, 1.0)
    assert not done
    assert "not connected" in text


def test_troubles_name_the_inputs_that_never_come() -> None:
    now, logged = [0.0], []
    troubles = Troubles(SimpleNamespace(warning=logged.append), lambda: now[0])
    troubles.expect(0, "l/image", "l/info")
    troubles.expect(1, "r/image", "r/info")
    assert troubles.text(waiting=True) == "", "they have had no time yet"
    now[0] = 2.0
    for _ in range(3):
        troubles.saw_image(0)
        troubles.saw_info(0)
        troubles.saw_info(1)
    assert troubles.text(waiting=True) == "nothing came on r/image yet"
    troubles.saw_image(1)
    assert "3 left and 1 right" in troubles.text(waiting=True)
    troubles.saw_pair()
    assert troubles.text(waiting=True) == ""
    troubles.add("a", "the disk burns")
    troubles.add("a", "the disk burns")
    assert logged == ["the disk burns"]
    assert troubles.text(waiting=False) == "the disk burns"
    now[0] = 20.0
    assert troubles.text(waiting=False) == ""


def test_parameters_make_the_command_and_are_checked() -> None:
    given = checked({**PARAMETERS, "map": "/m.engram", "mapping": True, "settings": ["", "a=1"]})
    command = live_command(given)
    assert command[:3] == ["engram", "live", "/m.engram"]
    assert command[-4:] == ["--deadline", "40.0", "--set", "a=1"]
    assert image_topic(given, "left") == ("left/image_rect", False)
    assert image_topic({**given, "compressed": True}, "left")[0] == "left/image_rect/compressed"
    assert image_topic({**given, "left": "a/compressed"}, "left") == ("a/compressed", True)
    for wrong in ({"map": ""}, {"map": "m", "base_from_camera": [1.0, 2.0]}, {"status_rate": 0.0}):
        with pytest.raises(ValueError, match=r"map is empty|has 2 numbers|above 0"):
            checked({**PARAMETERS, "map": "m", **wrong})


def test_the_files_parameters_are_the_nodes() -> None:
    """`config/engram.yaml` shows each parameter with its default."""
    lines = (PACKAGE / "config" / "engram.yaml").read_text().splitlines()
    named = [line.split(":")[0].strip() for line in lines if line.startswith("    ")]
    assert sorted(named) == sorted(PARAMETERS)


def test_the_launch_file_starts_the_installed_program_with_known_parameters(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`launch` comes with ROS only: stand-ins record what the file asks of it."""
    for name, held in {
        "ament_index_python.packages": {"get_package_share_directory": lambda _: str(PACKAGE)},
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": lambda *a, **k: ("argument", a, k)},
        "launch.substitutions": {"LaunchConfiguration": lambda name: name},
        "launch_ros.actions": {"Node": lambda **k: ("node", (), k)},
    }.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**held))
    made = runpy.run_path(str(PACKAGE / "launch" / "engram.launch.py"))[
        "generate_launch_description"
    ]()
    arguments = {names[0]: given for kind, names, given in made if kind == "argument"}
    (node,) = (given for kind, _, given in made if kind == "node")
    assert Path(arguments["config"]["default_value"]).is_file()
    assert f"{node['executable']} = engram_bridge.node:main" in (PACKAGE / "setup.py").read_text()
    assert set(node["parameters"][1]) <= set(PARAMETERS)
    assert set(node["parameters"][1]) <= set(arguments)


class _Chosen:
    """A launch configuration, as `launch` resolves it in a context."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


@pytest.mark.parametrize("camera", ["realsense", "zed", "oak"])
def test_each_camera_starts_with_topics_that_the_bridge_and_the_reader_know(
    monkeypatch: pytest.MonkeyPatch, camera: str
) -> None:
    """Topics and parameters are the drivers' by their sources; no camera was at hand."""
    for name, held in {
        "ament_index_python.packages": {
            "get_package_share_directory": lambda one: str(
                PACKAGE if one == "engram_bridge" else Path("/drivers") / one
            )
        },
        "launch": {"LaunchDescription": list},
        "launch.actions": {
            "DeclareLaunchArgument": lambda name, **k: name,
            "GroupAction": lambda actions: actions[-1],
            "IncludeLaunchDescription": lambda file, launch_arguments: (
                Path(file),
                dict(launch_arguments),
            ),
            "OpaqueFunction": lambda function: function,
        },
        "launch.launch_description_sources": {"PythonLaunchDescriptionSource": lambda file: file},
        "launch.substitutions": {"LaunchConfiguration": _Chosen},
        "launch_ros.actions": {"SetParameter": lambda **k: k},
    }.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**held))
    made = runpy.run_path(str(PACKAGE / "launch" / "camera.launch.py"))
    *arguments, starts = made["generate_launch_description"]()
    context = {**dict.fromkeys(arguments, ""), "camera": camera}
    (driver, given), (bridge, to_bridge) = starts(context)
    assert driver.parts[1:3] == ("drivers", made["DRIVERS"][camera][0])
    files = [Path(one) for one in given.values() if one.endswith(".yaml")]
    assert all(yaml.safe_load(one.read_text()) for one in files)
    assert bridge.is_file()
    assert set(to_bridge) <= {"map", "mapping", "config"} <= set(arguments)
    parameters = yaml.safe_load(Path(to_bridge["config"]).read_text())["engram"]["ros__parameters"]
    assert set(parameters) <= set(PARAMETERS)
    left, right = parameters["left"], parameters["right"]
    found = stereo_topics(dict.fromkeys((left, right), SimpleNamespace(type=IMAGE, count=1)))
    assert (found.left, found.right) == (left, right)
    assert found.are_rectified
    infos = info_topics(found, (parameters["left_info"], parameters["right_info"]))
    assert infos == StereoTopics(parameters["left_info"], parameters["right_info"])


def test_the_report_never_pretends() -> None:
    belief = Belief(BASE_FROM_CAMERA)
    assert belief.report(0.0)[:2] == (2, "engram live has said nothing yet")
    belief.hear({"is": "alive", "status": "localised", "trouble": ""}, 1.0)
    assert belief.report(1.1)[:2] == (0, "localised")
    assert belief.report(2.5)[0] == 2
    belief.hear({"is": "alive", "status": "no images", "trouble": ""}, 3.0)
    assert belief.report(3.1)[:2] == (2, "no images")
    belief.began()
    assert belief.report(3.1)[:2] == (1, "starting"), "what the old process said is not said again"
    belief.hear({"is": "alive", "status": "lost", "trouble": ""}, 3.0)
    assert belief.report(3.1)[:2] == (1, "lost")


class Watched:
    """A supervisor, and what it hears."""

    def __init__(self, command: list[str]) -> None:
        self.heard: Queue[dict[str, Any]] = Queue()
        self.said: Queue[str] = Queue()
        self.supervisor = Supervisor(command, self.heard.put, self.said.put)
        self.supervisor.start()

    def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        for _ in range(2_000):
            message = self.heard.get(timeout=60)
            if wanted(message):
                return message
        raise AssertionError("it was never said")

    def seen(self, pair: StereoPair) -> dict[str, Any]:
        assert self.supervisor.show(pair.stamp_ns, pair.left, pair.right)
        return self.until(lambda one: one["is"] == "seen" and one["stamp_ns"] == pair.stamp_ns)


@pytest.fixture(scope="module")
def pairs(street: Path) -> list[StereoPair]:
    return list(open_drive(street))[:6]  # type: ignore[arg-type]


@pytest.fixture
def watched(street: Path, tmp_path: Path) -> Iterator[Watched]:
    path = tmp_path / "street.engram"
    map_drive(path, open_drive(street, frames="0:12:2"))
    made = Watched([*LIVE, str(path), "--set", "drive.lanes=1", "--set", "drive.rounds=4"])
    yield made
    made.supervisor.close()


def test_a_killed_process_is_started_again_with_its_last_belief(
    watched: Watched, pairs: list[StereoPair]
) -> None:
    watched.until(lambda one: one["is"] == "alive")
    camera = pairs[0].camera
    names = ("fx", "fy", "cx", "cy", "baseline_m", "width", "height")
    said = {name: getattr(camera, name) for name in names}
    watched.supervisor.see(said, camera.width, camera.height)
    found = [watched.seen(pair) for pair in pairs[:4]]
    assert found[-1]["status"] == "localised"
    os.kill(watched.supervisor.pid, signal.SIGKILL)
    watched.until(lambda one: one["is"] == "hello")
    reply = watched.until(lambda one: one["is"] == "reply" and one["do"] == "place")
    assert reply["ok"], reply
    assert watched.seen(pairs[4])["status"] == "localised"
    assert "ended with -9" in watched.said.get(timeout=10)
    assert watched.supervisor.restarts == 1


def test_a_process_that_cannot_start_is_reported_and_tried_again() -> None:
    watched = Watched([sys.executable, "-c", "import sys; sys.exit('no such map')"])
    assert "ended with 1. no such map" in watched.said.get(timeout=30)
    assert "ended with 1" in watched.said.get(timeout=30)
    watched.supervisor.close()


def test_a_process_that_hangs_is_killed() -> None:
    """It listens and never says anything."""
    hangs = (
        "import socket, sys, threading\n"
        "s = socket.socket(socket.AF_UNIX); s.bind(sys.argv[-1]); s.listen(1)\n"
        "threading.Event().wait()\n"
    )
    watched = Watched([sys.executable, "-c", hangs])
    assert "said nothing for 1.0 s" in watched.said.get(timeout=60)
    assert "ended with -9" in watched.said.get(timeout=60)
    watched.supervisor.close()


def test_memory_of_images_is_kept() -> None:
    """A process that keeps memory asks the kernel for no new pages for each image."""
    program = (
        "import resource, sys\nfrom engram_bridge.memory import keep_memory\n"
        "if len(sys.argv) > 1: assert keep_memory()\n"
        "def faults(): return resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "def take(): [b'x' * 307_200 for _ in range(4)]\n"
        "take(); take(); began = faults()\n"
        "for _ in range(50): take()\n"
        "print(faults() - began)"
    )
    faults = []
    for given_ in ((), ("keep",)):
        ran = subprocess.run(
            [sys.executable, "-c", program, *given_],
            env={**os.environ, "PYTHONPATH": str(PACKAGE)},
            capture_output=True,
            check=True,
        )
        faults.append(int(ran.stdout))
    assert faults[1] < 0.05 * faults[0], faults
