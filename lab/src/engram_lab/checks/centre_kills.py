"""Kills at random moments of a fleet's day: is anything lost, or done twice?

    python -m engram_lab.checks.centre_kills --kills 200 --out kills.jsonl

Service, worker and the agents of two robots run as processes over real sockets. The robots drive,
hand in, download and switch all the time. One process after another is killed by SIGKILL and starts
again at once, as a supervisor would have it. Then the day ends by itself: nobody repairs anything.
At the end every drive is in the fleet map once, and the map is the one that merging the files in
the order of their hand-ins makes. Each day begins again and is one line of the file; the same
command continues where it stopped.

The worker is spared where it died twice without settling anything: three times over one hand-in,
and the centre gives that hand-in up, as it should.
"""

from __future__ import annotations

import json
import multiprocessing
import random
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path

from engram.errors import EngramError
from engram.fleet.agent.agent import Agent
from engram.fleet.agent.agent_state import AgentSettings
from engram.fleet.agent.centre_link import enrol
from engram.fleet.agent.outbox import QUEUED, SENT
from engram.fleet.centre import handins
from engram.fleet.centre.access import new_code
from engram.fleet.centre.database import first_broken
from engram.fleet.centre.service import Centre
from engram.fleet.centre.serving import Listening, run_worker, serve
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map
from engram.processes import end_with_parent
from engram_lab.checks.centre_load import drive, made_centre
from engram_lab.programs import Figure, command_line, report

_MAP, _ROBOTS = "fleet", ("r1", "r2")
_NODES = 4
# So that a process that starts again is soon at work.
_LOADED = [
    __name__,
    "uvicorn.protocols.http.auto",
    "engram.fleet.centre.application",
    "engram.fleet.download",
]
_LOOK_S = 0.05
_LONGEST_S = 1800.0
_HASTY = AgentSettings(first_retry_s=0.05, longest_retry_s=0.2, idle_s=0.1)


@dataclass
class Day:
    """Result of one day.

    Attributes:
        kills: victims, in their order.
        handins: settled ones.
        drives: of all robots.
        faults: whatever is not as it should be.
    """

    number: int
    kills: list[str] = field(default_factory=list)
    handins: int = 0
    drives: int = 0
    faults: list[str] = field(default_factory=list)


def live(folder: Path, name: str) -> None:
    """Main function of a robot: it continues from whatever its folder holds."""
    end_with_parent()
    with Agent(folder / name, _HASTY, wait=time.sleep) as agent:
        while True:
            over, idle = (folder / "over").exists(), not _waits(agent)
            count = len(_own_drives(agent.live, name))
            if over and idle and count:
                return
            if idle:
                places = range(1000 * count + 10**6 * int(name[1:]), 10**9)[:_NODES]
                drive(agent.live, name, count, places)
            _hand_in(agent, folder / "copies")
            pause_s = agent.step()
            agent.switch()
            time.sleep(min(pause_s, _LOOK_S))


def _waits(agent: Agent) -> bool:
    """Whether something of the robot is not at the centre yet."""
    return bool({entry.state for entry in agent.state.outbox()} & {QUEUED, SENT})


def _hand_in(agent: Agent, copies: Path) -> None:
    """Queues the map as it is; a copy of it is kept first, to merge the files in the end."""
    if not agent.live.exists():
        return
    with Map.open(agent.live) as store:
        copy = copies / f"{store.content_hash()}.engram"
    if not copy.exists():
        draft = copies / f"{agent.folder.name}.draft.engram"
        draft.unlink(missing_ok=True)
        copy_map(agent.live, draft)
        draft.replace(copy)
    agent.hand_in()


def _own_drives(path: Path, name: str) -> set[tuple[str, int]]:
    if not path.exists():
        return set()
    with Map.open(path) as store:
        return {
            (one.robot, one.start_ns) for one in store.sessions.values() if one.robot == name
        }  # fmt: skip


def _serve(folder: Path, port: int) -> None:
    end_with_parent()
    with Centre(folder) as centre:
        serve(centre, Listening("127.0.0.1", port), worker=False)


def _work(folder: Path) -> None:
    end_with_parent()
    run_worker(folder, None, None)


