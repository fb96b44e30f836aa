"""A live process over each transport: it localises, obeys, survives, and is never silent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import Any, Protocol

import numpy as np
import pytest
from tests.live.in_process import InProcess

from engram.errors import InputError, MapError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.live import process
from engram.live.driving import Driving, LiveOptions, Outside
from engram.live.link import Link, Ring
from engram.live.process import LiveProcess
from engram.live.served import Played, Served
from engram.localiser.localiser import Localiser
from engram.maps.map import Map, open_map
from engram.robot.anchors import add_goal
from engram.robot.mapping import map_drive
from engram.robot.robot import Robot
from engram.robot.settings import RobotOptions
from engram.sequences.opening import open_drive

OPTIONS = RobotOptions(lanes=1, rounds=4)


class Client(Protocol):
    """A robot's middleware."""

    def give(self, pair: StereoPair) -> None: ...
    def ask(self, do: str, **given: Any) -> None: ...
    def hear(self) -> dict[str, Any]: ...


class Caller:
    """The middleware in the same process."""

    def __init__(self) -> None:
        self.heard: Queue[dict[str, Any]] = Queue()
        self.transport = InProcess(self.heard.put)
        self.give, self.ask = self.transport.give, self.transport.ask

    def hear(self) -> dict[str, Any]:
        return self.heard.get(timeout=30)


class Middleware:
    """The middleware at the other end of a socket, with its ring of images."""

    def __init__(self, folder: Path, link: Link | None = None) -> None:
        self.folder, self.ring, self.heard = folder, None, []
        if link is None:
            self.transport = Served(folder / "socket")
            link = Link.connect(str(folder / "socket"))
        self.link = link

    def give(self, pair: StereoPair, **moved: list[float]) -> None:
        if self.ring is None:
            camera = pair.camera
            path = str(self.folder / "ring")
            self.ring = Ring.create(path, camera.width, camera.height)
            names = ("fx", "fy", "cx", "cy", "baseline_m", "width", "height")
            said = {name: getattr(camera, name) for name in names}
            self.link.send({"do": "camera", "ring": path, "camera": said})
        ticket = self.ring.write(pair.stamp_ns, pair.left, pair.right)
        self.link.send({"do": "frame", "ticket": ticket, "stamp_ns": pair.stamp_ns, **moved})

    def ask(self, do: str, **given: Any) -> None:
        self.link.send({"do": do, **given})

    def hear(self) -> dict[str, Any]:
        if not self.heard:
            self.heard = self.link.receive(30)
        return self.heard.pop(0)


@contextmanager
def running(kind: str, folder: Path, options: LiveOptions) -> Iterator[Client]:
    """A live process on its own thread, and its client."""
    client = Caller() if kind == "in process" else Middleware(folder)
    thread = Thread(target=LiveProcess(client.transport, options).run)
    thread.start()
    try:
        yield client
    finally:
        client.ask("stop")
        thread.join(timeout=60)
        assert not thread.is_alive()
        if isinstance(client, Middleware):
            client.transport.__exit__()


