"""A centre with many agents at once over real sockets: failed requests, and how fast it answers.

    python -m engram_lab.checks.centre_load --agents 50 --nodes 20000 --minutes 60 --forays 24

An embedded centre with its worker runs as a program of its own, with a fleet map of synthetic
places. Each agent is enrolled, and in turn drives past places of its own, hands in, and reports,
until the time is over; all of them start at random moments. Then one hands in 50 nodes by itself,
and a mission's download is asked for twice, by two robots. Times of answers are the service's own
histogram, and those that the agents saw, who share the machine with it; downloads are timed from
asking to the first byte.
"""

from __future__ import annotations

import os
import random
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from engram.fleet.agent.agent import Agent
from engram.fleet.agent.centre_link import enrol, new_client
from engram.fleet.centre.access import new_code
from engram.fleet.centre.service import Centre, MapPolicy
from engram.fleet.merge.merge_settings import MergeOptions
from engram.maps.map import open_map
from engram_lab.programs import Figure, command_line, report
from engram_lab.synthetic_places import SESSION_NODES, write_map, write_session

MAP = "fleet"
_FORAY_NODES = 20
_NEW_NODES = 50
_ASK_S = 0.05
_PROGRAM = "import sys; from engram.cli import main; sys.argv[0] = 'engram'; main()"
_MISSION: Mapping[str, Any] = {"select": "budget", "budget_percent": 25.0}


def made_centre(folder: Path, nodes: int) -> Centre:
    """A centre whose map holds drives past so many places."""
    centre = Centre(folder)
    if nodes:
        places = [range(at, at + SESSION_NODES) for at in range(0, nodes, SESSION_NODES)]
        write_map(folder / "maps" / f"{MAP}.engram", "fleet", places)
    centre.add_map(MAP, "lab", MapPolicy(merge=MergeOptions(relocaliser="none")))
    return centre


@dataclass(frozen=True, slots=True)
class Service:
    """A running centre.

    Attributes:
        url: its address.
        pid: of its process, whose child is the worker.
    """

    url: str
    pid: int


@contextmanager
def served(folder: Path) -> Iterator[Service]:
    """Runs a centre with its worker for the length of the block."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-c", _PROGRAM, "centre", "serve", str(folder), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
        try:
            assert service.stdout is not None
            service.stdout.readline()  # it tells its address as soon as it answers
            yield Service(f"http://127.0.0.1:{port}", service.pid)
        finally:
            service.terminate()


class Day:
    """Agents that drive and hand in until the day is over."""

    def __init__(self, folder: Path, url: str, minutes: float, forays: float) -> None:
        self._folder = folder
        self._url = url
        self._end_s = time.monotonic() + 60.0 * minutes
        self._pause_s = 60.0 * minutes / forays
        self._over = threading.Event()
        self.troubles: list[str] = []
        self.forays = 0
        self.seen_s: list[float] = []

    def live(self, number: int, code: str) -> None:
        """The day of one robot."""
        folder, name = self._folder / f"r{number}", f"r{number}"
        with new_client(self._url, event_hooks=self._timed()) as client:
            enrol(folder, self._url, code, name, client)
            with Agent(folder, client=client) as agent:
                self._drive(agent, name, number)

    def _drive(self, agent: Agent, name: str, number: int) -> None:
        """Drives and hands in at random moments."""
        foray, chance = 0, random.Random(number)
        while self._waited(chance.expovariate(1 / self._pause_s)):
            at = 1_000_000 + number * 10_000 + foray * _FORAY_NODES
            drive(agent.live, name, foray, range(at, at + _FORAY_NODES))
            foray += 1
            agent.hand_in()
            while agent.step(fetch=False) == 0:
                pass
            self.forays += 1
            if agent.trouble is not None:
                self.troubles.append(f"{name}: {agent.trouble}")

    def _timed(self) -> dict[str, list[Callable[[Any], None]]]:
        """What a client calls around each of its requests, which come one after another."""
        began: list[float] = []
        return {
            "request": [lambda _: began.append(time.perf_counter())],
            "response": [lambda _: self.seen_s.append(time.perf_counter() - began.pop())],
        }

    def _waited(self, seconds: float) -> bool:
        """Whether the day continues after some seconds."""
        left_s = self._end_s - time.monotonic()
        self._over.wait(min(seconds, max(left_s, 0.0)))
        return time.monotonic() < self._end_s


def drive(path: Path, robot: str, number: int, places: range) -> None:
    """One more drive in a robot's map, past some places."""
    with (
        open_map(path, create=True) as store,
        store.writing(),
        store.begin_revision(author=robot, message="", configuration={}) as writer,
    ):
        write_session(writer, robot, number, places)
        writer.commit()