class Fleet:
    """The processes of a day, each of which starts again when it is killed."""

    def __init__(self, folder: Path, day: Day) -> None:
        self._day = day
        self._folder = folder
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(_LOADED)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port: int = free.getsockname()[1]
        centre = folder / "centre"
        self._starts: dict[str, Callable[[], BaseProcess]] = {
            "service": partial(self._new, _serve, centre, port),
            "worker": partial(self._new, _work, centre),
            **{name: partial(self._new, live, folder, name) for name in _ROBOTS},
        }
        self._begin(centre, f"http://127.0.0.1:{port}")

    def kill(self, name: str) -> None:
        """Kills one and starts it again."""
        self._look()
        self._running[name].kill()
        self._running[name].join()
        self._day.kills.append(name)
        self._running[name] = self._starts[name]()

    def settled(self) -> int:
        """How many hand-ins have ended."""
        with Centre(self._folder / "centre") as centre:
            rows = handins.listed(centre, _MAP)
        return sum(row.ended_ns is not None for row in rows)

    def end_day(self) -> None:
        """Until every robot has handed in all that it drove, without further kills."""
        (self._folder / "over").touch()
        end_s = time.monotonic() + _LONGEST_S
        for name in _ROBOTS:
            self._running[name].join(max(0.0, end_s - time.monotonic()))
            if self._running[name].exitcode != 0:
                self._day.faults.append(f"{name} does not come to an end")
        for name in ("service", "worker"):
            if self._running[name].exitcode is not None:
                self._day.faults.append(f"{name} ended by itself")

    def stop(self) -> None:
        """Ends all."""
        for process in self._running.values():
            process.kill()
            process.join()

    def _begin(self, centre: Path, url: str) -> None:
        (self._folder / "copies").mkdir()
        with made_centre(centre, 0) as made:
            codes = [new_code(made, _MAP, "head", "lab") for _ in _ROBOTS]
        self._running = {name: self._starts[name]() for name in ("service", "worker")}
        for name, code in zip(_ROBOTS, codes, strict=True):
            _enrolled(self._folder / name, url, code)
            self._running[name] = self._starts[name]()

    def _new(self, work: Callable[..., None], *given: object) -> BaseProcess:
        process = self._context.Process(target=work, args=given)
        process.start()
        return process

    def _look(self) -> None:
        for name, process in self._running.items():
            if process.exitcode is not None:
                fact = f"{name} ended by itself with {process.exitcode}"
                self._day.faults.append(fact)
                self._running[name] = self._starts[name]()


def _enrolled(folder: Path, url: str, code: str) -> None:
    end_s = time.monotonic() + _LONGEST_S
    while True:
        try:
            enrol(folder, url, code, folder.name)
            return
        except EngramError:  # the service is still starting
            if time.monotonic() > end_s:
                raise
            time.sleep(_LOOK_S)


def one_day(folder: Path, number: int, kills: int, pause_s: float, seed: int = 0) -> Day:
    """A day with so many kills, and so long between them in the mean."""
    chance, day = random.Random(f"{seed} {number}"), Day(number)
    fleet = Fleet(folder, day)
    spared, before = 0, 0
    try:
        while len(day.kills) < kills:
            time.sleep(chance.uniform(0.0, 2.0 * pause_s))
            name = chance.choice(["service", "worker", *_ROBOTS])
            if name == "worker":
                settled = fleet.settled()
                spared, before = (spared + 1 if settled == before else 0), settled
                if spared >= 2:
                    continue
            fleet.kill(name)
        fleet.end_day()
    finally:
        fleet.stop()
    day.faults += faults(folder, day)
    return day


def faults(folder: Path, day: Day) -> Iterator[str]:
    """What is lost, was done twice, or differs from merging the files."""
    with Centre(folder / "centre") as centre:
        rows = handins.listed(centre, _MAP)
        place = centre.map_path(_MAP)
        with centre.database.reading() as connection:
            broken = first_broken(connection)
    day.handins = len(rows)
    if broken is not None:
        yield f"audit log changed at row {broken}"
    yield from (f"hand-in {row.id} is {row.state}" for row in rows if row.state != "merged")
    driven = set[tuple[str, int]]()
    for path in (place, *(folder / name / "live" / "map.engram" for name in _ROBOTS)):
        yield from (f"{path.parent.parent.name}: {one}" for one in check_file(path).problems)
    for name in _ROBOTS:
        driven |= _own_drives(folder / name / "live" / "map.engram", name)
    day.drives = len(driven)
    with Map.open(place) as store:
        content = store.content_hash()
        held = [(one.robot, one.start_ns) for one in store.sessions.values()]
        sources = [one.configuration["merge"]["source"] for one in store.log()]
    if sorted(held) != sorted(driven):
        yield f"{len(driven)} drives, {len(held)} in the fleet map"
    if len(set(sources)) != len(sources):
        yield "a hand-in made two revisions"
    merged = sorted((row for row in rows if row.state == "merged"), key=lambda row: row.place or 0)
    files = [folder / "copies" / f"{row.content_hash}.engram" for row in merged]
    merge(folder / "files.engram", files, MergeOptions(relocaliser="none"))
    with Map.open(folder / "files.engram") as store:
        if store.content_hash() != content:
            yield "the files make another map"


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--a-day", type=int, default=10, help="kills of one day")
    parser.add_argument("--pause", type=float, default=3.0, help="between two kills, mean, s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="one JSON line for each day, resumable")
    asked = parser.parse_args()
    out: Path | None = asked.out
    lines = out.read_text().splitlines() if out is not None and out.exists() else []
    days = [Day(**json.loads(line)) for line in lines]
    while sum(len(day.kills) for day in days) < asked.kills:
        with tempfile.TemporaryDirectory() as folder:
            days.append(one_day(Path(folder), len(days), asked.a_day, asked.pause, asked.seed))
        if out is not None:
            with out.open("a") as file:
                file.write(json.dumps(asdict(days[-1])) + "\n")
        for fault in days[-1].faults:
            print(f"day {days[-1].number}: {fault}", flush=True)
    figures = [
        Figure("kills", sum(len(day.kills) for day in days)),
        Figure("days", len(days)),
        Figure("drives", sum(day.drives for day in days)),
        Figure("hand-ins", sum(day.handins for day in days)),
        Figure("faults", sum(len(day.faults) for day in days)),
    ]
    report(figures, asked.json, "kills at random moments of a fleet's day")
    sys.exit(any(day.faults for day in days))


if __name__ == "__main__":
    main()
