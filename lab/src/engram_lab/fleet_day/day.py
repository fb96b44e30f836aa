"""Three robots of the hamlet share what they map, over a link that breaks.

Each maps half of the round. Then each drives all of it: with its own map, and with a download of
the fleet's.
"""

from __future__ import annotations

import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from engram.config import plain
from engram.errors import EngramError
from engram.fleet.agent.agent import MAP, Agent
from engram.fleet.agent.agent_state import AgentSettings
from engram.fleet.agent.centre_link import Unreachable, enrol
from engram.fleet.agent.outbox import QUEUED, SENT
from engram.fleet.centre.access import Role, add_person, new_code
from engram.fleet.centre.merge_job import merge_hand_in
from engram.fleet.centre.service import Centre
from engram.fleet.centre.worker import work_off
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.localisation import Position
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map
from engram.monitor import QUIET, Monitor, Relay
from engram.robot.mapping import Beginning, map_drive
from engram.sequences.opening import open_drive
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.simulating import simulate
from engram_lab.truth import read_truth

# Rounds in which a hand-in or a download is over. Each broken connection takes one, and what
# arrived by then stays: 200 kB a round make 40 MB.
_ROUNDS = 200
# Drives of the hamlet begin beside one another, in the yard where its robots are parked.
_YARD_M, _YARD_RAD = 1.0, 0.1


@dataclass(frozen=True, slots=True)
class Drive:
    """What one drive with one map came to.

    Attributes:
        localised: share of the frames.
    """

    held: int
    localised: float
    added: int


@dataclass(frozen=True, slots=True)
class Foray:
    """One robot's second drive, with either map, and the day's traffic.

    Attributes:
        why: what it knew and what it met, which explain its result.
        sent_bytes, received_bytes: bodies of all its requests and answers, what was sent again
            included.
    """

    robot: str
    download: str
    alone: Drive
    shared: Drive
    fell_back: bool
    why: str
    sent_bytes: int
    received_bytes: int


@dataclass(frozen=True, slots=True)
class Plan:
    """A robot's two forays.

    Attributes:
        first, second: drives of the campaign.
        frames: of the first that it drives: its own stretch of the round.
        download: what it downloads in between; options of ``engram download``.
        why: what it knows and what it meets, which explain its result.
    """

    first: int
    frames: str
    second: int
    download: dict[str, Any]
    why: str


class DayRobot:
    """A robot that has enrolled.

    Attributes:
        yard: the node where all forays over the whole round begin, if somebody has mapped it.
    """

    def __init__(self, folder: Path, centre: Centre, monitor: Monitor) -> None:
        self.name = folder.name
        self.yard: NodeId | None = None
        self.live = folder / "live" / MAP
        self._folder = folder
        self._centre = centre
        self._monitor = monitor
        self._sent = self._received = 0

    def drive(self, log: Path, path: Path | None = None, frames: str | None = None) -> Drive:
        """Drives some or all frames of a log, with the live map or with another one."""
        path = path or self.live
        held = _nodes(path)
        sequence = open_drive(log, robot=self.name, frames=frames)
        whose = f"{held} nodes" if held else "no map yet"
        with self._monitor.stage(f"{self.name} drives {log.stem}, {whose}", len(sequence)) as part:
            found = map_drive(path, sequence, monitor=part, begin=self._place_at_yard)
        if found.interrupted:
            raise KeyboardInterrupt
        return Drive(held, found.to_dict()["share_localised"], found.saved)

    def hand_in(self, foray: str) -> None:
        """Sends what the live map holds, and waits until the centre has merged it."""
        with self._agent({}) as agent:
            agent.hand_in()
            what = f"{self.name} hands in its {foray} foray"
            self._rounds(agent, what, lambda: _is_none_left(agent, QUEUED), fetch=False)
            what = f"the centre merges {self.name}'s {foray} foray"
            self._rounds(agent, what, lambda: _is_none_left(agent, SENT), fetch=False)

    def download(self, options: dict[str, Any]) -> None:
        """Fetches what the next mission needs, and switches to it."""
        with self._agent(options) as agent:
            what = f"{self.name} downloads, {options['select']}"
            self._rounds(agent, what, lambda: agent.status()["staged"] is not None)
            if not agent.switch():
                raise EngramError(f"{self.name} did not switch: {agent.status()}")

    def second_foray(self, log: Path, plan: Plan) -> Foray:
        """Drives with its own map alone, then with a download; hands in the second."""
        options = plan.download
        own = self._folder / "alone.engram"
        copy_map(self.live, own)
        alone = self.drive(log, own)
        self.download(options)
        shared = self.drive(log)
        with self._agent({}) as agent:
            fell_back = agent.drove(shared.localised, _length_m(log))
        self.hand_in("second")
        return Foray(
            self.name,
            options["select"],
            alone,
            shared,
            fell_back,
            plan.why,
            self._sent,
            self._received,
        )

    def _place_at_yard(self, foray: Beginning) -> None:
        """Robots are parked in the yard: one whose map contains it begins there."""
        if self.yard is not None and self.yard in foray.opened.graph and not foray.resumed:
            covariance = np.diag([_YARD_M**2] * 3 + [_YARD_RAD**2] * 3)
            foray.robot.place_at(Position(self.yard, SE3.identity(), covariance))

    @contextmanager
    def _agent(self, download: dict[str, Any]) -> Iterator[Agent]:
        with Agent(self._folder, AgentSettings(download=download)) as agent:
            yield agent
            self._sent += agent.link.sent_bytes
            self._received += agent.link.received_bytes

    def _rounds(
        self, agent: Agent, what: str, is_over: Callable[[], bool], *, fetch: bool = True
    ) -> None:
        """Lets agent and centre work in turn. A broken link is tried again, all else is an end."""
        breaks = 0
        with self._monitor.stage(what, _ROUNDS) as part:
            for _ in range(_ROUNDS):
                agent.step(fetch=fetch)
                failed = [entry.error for entry in agent.state.outbox() if entry.error]
                if failed:
                    raise EngramError(f"{what}: {failed[0]}")
                if agent.trouble is None and is_over():
                    return
                if not isinstance(agent.trouble, Unreachable | None):
                    raise EngramError(f"{what}: {agent.trouble}") from agent.trouble
                breaks += agent.trouble is not None
                work_off(self._centre, merge_hand_in)
                part.advance(f"the link broke {breaks} times")
        raise EngramError(
            f"{what}: not over after {_ROUNDS} rounds, in which the link broke {breaks} times; "
            f"the agent says {agent.status()}"
        )


