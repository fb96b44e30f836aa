"""Three robots of the hamlet drive, hand in over a link that breaks, download, and drive again."""

from __future__ import annotations

import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from engram.agent import Agent, AgentSettings, enrol
from engram.centre.access.enrolment import add_person, new_code
from engram.centre.access.roles import Role
from engram.centre.service import Centre
from engram.centre.worker.loop import work_off
from engram.config import plain
from engram.errors import EngramError
from engram.maps import Map, check_file
from engram.monitor import QUIET, Monitor
from engram.robot import map_drive, open_drive
from engram_lab.fleet_day.proxy import CuttingProxy, cutting
from engram_lab.town import campaign_named
from engram_lab.town.simulating import simulate

_CAMPAIGN, _MAP = "hamlet", "fleet"
_CUT_BYTES = 200_000
# Rounds of the agent within which a day settles; each broken connection takes one.
_ROUNDS = 2000
# First and second foray of each robot, and what it downloads in between.
_ROBOTS: dict[str, tuple[int, int, dict[str, Any]]] = {
    "r1": (0, 3, {"policy": "copy"}),
    "r2": (1, 4, {"policy": "tod+paths", "start_h": 10.0, "end_h": 11.0, "buffer_min": 120.0}),
    "r3": (2, 5, {"policy": "budget", "budget_percent": 50.0, "start_h": 9.0}),
}


@dataclass(frozen=True, slots=True)
class Foray:
    """One robot's second drive.

    Attributes:
        robot: its name.
        download: the policy by which its map was chosen.
        alone: share of frames localised in its own map.
        shared: the same with the download of the fleet's map.
        nodes_alone, nodes_shared: nodes that the drive added to either.
        sent_bytes, received_bytes: that the robot's requests and answers held.
    """

    robot: str
    download: str
    alone: float
    shared: float
    nodes_alone: int
    nodes_shared: int
    sent_bytes: int
    received_bytes: int


@dataclass(slots=True)
class DayReport:
    """What the day came to.

    Attributes:
        out: folder with the centre and the robots.
        token: opens the pages.
        forays: one a robot.
        cuts: broken connections.
        passed_bytes: that passed the link.
        revisions, nodes: of the fleet's map in the end.
        faults: that checks of all maps found.
    """

    out: Path
    token: str = ""
    forays: list[Foray] = field(default_factory=list)
    cuts: int = 0
    passed_bytes: int = 0
    revisions: int = 0
    nodes: int = 0
    faults: int = 0

    def to_dict(self) -> dict[str, Any]:
        """What ``lab fleet-day --json`` prints."""
        values: dict[str, Any] = plain(self)
        return values


def run_day(out: Path, monitor: Monitor = QUIET, workers: int = 2) -> DayReport:
    """Runs the day in a folder, which keeps what was rendered for another one.

    Args:
        out: folder to write to, made where there is none.
        monitor: hears of every frame.
        workers: processes that render.

    Raises:
        EngramError: the day did not settle.
    """
    out.mkdir(parents=True, exist_ok=True)
    logs = [
        Path(one)
        for one in simulate(campaign_named(_CAMPAIGN), out, workers=workers, monitor=monitor).files
    ]
    for name in ("centre", "robots"):
        shutil.rmtree(out / name, ignore_errors=True)
    report = DayReport(out)
    with Centre(out / "centre") as centre:
        centre.add_map(_MAP, "demo")
        report.token = add_person(centre, "demo", _MAP, Role.ADMIN)
        with listening(centre) as port, cutting(port, _CUT_BYTES) as link:
            _enrol(centre, link, out)
            for robot, (first, _, _) in _ROBOTS.items():
                _drive(out, robot, logs[first], monitor)
                _settle(centre, out, robot, only_send=True)
            for robot, (_, second, options) in _ROBOTS.items():
                report.forays.append(
                    _second_foray(centre, out, robot, logs[second], options, monitor)
                )
            report.cuts, report.passed_bytes = link.cuts, link.passed_bytes
        with Map.open(centre.map_path(_MAP)) as store:
            report.revisions, report.nodes = store.revision, store.node_count()
        places = [centre.map_path(_MAP), *(_live(out, robot) for robot in _ROBOTS)]
    report.faults = sum(len(check_file(one).problems) for one in places)
    return report


@contextmanager
def listening(centre: Centre) -> Iterator[int]:
    """Serves a centre on a free port of this machine, without a worker."""
    import uvicorn

    from engram.centre.api.app import create_app

    place = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(create_app(centre), log_level="error"))
    thread = threading.Thread(target=server.run, args=([place],), daemon=True)
    thread.start()
    try:
        yield place.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()
        place.close()


def _live(out: Path, robot: str) -> Path:
    return out / "robots" / robot / "live" / "map.engram"


def _enrol(centre: Centre, link: CuttingProxy, out: Path) -> None:
    for robot in _ROBOTS:
        url = f"http://127.0.0.1:{link.port}"
        enrol(out / "robots" / robot, url, new_code(centre, _MAP, "head", "demo"), robot)


def _drive(out: Path, robot: str, log: Path, monitor: Monitor) -> tuple[float, int]:
    """One drive with the robot's map: share of frames localised, and nodes added."""
    _live(out, robot).parent.mkdir(exist_ok=True)
    return _mapped(_live(out, robot), log, robot, monitor)


def _mapped(path: Path, log: Path, robot: str, monitor: Monitor) -> tuple[float, int]:
    sequence = open_drive(log, robot=robot)
    with monitor.stage(f"{robot} drives {log.stem}", len(sequence)) as part:
        found = map_drive(path, sequence, monitor=part)
    return found.to_dict()["share_localised"], found.saved


def _second_foray(
    centre: Centre, out: Path, robot: str, log: Path, options: dict[str, Any], monitor: Monitor
) -> Foray:
    """Downloads, parks, switches and drives; beside it the same drive with its own map alone."""
    alone = out / "robots" / robot / "alone.engram"
    shutil.copyfile(_live(out, robot), alone)
    before = _mapped(alone, log, robot, monitor)
    sent, received = _settle(centre, out, robot, options)
    share, nodes = _drive(out, robot, log, monitor)
    with Agent(out / "robots" / robot) as agent:
        agent.drove(share, float(len(open_drive(log))))
    more_sent, more_received = _settle(centre, out, robot, only_send=True)
    return Foray(
        robot,
        options["policy"],
        before[0],
        share,
        before[1],
        nodes,
        sent + more_sent,
        received + more_received,
    )


def _settle(
    centre: Centre,
    out: Path,
    robot: str,
    options: dict[str, Any] | None = None,
    *,
    only_send: bool = False,
) -> tuple[int, int]:
    """Hands in, and lets agent and centre work until the robot runs what it wants.

    Raises:
        EngramError: it takes too many rounds.
    """
    with Agent(out / "robots" / robot, AgentSettings(download=options or {})) as agent:
        agent.hand_in()
        for _ in range(_ROUNDS):
            agent.step()
            work_off(centre)
            waiting = [row for row in agent.state.outbox() if row["state"] == "queued"]
            if only_send and not waiting and not agent.status()["trouble"]:
                break
            if not only_send and agent.switch():
                break
        else:
            raise EngramError(f"{robot} did not settle: {agent.status()}")
        return agent.link.sent_bytes, agent.link.received_bytes
