"""A centre of a test, with a clock that the test turns, and robots with small maps."""

from __future__ import annotations

from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from tests.maps.maps import begin, session, write_drive

from engram.agent import Agent, enrol
from engram.centre.access.enrolment import add_person, new_code
from engram.centre.access.roles import Role
from engram.centre.api.app import create_app
from engram.centre.service import Centre, MapPolicy
from engram.centre.worker.loop import work_off
from engram.fleet.merge import MergeOptions
from engram.maps import Map, open_map

NAME = "fleet"
# Random descriptors match nothing: what is tested here is who has what, not where.
POLICY = MapPolicy(merge=MergeOptions(relocaliser=None))


class Clock:
    """The time of a centre."""

    def __init__(self) -> None:
        self.now_ns = 1_700_000_000_000_000_000

    def __call__(self) -> int:
        self.now_ns += 1_000
        return self.now_ns

    def forward(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


class Site:
    """A centre with its HTTP interface and its worker, in one process."""

    def __init__(self, folder: Path, **options: object) -> None:
        self.folder = folder
        self.clock = Clock()
        self.options = options
        self.centre = Centre(folder / "centre", clock=self.clock, **options)
        self.centre.add_map(NAME, "tests", POLICY)
        self.http = TestClient(create_app(self.centre))

    def token(self, role: Role | str, name: str = NAME) -> dict[str, str]:
        return {"Authorization": f"Bearer {add_person(self.centre, role, name, Role(role))}"}

    def robot(self, name: str, follows: str = "head", **options: object) -> Agent:
        folder = self.folder / name
        enrol(
            folder, "http://centre", new_code(self.centre, NAME, follows, "tests"), name, self.http
        )
        return Agent(folder, client=self.http, chance=lambda: 0.0, **options)

    def work(self) -> int:
        return work_off(self.centre)

    def content(self) -> str:
        with Map.open(self.centre.map_path(NAME)) as store:
            return store.content_hash()


def drive(path: Path, robot: str, start_ns: int, nodes: int = 3) -> None:
    """One more drive in a map, which is made if there is none."""
    path.parent.mkdir(exist_ok=True)
    with open_map(path, create=True) as store, store.writing():
        writer = begin(store, session(robot, start_ns))
        write_drive(writer, nodes)
        writer.commit()


@pytest.fixture
def site(tmp_path):
    found = Site(tmp_path)
    yield found
    found.centre.close()
