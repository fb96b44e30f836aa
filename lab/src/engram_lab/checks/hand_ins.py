"""The evening of a fleet: many robots hand in distinct drives, and a centre of one worker merges.

    python -m engram_lab.checks.hand_ins --nodes 100000 --hand-ins 40

The centre holds a synthetic city (`engram lab evaluate scale`) whose streets all have landmarks of
their own. Each robot downloads the stretch on which it will drive, drives along a street of its
own, half of it through places that look new, and hands in: all of them at once, over real sockets.
While the centre merges, another robot asks for downloads elsewhere, spread over the evening. The
seconds of a hand-in include downloads made before it; its time of a core is that of the processes
that the worker starts for it.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from engram.fleet.agent.agent import Agent
from engram.fleet.agent.agent_state import AgentSettings
from engram.fleet.agent.centre_link import enrol
from engram.fleet.centre import handins
from engram.fleet.centre.access import new_code
from engram.fleet.centre.service import Centre
from engram.fleet.centre.tables import ENDED, HandIn, JobState
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram_lab.checks.centre_load import (
    MAP,
    answers,
    children_of,
    first_byte_s,
    served,
    used_below,
)
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.scale import FIRST_NS, LANE, City, write_drive
from engram_lab.synthetic_places import CAMERA, DESCRIPTOR, FRONTEND, drive_of

_BEGIN = 20  # the metre of its street at which a robot begins
_AT_ONCE = 8
_SAMPLED_S = 0.1
_ASKED_S = 0.5
_FEW = 5


@dataclass(frozen=True, slots=True)
class Robot:
    """One of a fleet that drives along a street of its own.

    Attributes:
        places: metres of the street that it drives.
    """

    number: int
    folder: Path
    street: int
    places: range

    @staticmethod
    def of(number: int, folder: Path, city: City, nodes: int) -> Robot:
        """The robot of a number; where there are more than streets, they continue along them."""
        round_, street = divmod(number, city.streets)
        begin = (_BEGIN + round_ * nodes) % max(city.length - nodes, 1)
        places = range(begin, min(begin + nodes, city.length))
        return Robot(number, folder / f"r{number}", street, places)

    def download(self, url: str, code: str, city: City) -> float:
        """Enrols and fetches its stretch; seconds until it can drive with it."""
        middle = city.node(self.street, LANE, (self.places[0] + self.places[-1]) // 2)
        radius_m = len(self.places) / 2 + 10.0
        stretch = {"select": "region", "near": [str(middle.id)], "radius_m": radius_m}
        enrol(self.folder, url, code, self.folder.name)
        begun_s = time.monotonic()
        with Agent(self.folder, AgentSettings(download=stretch)) as agent:
            while not agent.switch():
                agent.step()
                if agent.trouble is not None:
                    raise agent.trouble
                time.sleep(_SAMPLED_S)
        return time.monotonic() - begun_s

    def drive(self, city: City) -> None:
        """Adds a drive to its map."""
        made = drive_of(self.folder.name, 3 * FIRST_NS + self.number * 3_600_000_000_000)
        with (
            Map.open(self.folder / "live" / "map.engram", writes=True) as live,
            live.begin_session(
                made,
                CAMERA,
                descriptor=DESCRIPTOR,
                frontend=FRONTEND,
                author=self.folder.name,
                configuration={},
            ) as writer,
        ):
            write_drive(writer, city, made, self.street, self.places)
            writer.commit()

    def hand_in(self) -> tuple[str, int]:
        """Sends its drive; its id, and when the centre had all of it, UTC, ns.

        Raises:
            EngramError: the centre did not take it.
        """
        with Agent(self.folder) as agent:
            agent.hand_in()
            agent.step(fetch=False)
            if agent.trouble is not None:
                raise agent.trouble
            return str(agent.state.facts.robot), time.time_ns()


@dataclass(slots=True)
class Usage:
    """What the processes of a centre used, in time.

    Attributes:
        stamps_ns: of the samples, UTC.
        merging_s: time of a core until then, of the processes that the worker started.
        memory: greatest sum of the peaks of the worker and of those that ran at once, bytes.
    """

    stamps_ns: list[int] = field(default_factory=list)
    merging_s: list[float] = field(default_factory=list)
    memory: float = 0.0

    def sample(self, pid: int) -> None:
        """Looks at the processes below a service; one may end just then: it counts next time."""
        try:
            merging_s = sum(used_below(child)[0] for child in children_of(pid))
            _, memory = used_below(pid)
        except (FileNotFoundError, ProcessLookupError):
            return
        self.stamps_ns.append(time.time_ns())
        self.merging_s.append(max([merging_s, *self.merging_s[-1:]]))
        self.memory = max(self.memory, memory)

    def between(self, begun_ns: int, ended_ns: int) -> float:
        """Time of a core between two moments, s."""
        at = np.interp([begun_ns, ended_ns], self.stamps_ns, self.merging_s)
        return float(at[1] - at[0])


@contextmanager
def sampled(pid: int) -> Iterator[Usage]:
    """Samples what the processes below a service use, for the length of the block."""
    used, over = Usage(), threading.Event()

    def keep() -> None:
        while not over.wait(_SAMPLED_S):
            used.sample(pid)

    thread = threading.Thread(target=keep)
    thread.start()
    try:
        yield used
    finally:
        over.set()
        thread.join()
        used.sample(pid)


def evening(
    folder: Path, city: City, robots: int, driven: int, downloads: int, kept: Path | None = None
) -> list[Figure]:
    """Lets robots hand in drives of so many nodes, and another one ask for downloads meanwhile.

    Args:
        folder: an empty one.
        city: what the centre holds.
        robots: each hands in once.
        driven: nodes of each drive.
        downloads: number of them.
        kept: file of the city, made if it is missing; None for none.
    """
    with Centre(folder / "centre") as centre:
        path = folder / "centre" / "maps" / f"{MAP}.engram"
        if kept is None:
            city.write(path)
        else:
            city.keep(kept)
            shutil.copyfile(kept, path)
        centre.add_map(MAP, "lab")
        codes = [new_code(centre, MAP, "head", "lab") for _ in range(robots + 1)]
    fleet = [Robot.of(number, folder, city, driven) for number in range(robots)]
    with served(folder / "centre") as service, ThreadPoolExecutor(_AT_ONCE) as threads:
        enrol(folder / "visitor", service.url, codes.pop(), "visitor")
        fetched_s = []
        for robot, code in zip(fleet, codes, strict=True):
            fetched_s.append(robot.download(service.url, code, city))
            robot.drive(city)
        load = os.getloadavg()[0]
        with sampled(service.pid) as used:
            sent, asked_s = threads.map(Robot.hand_in, fleet), []
            for at in range(downloads):
                _wait(service.url, at * robots // downloads)
                asked_s.append(first_byte_s(folder / "visitor", _elsewhere(city, at)))
            sent_ns = dict(sent)
            _wait(service.url, robots)
        served_figures = answers(service.url)
    with Centre(folder / "centre") as centre:
        rows = sorted(handins.listed(centre, MAP), key=lambda row: row.place or 0)
        problems = check_file(centre.map_path(MAP)).problems
        with centre.reading(MAP) as grown:
            added = grown.node_count() - city.nodes
    merged = [row for row in rows if row.state == JobState.MERGED]
    return [
        Figure("load before", load),
        Figure("hand-ins merged", len(merged)),
        Figure("hand-ins failed", robots - len(merged)),
        Figure("nodes added", added),
        Figure("problems of the map", len(problems)),
        *_times(merged, sent_ns, used),
        Figure("peak of the worker and its processes", used.memory / 1e6, "MB"),
        *_waits("robots' downloads, until they can drive", fetched_s),
        *_waits("downloads meanwhile, until the manifest", asked_s),
        *served_figures,
    ]


def _wait(url: str, settled: int) -> None:
    """Waits until so many hand-ins have ended, merged or not."""
    ended = 0
    while ended < settled:
        time.sleep(_ASKED_S)
        told = httpx.get(f"{url}/v1/metrics", timeout=60.0).text
        states = dict(re.findall(r'engram_handins\{state="(\w+)"\} (\d+)', told))
        ended = sum(int(states.get(state, 0)) for state in ENDED)


def _elsewhere(city: City, number: int) -> dict[str, Any]:
    """A mission of about 2,000 nodes, on another street than those before it."""
    node = city.node(7 * number % city.streets, 1, city.length // 2)
    return {"select": "region", "near": [str(node.id)], "radius_m": 200.0}


def _times(rows: Sequence[HandIn], sent_ns: Mapping[str, int], used: Usage) -> Iterator[Figure]:
    """What merging took: of the first hand-ins, of the last ones, and of all."""
    ended_ns = [row.ended_ns or 0 for row in rows]
    free_ns = [min(sent_ns.values()), *ended_ns]
    begun_ns = [max(sent_ns[row.robot], free) for row, free in zip(rows, free_ns, strict=False)]
    spans = list(zip(begun_ns, ended_ns, strict=True))
    yield Figure("until all were ready", (ended_ns[-1] - begun_ns[0]) / 60e9, "min")
    yield Figure("of a core, merging", used.between(begun_ns[0], ended_ns[-1]) / 60.0, "min")
    for name, taken in (
        ("seconds", [(ended - begun) / 1e9 for begun, ended in spans]),
        ("seconds of a core", [used.between(*span) for span in spans]),
    ):
        yield Figure(f"a hand-in, {name}: first", taken[0], "s")
        yield Figure(f"a hand-in, {name}: last", taken[-1], "s")
        first, last = (float(np.median(some)) for some in (taken[:_FEW], taken[-_FEW:]))
        yield Figure(f"a hand-in, {name}: median of the first {_FEW}", first, "s")
        yield Figure(f"a hand-in, {name}: median of the last {_FEW}", last, "s")
        yield Figure(f"a hand-in, {name}: last by first medians", last / first)


def _waits(what: str, taken_s: Sequence[float]) -> Iterator[Figure]:
    yield Figure(f"{what}: median of {len(taken_s)}", float(np.median(taken_s)), "s")
    yield Figure(f"{what}: longest", float(np.max(taken_s)), "s")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--nodes", type=int, default=100_000, help="of the city")
    parser.add_argument("--hand-ins", type=int, default=40)
    parser.add_argument("--driven", type=int, default=300, help="nodes of each drive")
    parser.add_argument("--downloads", type=int, default=10, help="requested meanwhile")
    parser.add_argument("--city", type=Path, metavar="FILE", help="keep the city here")
    asked = parser.parse_args()
    city = City.of(asked.nodes)
    city = replace(city, distinct=city.streets)
    with tempfile.TemporaryDirectory() as folder:
        figures = evening(
            Path(folder), city, asked.hand_ins, asked.driven, asked.downloads, asked.city
        )
    title = f"{asked.hand_ins} hand-ins of {asked.driven} nodes into {city.nodes}"
    report(figures, asked.json, title)
    failed = {"hand-ins failed", "problems of the map", "server errors"}
    sys.exit(any(one.value for one in figures if one.name in failed))


if __name__ == "__main__":
    main()