def _is_none_left(agent: Agent, state: str) -> bool:
    return all(entry.state != state for entry in agent.state.outbox())


def _nodes(path: Path) -> int:
    if not path.exists():
        return 0
    with Map.open(path) as store:
        return store.node_count()


def _length_m(log: Path) -> float:
    """How far the town's robot drove."""
    truth = read_truth(log)
    if truth is None:
        raise EngramError(f"{log}: the true path next to it is gone; remove the log as well")
    positions = np.array([pose.translation for pose in truth.world_from_cam])
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


_PIECE = 16_384
_LONGEST_S = 60.0


class CuttingProxy:
    """Forwards connections to a port of this machine."""

    def __init__(self, port: int, cut_bytes: int) -> None:
        self._target = port
        self._cut_bytes = cut_bytes
        self._lock = threading.Lock()
        self.cuts = 0
        self.passed_bytes = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Stops listening."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                ours, _ = self._listener.accept()
                try:
                    theirs = socket.create_connection(("127.0.0.1", self._target))
                except OSError:  # nobody there now: the caller hears it, others may come
                    ours.close()
                    continue
                left = [self._cut_bytes]
                for source, sink in ((ours, theirs), (theirs, ours)):
                    source.settimeout(_LONGEST_S)
                    threading.Thread(
                        target=self._forward, args=(source, sink, left), daemon=True
                    ).start()

    def _forward(self, source: socket.socket, sink: socket.socket, left: list[int]) -> None:
        with suppress(OSError):  # the other way was dropped
            while piece := source.recv(_PIECE):
                with self._lock:
                    part = piece[: left[0]]
                    is_cut = len(part) == left[0]
                    self.cuts += is_cut and bool(part)  # once, not once a direction
                    left[0] -= len(part)
                    self.passed_bytes += len(part)
                sink.sendall(part)
                if is_cut:
                    break
        for one in (source, sink):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


@contextmanager
def cutting(port: int, cut_bytes: int) -> Iterator[CuttingProxy]:
    """A proxy for the length of a block."""
    proxy = CuttingProxy(port, cut_bytes)
    try:
        yield proxy
    finally:
        proxy.close()


