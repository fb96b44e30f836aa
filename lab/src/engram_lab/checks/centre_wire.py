"""Bytes on the wire of hand-ins: of a drive that saved nothing, of 50 new nodes, over a bad link.

    python -m engram_lab.checks.centre_wire

Service, worker and agent over real sockets, through a proxy that counts bytes both ways, headers
included. A robot hands in 200 nodes, then a drive of 500 frames along them that saves none, then 50
more nodes. Two other robots hand in 500 nodes each: one over a sound link, one over a link that
drops each connection after 500 kB.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from engram.fleet.agent.agent import Agent
from engram.fleet.agent.agent_state import AgentSettings
from engram.fleet.agent.centre_link import enrol, new_client
from engram.fleet.agent.outbox import QUEUED
from engram.fleet.centre.access import new_code
from engram.graph.model import Attempt, PathEntry, PathEntryKind, path_id
from engram.graph.paths import Attempts
from engram.maps.map import Map, open_map
from engram.maps.writer import RevisionWriter
from engram_lab.checks.centre_load import made_centre, served
from engram_lab.checks.merge_scaling import write_session
from engram_lab.fleet_day.day import cutting
from engram_lab.programs import Figure, command_line, report
from engram_lab.synthetic_places import CAMERA, DESCRIPTOR, FRONTEND, drive_of

_MAP = "fleet"
# A node of about 24 kB, as those of real cameras.
_LANDMARKS = 540
_FRAMES, _TRIED = 500, 3
_CUT_BYTES, _NEVER = 500_000, 2**62
_HASTY = AgentSettings(first_retry_s=0.05, longest_retry_s=0.2, idle_s=0.1)
_LOOK_S = 0.05


def mapped(path: Path, number: int, places: range) -> int:
    """A drive that saves a node at each place; returns the bytes of their blobs."""
    with _writing(path) as (_, writer):
        write_session(writer, path.parent.parent.name, number, places, None, _LANDMARKS)
        writer.commit()
    with Map.open(path) as store:
        newest = list(store.sessions)[-1]
        sizes = store.blob_sizes
        return sum(sum(sizes[one.id]) for one in store.graph.nodes if one.session == newest)


def localised(path: Path, number: int) -> None:
    """A drive that matches a saved node in every frame."""
    with _writing(path) as (store, writer):
        nodes = [node.id for node in store.graph.nodes]
        start_ns = 1_000_000_000_000 * (number + 1)
        drive = drive_of(path.parent.parent.name, start_ns)
        writer.add_session(drive, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND)
        made = []
        for at in range(_FRAMES):
            node = nodes[at % len(nodes)]
            stamp_ns = start_ns + at * 100_000_000
            writer.add_path_entry(
                PathEntry(path_id(drive.id), at, node, PathEntryKind.MATCHED, stamp_ns)
            )
            made += [
                Attempt(at, node, nodes[(at + rank) % len(nodes)], 0.3, 0.1, 0.01, 0.2, 0.01,
                        rank == 0, 80 if rank == 0 else 0, rank, "distance")
                for rank in range(_TRIED)
            ]  # fmt: skip
        writer.copy_attempts(drive.id, *Attempts.of(made))
        writer.commit()


@contextmanager
def _writing(path: Path) -> Iterator[tuple[Map, RevisionWriter]]:
    with (
        open_map(path, create=True) as store,
        store.writing(),
        store.begin_revision(author="lab", message="", configuration={}) as writer,
    ):
        yield store, writer


class Line:
    """The links of robots to a centre.

    Args:
        folder: of the robots.
        port: of the service.
    """

    def __init__(self, folder: Path, port: int) -> None:
        self._folder = folder
        self._port = port

    def enrol(self, name: str, code: str) -> Path:
        """Enrols a robot; returns its live map."""
        url = f"http://127.0.0.1:{self._port}"
        enrol(self._folder / name, url, code, name)
        return self._folder / name / "live" / "map.engram"

    def passed_bytes(self, name: str, cut_bytes: int = _NEVER) -> int:
        """Hands in what a robot has, until the centre has merged it; bytes both ways."""
        with cutting(self._port, cut_bytes) as proxy:
            client = new_client(f"http://127.0.0.1:{proxy.port}")
            with Agent(self._folder / name, _HASTY, client=client, wait=time.sleep) as agent:
                agent.hand_in()
                while self._is_queued(agent):
                    time.sleep(min(agent.step(fetch=False), _LOOK_S))
            return proxy.passed_bytes

    @staticmethod
    def _is_queued(agent: Agent) -> bool:
        return any(entry.state == QUEUED for entry in agent.state.outbox())


def measured(folder: Path) -> list[Figure]:
    """The figures."""
    with made_centre(folder / "centre", 0) as centre:
        codes = [new_code(centre, _MAP, "head", "lab") for _ in range(3)]
    with served(folder / "centre") as url:
        line = Line(folder, int(url.rsplit(":", 1)[1]))
        r1, r2, r3 = (line.enrol(f"r{at}", code) for at, code in enumerate(codes, 1))
        mapped(r1, 0, range(200))
        line.passed_bytes("r1")
        localised(r1, 1)
        saved_nothing = line.passed_bytes("r1")
        blobs = mapped(r1, 2, range(1_000, 1_050))
        new_nodes = line.passed_bytes("r1")
        mapped(r2, 0, range(2_000, 2_500))
        mapped(r3, 0, range(3_000, 3_500))
        sound, broken = line.passed_bytes("r2"), line.passed_bytes("r3", _CUT_BYTES)
    return [
        Figure("a drive of 500 frames that saved nothing", saved_nothing / 1e3, "kB"),
        Figure("50 new nodes, beyond 1.1 times their blobs", (new_nodes - 1.1 * blobs) / 1e3, "kB"),
        Figure("a link that breaks every 500 kB, over a sound one", broken / sound),
    ]


def main() -> None:
    asked = command_line(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report(measured(Path(folder)), asked.json, "hand-ins on the wire, both ways")


if __name__ == "__main__":
    main()