def until(client: Client, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first message like this."""
    for _ in range(2_000):
        message = client.hear()
        if wanted(message):
            return message
    raise AssertionError("it was never said")


def seen(client: Client, pair: StereoPair) -> dict[str, Any]:
    client.give(pair)
    return until(client, lambda one: one["is"] == "seen" and one["stamp_ns"] == pair.stamp_ns)


def answered(client: Client, do: str, **given: Any) -> dict[str, Any]:
    client.ask(do, **given)
    return until(client, lambda one: one["is"] == "reply" and one["do"] == do)


@pytest.fixture(scope="module")
def town(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("live") / "street.engram"
    map_drive(path, open_drive(street, frames="::2"))
    return path


@pytest.fixture(scope="module")
def pairs(street: Path) -> list[StereoPair]:
    return list(open_drive(street))[:8]  # type: ignore[arg-type]


@pytest.fixture(params=["in process", "socket"])
def client(request: pytest.FixtureRequest, town: Path, tmp_path: Path) -> Iterator[Client]:
    with running(request.param, tmp_path, LiveOptions(town, robot=OPTIONS)) as one:
        yield one


def test_it_says_where_the_robot_is(client: Client, pairs: list[StereoPair]) -> None:
    found = [seen(client, pair) for pair in pairs]
    assert [one["status"] for one in found].count("localised") >= len(pairs) - 1
    last = found[-1]
    assert np.array(last["covariance"]).shape == (36,)
    assert last["odom_from_live"][11] > 0.5  # metres driven ahead
    assert last["node"]
    first = np.reshape(found[1]["map_from_live"], (4, 4))
    moved = np.reshape(last["map_from_live"], (4, 4))[:3, 3] - first[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(0.8 * (len(pairs) - 2), rel=0.2)
    assert abs(moved[2]) < 0.3, "z is up in the map frame"


def test_it_is_never_silent(client: Client) -> None:
    """Without camera and client's word, it says that it lives, and that nothing comes."""
    for _ in range(3):
        alive = until(client, lambda one: one["is"] == "alive")
        assert alive["status"] == "starting"
        assert alive["age_s"] is None


def test_unknown_and_incomplete_commands_are_answered(client: Client) -> None:
    assert "not a command" in answered(client, "dance")["text"]
    assert "switch needs 'map'" in answered(client, "switch")["text"]
    assert "None is not a str" in answered(client, "switch", map=None)["text"]
    assert "'off' is not a bool" in answered(client, "map", on="off")["text"]
    assert "too large" in answered(client, "here", x_m=10**400, y_m=0, yaw_rad=0)["text"]


def test_a_person_says_where_it_is_and_a_match_decides(
    client: Client, pairs: list[StereoPair]
) -> None:
    assert "no map is open yet" in answered(client, "here", x_m=0, y_m=0, yaw_rad=0)["text"]
    found = [seen(client, pair) for pair in pairs[:4]]
    place = np.reshape(found[-1]["map_from_live"], (4, 4))
    yaw_rad = float(np.arctan2(place[1, 2], place[0, 2]))
    said = {"x_m": place[0, 3] + 1.0, "y_m": place[1, 3], "yaw_rad": yaw_rad}
    assert answered(client, "here", **said)["ok"]
    dark = replace(pairs[4], left=np.zeros_like(pairs[4].left), right=np.zeros_like(pairs[4].left))
    hinted = seen(client, replace(dark, stamp_ns=pairs[4].stamp_ns - 1))
    assert "node" not in hinted, "a hint is no pose"
    assert "map_from_live" not in hinted
    assert seen(client, pairs[4])["status"] == "localised"
    assert "finite" in answered(client, "here", x_m="nan", y_m=0, yaw_rad=0)["text"]


def test_odometry_goes_on_without_a_map(
    client: Client, pairs: list[StereoPair], town: Path
) -> None:
    before = seen(client, pairs[0])
    refused = answered(client, "switch", map=str(town) + ".none")
    assert not refused["ok"]
    assert "no such file" in refused["text"]
    after = seen(client, pairs[1])
    assert after["status"] == "localised"
    assert after["odom_from_live"] != before["odom_from_live"]


def test_switching_to_the_same_map_shows_its_newest_revision(
    pairs: list[StereoPair], town: Path, tmp_path: Path
) -> None:
    path, revisions = tmp_path / "town.engram", []

    class Noting:
        def watch(self, _: Robot, opened: Map) -> None:
            revisions.append(opened.revision)

    path.write_bytes(town.read_bytes())
    driving = Driving(LiveOptions(path, robot=OPTIONS), watcher=Noting())
    driving.step(pairs[0])
    add_goal(path, "dock", 1.0, 0.0, 0.0, author="tests")
    driving.step(pairs[1])
    driving.switch(path)
    assert driving.step(pairs[2]).motion.prev_from_curr.distance_m == pytest.approx(0.8, abs=0.1)
    driving.pause()
    assert revisions == [1, 2]


def test_a_frame_at_which_the_map_failed_keeps_its_motion(
    pairs: list[StereoPair], town: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise MapError("the disk failed")

    driving = Driving(LiveOptions(town, robot=OPTIONS))
    driving.step(pairs[0])
    with monkeypatch.context() as patched:
        patched.setattr(Localiser, "localise", fails)
        failed = driving.step(pairs[1])
    assert failed.trouble == "the disk failed"
    assert failed.motion.prev_from_curr.distance_m == pytest.approx(0.8, abs=0.1)
    driving.pause()


def test_a_drive_goes_on_with_a_clock_that_is_set_back(
    client: Client, pairs: list[StereoPair]
) -> None:
    for pair in pairs[:3]:
        seen(client, replace(pair, stamp_ns=pair.stamp_ns + 10**13))
    left_out = [seen(client, pair) for pair in pairs[3:5]]
    assert {one["status"] for one in left_out} == {"no_odometry"}
    assert "left out" in left_out[0]["trouble"]
    step = seen(client, pairs[5])
    assert "clock went back by 10000.000 s" in step["trouble"]
    assert step["stamp_ns"] == pairs[5].stamp_ns
    late = seen(client, replace(pairs[6], stamp_ns=pairs[5].stamp_ns - 1))
    assert "left out" in late["trouble"]
    after = [seen(client, pair) for pair in pairs[6:8]]
    assert [one["status"] for one in after][-1] == "localised"
    assert after[-1]["trouble"] == ""
    # The way of the frames left out is in the odometry of the next one.
    gone_m = np.array(after[-1]["odom_from_live"]).reshape(4, 4)[:3, 3]
    assert np.linalg.norm(gone_m) == pytest.approx(7 * 0.8, abs=0.1)


def test_it_maps_and_commits(pairs: list[StereoPair], tmp_path: Path) -> None:
    path = tmp_path / "new.engram"
    with running("in process", tmp_path, LiveOptions(path, "r1", maps=True, robot=OPTIONS)) as one:
        for pair in pairs:
            seen(one, pair)
        said = answered(one, "map", on=False)
    assert "revision 1" in said["text"]
    with open_map(path) as opened:
        assert len(opened.graph) > 0


def test_a_missing_map_is_reported_and_odometry_continues(
    pairs: list[StereoPair], tmp_path: Path
) -> None:
    with running("in process", tmp_path, LiveOptions(tmp_path / "no.engram")) as one:
        found = [seen(one, pair) for pair in pairs[:3]]
    assert {message["status"] for message in found} == {"fault"}
    assert "does not exist" in found[0]["trouble"]
    assert found[2]["odom_from_live"][11] > found[1]["odom_from_live"][11]
    assert "covariance" not in found[2]


def test_wheels_carry_the_robot_where_the_camera_sees_nothing(
    town: Path, pairs: list[StereoPair], tmp_path: Path
) -> None:
    """The drive goes straight ahead, 0.8 m a frame, and three frames are dark."""
    dark = np.zeros_like(pairs[0].left)
    with running("in process", tmp_path, LiveOptions(town, robot=OPTIONS)) as one:
        assert isinstance(one, Caller)
        for number, pair in enumerate(pairs):
            blind = number in {4, 5, 6}
            given = replace(pair, left=dark, right=dark) if blind else pair
            ahead = SE3(np.eye(3), np.array([0.0, 0.0, 0.8 * number]))
            one.transport.give(given, Outside(wheels_from_live=ahead))
            said = until(one, lambda m, at=pair.stamp_ns: m.get("stamp_ns") == at)
    assert said["status"] == "localised"
    assert said["odom_from_live"][11] == pytest.approx(0.8 * (len(pairs) - 1), rel=0.05)


def test_a_gyroscope_turns_the_robot_where_the_camera_sees_nothing(
    town: Path, pairs: list[StereoPair], tmp_path: Path
) -> None:
    """It rests for three seconds, in which the bias is learnt, and turns for half a second."""
    bias, rate = np.array([0.05, -0.1, 0.02]), np.array([0.0, 0.4, 0.0])
    rng, pair = np.random.default_rng(0), pairs[0]
    turn, odom = SE3.identity(), []
    with running("socket", tmp_path, LiveOptions(town, robot=OPTIONS)) as one:
        assert isinstance(one, Middleware)
        for number in range(35):
            dark = number >= 30
            noise = rng.integers(0, 2, pair.left.shape, np.uint8)
            left, right = (
                noise if dark else np.clip(x + rng.normal(0, 1.5, x.shape), 0, 255).astype(np.uint8)
                for x in (pair.left, pair.right)
            )
            stamp_ns = pair.stamp_ns + number * 10**8
            turn = turn @ SE3.exp(0.1 * np.r_[np.zeros(3), bias + dark * rate])
            moved = {"gyro_from_live": turn.rotation.ravel().tolist()}
            one.give(StereoPair(stamp_ns, left, right, pair.camera), **moved)
            odom.append(until(one, lambda m, at=stamp_ns: m.get("stamp_ns") == at))
    before, after = (np.reshape(odom[at]["odom_from_live"], (4, 4))[:3, :3] for at in (29, 34))
    turned_rad = SE3(before.T @ after, np.zeros(3)).log()[3:]
    np.testing.assert_allclose(turned_rad, 0.5 * rate, atol=0.01)


def test_what_only_one_source_measured_is_used() -> None:
    straight, turned = SE3.exp([0, 0, 1.0, 0, 0.1, 0]), SE3.exp([0, 0, 0, 0, 0.2, 0])
    still = SE3.identity()
    both = Outside(straight, turned).since(Outside(still, still), 0.5)
    assert both is not None
    assert both.has_way
    np.testing.assert_allclose(both.prev_from_curr.rotation, turned.rotation)
    np.testing.assert_allclose(both.rates_rad_s, [0, 0.4, 0], atol=1e-9)
    gyro = Outside(None, turned).since(Outside(still, still), 0.5)
    assert gyro is not None
    assert not gyro.has_way
    wheels = Outside(straight, turned).since(Outside(still, None), 0.5)
    assert wheels is not None
    assert wheels.rates_rad_s is None
    assert Outside(straight).since(Outside(None, turned), 0.5) is None
    assert Outside(straight, turned).since(Outside(still, still), 0.0) is None


@pytest.mark.parametrize("sigma_m", [0.0, -1.0, float("nan"), float("inf")])
def test_a_fix_without_a_possible_deviation_is_refused(sigma_m: float) -> None:
    told = {"stamp_ns": 1, "latitude_deg": 51.7, "longitude_deg": -1.2, "sigma_m": sigma_m}
    with pytest.raises(InputError, match="must be > 0"):
        process._fix(told)
    assert process._fix({**told, "sigma_m": None}).sigma_m is None


def test_the_newest_frame_wins(town: Path, pairs: list[StereoPair]) -> None:
    heard: Queue[dict[str, Any]] = Queue()
    transport = InProcess(heard.put)
    for pair in pairs:
        transport.give(pair)
    transport.close()
    LiveProcess(transport, LiveOptions(town, robot=OPTIONS)).run()
    messages = [heard.get_nowait() for _ in range(heard.qsize())]
    assert [one["stamp_ns"] for one in messages if one["is"] == "seen"] == [pairs[-1].stamp_ns]


def test_a_client_that_breaks_the_protocol_is_left_and_the_next_one_served(
    town: Path, pairs: list[StereoPair], tmp_path: Path
) -> None:
    with running("socket", tmp_path, LiveOptions(town, robot=OPTIONS)) as one:
        assert isinstance(one, Middleware)
        one.link.send({"do": "frame", "ticket": 0, "stamp_ns": 1})
        assert "no camera" in until(one, lambda said: said["is"] == "reply")["text"]
        one.link.send({"do": "camera", "ring": "/dev/null", "camera": {"fx": "wide"}})
        assert until(one, lambda said: said["is"] == "reply")["text"] == "camera needs 'fy'"
        sides = {"do": "camera", "ring": "/dev/null", "camera": {"left": None, "right": "wide"}}
        one.link.send(sides)
        assert "not understood" in until(one, lambda said: said["is"] == "reply")["text"]
        one.link._socket.sendall(b"hello\n")
        with pytest.raises((EOFError, OSError)):
            until(one, lambda _: False)
        one.link, one.heard = Link.connect(str(tmp_path / "socket")), []
        assert seen(one, pairs[0])["stamp_ns"] == pairs[0].stamp_ns


def test_only_a_dead_socket_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="not a socket"):
        Served(tmp_path / "file")
    with (
        Served(tmp_path / "socket"),
        pytest.raises(InputError, match="another process listens"),
    ):
        Served(tmp_path / "socket")


def test_a_killed_process_leaves_a_socket_that_the_next_one_takes(
    town: Path, pairs: list[StereoPair], tmp_path: Path
) -> None:
    path = tmp_path / "socket"
    command = "from engram.cli import main; main()"
    arguments = [sys.executable, "-c", command, "live", str(town), "--socket", str(path)]
    with subprocess.Popen(arguments, stderr=subprocess.PIPE) as process:
        link = connected(path, process)
        assert link.receive(30)
        os.kill(process.pid, signal.SIGKILL)
    link.close()
    assert path.exists()
    Served(path).__exit__()
    assert not path.exists()


@pytest.mark.long
def test_what_a_killed_process_mapped_is_sealed_and_the_next_one_goes_on_in_it(
    street: Path, tmp_path: Path
) -> None:
    path, pairs = tmp_path / "town.engram", list(open_drive(street))
    command = [sys.executable, "-c", "from engram.cli import main; main()", "live", str(path)]
    command += ["--socket", str(tmp_path / "socket"), "--robot", "r1", "--map"]
    command += ["--set", "mapper.checkpoint_every=1"]
    with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
        one = Middleware(tmp_path, connected(tmp_path / "socket", process))
        found = [seen(one, pair) for pair in pairs[:8]]
        assert any(said.get("saved") for said in found)
        os.kill(process.pid, signal.SIGKILL)
    one.link.close()
    with open_map(path) as opened:
        assert opened.node_count() == 0, "nothing is committed yet"
    with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
        one = Middleware(tmp_path, connected(tmp_path / "socket", process))
        found = [seen(one, pair) for pair in pairs[6:]]
        assert [said["status"] for said in found].count("localised") >= 4
        alive = until(one, lambda said: said["is"] == "alive" and said["recovered"])
        assert alive["recovered"] == [1]
        one.ask("stop")
        ended = until(one, lambda said: said["is"] == "ended")
        assert "saved before an interruption: revision 1" in ended["text"]
    one.link.close()
    with open_map(path) as opened:
        assert opened.interrupted() == []
        assert {session.robot for session in opened.sessions.values()} == {"r1"}


def connected(path: Path, process: subprocess.Popen[bytes]) -> Link:
    """A link to a process that is starting."""
    while process.poll() is None:
        if path.exists():
            try:
                return Link.connect(str(path))
            except OSError:  # bound, and not yet listening
                continue
    assert process.stderr is not None
    raise AssertionError(process.stderr.read().decode())


def test_a_played_drive_waits_until_the_robot_is_ready(
    street: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = FakeClock()
    for module in ("engram.live.served", "engram.robot.front"):
        monkeypatch.setattr(f"{module}.time", clock)
    took_s = {0: 30.0, 3: 0.25}  # opening the map; a frame that keeps the robot busy
    taken = []
    for event in Played(open_drive(street), lambda _: None, rate_hz=10.0).events():
        clock.now_s += took_s.get(len(taken), 0.01)
        taken.append(event)
    assert [one.dropped for one in taken] == [0] * 4 + [1] + [0] * 6
    gaps_s = [after.arrived_s - before.arrived_s for before, after in pairwise(taken[1:])]
    assert gaps_s == pytest.approx([0.1] * 2 + [0.2] + [0.1] * 6)


class FakeClock:
    """In place of the module `time`: sleeping takes no time but its own."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def perf_counter(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def test_a_drive_is_played_in_real_time_without_its_late_frames(street: Path, town: Path) -> None:
    heard: Queue[dict[str, Any]] = Queue()
    sequence = open_drive(street, frames=":6")
    LiveProcess(Played(sequence, heard.put, rate_hz=1_000.0), LiveOptions(town)).run()
    messages = []
    try:
        while True:
            messages.append(heard.get_nowait())
    except Empty:
        taken = [one for one in messages if one["is"] == "seen"]
    assert 1 <= len(taken) < 6


def test_a_stamp_that_no_clock_gives_is_refused_and_the_drive_goes_on(
    town: Path, pairs: list[StereoPair], tmp_path: Path
) -> None:
    with running("socket", tmp_path, LiveOptions(town, robot=OPTIONS)) as one:
        assert isinstance(one, Middleware)
        one.give(pairs[0])
        until(one, lambda said: said["is"] == "seen")
        one.link.send({"do": "frame", "ticket": 0, "stamp_ns": 2**70})
        assert "within 64 bits" in until(one, lambda said: said["is"] == "reply")["text"]
        one.give(pairs[1])
        assert until(one, lambda said: said["is"] == "seen")["trouble"] == ""