class Stages(Relay):
    """Reports each stage as it begins, and how long it took when it ends.

    Attributes:
        took: stage → seconds, in their order.
    """

    def __init__(self, inner: Monitor, tell: Callable[[str], object]) -> None:
        super().__init__(inner)
        self._tell = tell
        self.took: dict[str, float] = {}

    @contextmanager
    def stage(self, what: str, total: int) -> Iterator[Monitor]:
        """See `Monitor`."""
        self._tell(f"{what} …")
        begun_s = time.monotonic()
        with super().stage(what, total) as part:
            yield part
        self.took[what] = time.monotonic() - begun_s
        self._tell(f"{what}: {self.took[what]:.1f} s")


_CAMPAIGN, MAP_NAME = "hamlet", "fleet"
_CUT_BYTES = 200_000
# Open requests at the end of the day are not waited for any longer.
_FAREWELL_S = 5
_ROBOTS = {
    "r1": Plan(
        0, "0:100", 3, {"select": "copy"},
        "It mapped the first half of the round by day. Now it drives all of it at night, which no "
        "robot has mapped yet.",
    ),
    "r2": Plan(
        1, "85:185", 4,
        {"select": "tod+paths", "depart_h": 10.0, "arrive_h": 11.0, "buffer_min": 120.0},
        "It mapped the second half on a dry day. Now it drives all of it in rain, with what the "
        "others saved within two hours of its own.",
    ),
    "r3": Plan(
        2, "40:140", 5, {"select": "budget", "budget_percent": 50.0, "depart_h": 9.0},
        "It mapped the middle, which the others had handed in. Now it drives all of it by day, "
        "with the half of the fleet's map that serves it best.",
    ),
}  # fmt: skip


@dataclass(slots=True)
class DayReport:
    """What the day came to.

    Attributes:
        stages_s: stage → seconds that it took.
    """

    out: Path
    token: str = ""
    forays: list[Foray] = field(default_factory=list)
    cuts: int = 0
    passed_bytes: int = 0
    revisions: int = 0
    nodes: int = 0
    faults: int = 0
    stages_s: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """What ``lab fleet-day --json`` prints."""
        values: dict[str, Any] = plain(self)
        return values


def run_day(
    out: Path,
    monitor: Monitor = QUIET,
    workers: int = 2,
    tell: Callable[[str], object] = lambda _: None,
) -> DayReport:
    """Runs the day in a folder, which keeps what was rendered for another one."""
    out.mkdir(parents=True, exist_ok=True)
    stages = Stages(monitor, tell)
    report = DayReport(out, stages_s=stages.took)
    done = simulate(campaign_named(_CAMPAIGN), out, workers=workers, monitor=stages)
    logs = [Path(one) for one in done.files]
    for name in ("centre", "robots"):
        shutil.rmtree(out / name, ignore_errors=True)
    with Centre(out / "centre") as centre:
        centre.add_map(MAP_NAME, "demo")
        report.token = add_person(centre, "demo", MAP_NAME, Role.ADMIN)
        robots = [DayRobot(out / "robots" / name, centre, stages) for name in _ROBOTS]
        with listening(centre) as port, cutting(port, _CUT_BYTES) as link:
            for robot in robots:
                code = new_code(centre, MAP_NAME, "head", "demo")
                enrol(
                    out / "robots" / robot.name, f"http://127.0.0.1:{link.port}", code, robot.name
                )
            for robot in robots:
                plan = _ROBOTS[robot.name]
                robot.drive(logs[plan.first], frames=plan.frames)
                robot.hand_in("first")
            with Map.open(robots[0].live) as store:
                yard = store.graph.node(0).id
            for robot in robots:
                robot.yard = yard
                plan = _ROBOTS[robot.name]
                report.forays.append(robot.second_foray(logs[plan.second], plan))
            report.cuts, report.passed_bytes = link.cuts, link.passed_bytes
        _look_over(report, centre.map_path(MAP_NAME), [robot.live for robot in robots], stages)
    return report


def _look_over(report: DayReport, fleet: Path, lives: list[Path], monitor: Monitor) -> None:
    """Counts what the fleet's map holds, and checks every map."""
    with Map.open(fleet) as store:
        report.revisions, report.nodes = store.revision, store.node_count()
    places = [fleet, *lives]
    with monitor.stage("all maps are checked", len(places)) as part:
        for one in places:
            report.faults += len(check_file(one).problems)
            part.advance()


@contextmanager
def listening(centre: Centre) -> Iterator[int]:
    """Serves a centre on a free port of this machine, without a worker."""
    import uvicorn

    from engram.fleet.centre.application import create_app

    config = uvicorn.Config(
        create_app(centre), log_level="error", timeout_graceful_shutdown=_FAREWELL_S
    )
    place = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([place],), daemon=True)
    thread.start()
    try:
        yield place.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()
        place.close()
