"""Three robots of the hamlet drive, hand in over a link that breaks, download, and drive again."""

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

from engram.config import plain
from engram.fleet.agent.centre_link import enrol
from engram.fleet.centre.access import Role, add_person, new_code
from engram.fleet.centre.service import Centre
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.monitor import QUIET, Monitor, Relay
from engram_lab.fleet_day.robot import DayRobot, Foray
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.simulating import simulate

_PIECE = 16_384
_LONGEST_S = 60.0


class CuttingProxy:
    """Forwards connections to a port of this machine.

    Args:
        port: where to.
        cut_bytes: a connection is dropped when this much has passed it, both ways together.

    Attributes:
        port: where it listens.
        cuts: connections dropped.
        passed_bytes: both ways, of all connections.
    """

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

    Args:
        inner: hears of every item.
        tell: takes a line.

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


_CAMPAIGN, _MAP = "hamlet", "fleet"
_CUT_BYTES = 200_000
# Open requests at the end of the day are not waited for any longer.
_FAREWELL_S = 5
# First and second foray of each robot, and what it downloads in between.
_ROBOTS: dict[str, tuple[int, int, dict[str, Any]]] = {
    "r1": (0, 3, {"select": "copy"}),
    "r2": (1, 4, {"select": "tod+paths", "depart_h": 10.0, "arrive_h": 11.0, "buffer_min": 120.0}),
    "r3": (2, 5, {"select": "budget", "budget_percent": 50.0, "depart_h": 9.0}),
}


@dataclass(slots=True)
class DayReport:
    """What the day came to.

    Attributes:
        out: folder with the centre and the robots.
        token: opens the pages.
        forays: the second one of each robot.
        cuts: broken connections.
        passed_bytes: that passed the link.
        revisions, nodes: of the fleet's map in the end.
        faults: that checks of all maps found.
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
    """Runs the day in a folder, which keeps what was rendered for another one.

    Args:
        out: folder to write to, made where there is none.
        monitor: hears of every frame.
        workers: processes that render.
        tell: takes a line as each stage begins, and as it ends.

    Raises:
        EngramError: a hand-in or a download failed, or did not end.
    """
    out.mkdir(parents=True, exist_ok=True)
    stages = Stages(monitor, tell)
    report = DayReport(out, stages_s=stages.took)
    done = simulate(campaign_named(_CAMPAIGN), out, workers=workers, monitor=stages)
    logs = [Path(one) for one in done.files]
    for name in ("centre", "robots"):
        shutil.rmtree(out / name, ignore_errors=True)
    with Centre(out / "centre") as centre:
        centre.add_map(_MAP, "demo")
        report.token = add_person(centre, "demo", _MAP, Role.ADMIN)
        robots = [DayRobot(out / "robots" / name, centre, stages) for name in _ROBOTS]
        with listening(centre) as port, cutting(port, _CUT_BYTES) as link:
            for robot in robots:
                code = new_code(centre, _MAP, "head", "demo")
                enrol(
                    out / "robots" / robot.name, f"http://127.0.0.1:{link.port}", code, robot.name
                )
            for robot in robots:
                robot.drive(logs[_ROBOTS[robot.name][0]])
                robot.hand_in("first")
            for robot in robots:
                _, second, options = _ROBOTS[robot.name]
                report.forays.append(robot.second_foray(logs[second], options))
            report.cuts, report.passed_bytes = link.cuts, link.passed_bytes
        _look_over(report, centre.map_path(_MAP), [robot.live for robot in robots], stages)
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