def answers(url: str) -> list[Figure]:
    """The service's own counts of answers and of their times."""
    told = httpx.get(f"{url}/v1/metrics", timeout=60.0).text
    by_status = re.findall(r'engram_answers_total\{status="(\d+)"\} (\d+)', told)
    failed = sum(int(count) for status, count in by_status if status >= "500")
    buckets = dict(re.findall(r'engram_answer_seconds_bucket\{le="([^"]+)"\} (\d+)', told))
    whole = int(buckets["+Inf"])
    return [
        Figure("answers", whole),
        Figure("server errors", failed),
        *(
            Figure(f"answers within {limit} s", 100.0 * int(count) / max(whole, 1), "%")
            for limit, count in buckets.items()
            if limit != "+Inf"
        ),
    ]


def seen(times_s: list[float]) -> list[Figure]:
    """The share of answers that agents had within some times."""
    whole = np.array(times_s)
    return [
        Figure(f"seen by agents within {limit} s", 100.0 * float(np.mean(whole <= limit)), "%")
        for limit in (0.05, 0.2, 0.5, 1.0)
    ]


def used_below(pid: int) -> tuple[float, float]:
    """What the processes that one started take: time of a core, s, and greatest memory, bytes."""
    time_s = memory = 0.0
    for child in children_of(pid):
        folder = Path("/proc") / str(child)
        fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
        peak = re.search(r"VmHWM:\s+(\d+) kB", (folder / "status").read_text())
        below_s, below = used_below(child)
        time_s += sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK") + below_s
        memory += (1024.0 * int(peak.group(1)) if peak else 0.0) + below
    return time_s, memory


def children_of(pid: int) -> list[int]:
    """The processes that one started."""
    told = (one.read_text() for one in Path(f"/proc/{pid}").glob("task/*/children"))
    return [int(child) for children in told for child in children.split()]


def first_byte_s(folder: Path, options: Mapping[str, Any] = _MISSION) -> float:
    """From asking for a mission's download to its first byte, as one robot."""
    with Agent(folder) as agent:
        started = time.perf_counter()
        body = {"ref": "head", "options": options}
        asked = agent.link.ask("POST", f"/v1/maps/{MAP}/downloads", body)
        while asked["state"] == "asked":
            time.sleep(_ASK_S)
            asked = agent.link.ask("GET", f"/v1/artifacts/{asked['id']}")
        agent.link.ask("GET", f"/v1/artifacts/{asked['id']}/manifest")
        return time.perf_counter() - started


def settle(url: str) -> None:
    """Until the centre has nothing left to merge."""
    while 'engram_handins{state="complete"}' in httpx.get(f"{url}/v1/metrics", timeout=60.0).text:
        time.sleep(_ASK_S)


def visible_s(folder: Path, number: int) -> float:
    """From handing in 50 new nodes, when the centre has nothing else to do, until they are seen."""
    with Agent(folder) as agent:
        drive(agent.live, f"r{number}", 10**6, range(9_000_000, 9_000_000 + _NEW_NODES))
        key = agent.hand_in()
        started = time.perf_counter()
        while agent.step(fetch=False) == 0:
            pass
        while agent.link.ask("GET", f"/v1/handins/{key}")["state"] == "complete":
            time.sleep(_ASK_S)
        return time.perf_counter() - started


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--agents", type=int, default=50)
    parser.add_argument("--nodes", type=int, default=20_000, help="of the fleet map, to begin with")
    parser.add_argument("--minutes", type=float, default=60.0, help="of the day")
    parser.add_argument("--forays", type=float, default=24.0, help="of each robot, in the mean")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with made_centre(folder / "centre", asked.nodes) as centre:
            codes = [new_code(centre, MAP, "head", "lab") for _ in range(asked.agents)]
        with served(folder / "centre") as service:
            url = service.url
            day = Day(folder, url, asked.minutes, asked.forays)
            with ThreadPoolExecutor(asked.agents) as robots:
                list(robots.map(day.live, range(asked.agents), codes))
            figures = [*answers(url), *seen(day.seen_s)]
            settle(url)
            before_s, _ = used_below(os.getpid())
            until_s = visible_s(folder / "r0", 0)
            after_s, memory = used_below(os.getpid())
            figures += [
                Figure("forays handed in", day.forays),
                Figure("troubles of agents", len(day.troubles)),
                Figure("50 nodes handed in, until visible", until_s, "s"),
                Figure("the same, of a core of the centre", after_s - before_s, "s"),
                Figure("memory of the centre's processes", memory / 1e9, "GB"),
                Figure("first robot's download, first byte", first_byte_s(folder / "r0"), "s"),
                Figure("second robot's download, first byte", first_byte_s(folder / "r1"), "s"),
            ]
    title = f"{asked.agents} agents, {asked.nodes} nodes, {asked.minutes:g} minutes"
    report(figures, asked.json, title)
    for trouble in day.troubles[:20]:
        print(trouble)
    sys.exit(bool(day.troubles))


if __name__ == "__main__":
    main()
