"""A centre of a test, with a clock that the test turns, and robots with small maps."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import create_engine, make_url, text
from tests.maps.maps import begin, session, write_drive

from engram.fleet.agent.agent import Agent
from engram.fleet.agent.centre_link import enrol
from engram.fleet.centre import merge_job
from engram.fleet.centre.access import Role, add_person, new_code
from engram.fleet.centre.application import create_app
from engram.fleet.centre.merge_job import write_checked
from engram.fleet.centre.service import Centre, CentreSettings, MapPolicy
from engram.fleet.centre.worker import work_off
from engram.fleet.merge.merge_settings import MergeOptions
from engram.maps.map import Map, open_map

from .faults import FlakyClient

NAME = "fleet"
# Random descriptors match nothing: what is tested here is who has what, not where.
POLICY = MapPolicy(merge=MergeOptions(relocaliser="none"))


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
    """A centre with its HTTP interface and its worker in one process, and robots.

    `restart` is what a kill leaves: everything is opened again from disk.
    """

    def __init__(self, folder: Path, **options: object) -> None:
        self.folder = folder
        self.clock = Clock()
        self.options = options
        self.agents: dict[str, Agent] = {}
        self._open()
        self.centre.add_map(NAME, "tests", POLICY)

    def _open(self) -> None:
        self.centre = Centre(self.folder / "centre", clock=self.clock, **self.options)
        self.http = TestClient(create_app(self.centre))
        self.link = FlakyClient(self.http)

    def restart(self) -> None:
        self.close()
        self._open()
        for name in self.agents:
            self.agents[name] = self._agent(name)

    def close(self) -> None:
        self.centre.close()
        for agent in self.agents.values():
            agent.close()

    def token(self, role: Role | str, name: str = NAME) -> dict[str, str]:
        return {"Authorization": f"Bearer {add_person(self.centre, role, name, Role(role))}"}

    def robot(self, name: str, follows: str = "head", on: str = NAME) -> Agent:
        """A robot that has enrolled on a map."""
        if name not in self.agents:
            code = new_code(self.centre, on, follows, "tests")
            enrol(self.folder / name, "http://centre", code, name, self.http)
            self.agents[name] = self._agent(name)
        return self.agents[name]

    def _agent(self, name: str) -> Agent:
        return Agent(self.folder / name, client=self.link, chance=lambda: 0.0)

    def work(self) -> int:
        return work_off(self.centre, merge_job.merge_hand_in)

    def settle(self) -> None:
        """Until nobody has anything to do."""
        for _ in range(20):
            waits = [agent.step() for agent in self.agents.values()]
            if not self.work() and min(waits, default=1.0) > 0:
                return
        raise AssertionError([agent.status() for agent in self.agents.values()])

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


KINDS = ["embedded", *(["services"] if os.environ.get("ENGRAM_TEST_POSTGRES") else [])]


@pytest.fixture(scope="session")
def s3():
    """Address of a bucket that moto's server keeps, for the length of the session."""
    server = pytest.importorskip("moto.server", reason="no moto: make test-services")
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    address = f"http://{host}:{port}"
    httpx.put(f"{address}/engram").raise_for_status()
    known = {"ENDPOINT_URL": address, "ALLOW_HTTP": "true", "REGION": "us-east-1"}
    keys = {"ACCESS_KEY_ID": "tests", "SECRET_ACCESS_KEY": "tests"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**known, **keys}.items():
            patch.setenv(f"AWS_{name}", value)
        yield "s3://engram"
    running.stop()


@pytest.fixture(params=KINDS)
def site(request, tmp_path):
    """A centre in a folder; and one on PostgreSQL and a bucket where ENGRAM_TEST_POSTGRES says."""
    with opened_site(request, tmp_path) as found:
        yield found


@contextmanager
def opened_site(request, folder: Path) -> Iterator[Site]:
    """A site of the kind that is the request's parameter."""
    options = {}
    if request.param == "services":
        options["objects"] = f"{request.getfixturevalue('s3')}/{uuid.uuid4().hex}"
        options["database"] = new_database()
    found = Site(folder, **options)
    yield found
    found.close()
    if request.param == "services":
        drop_database(options["database"])


@pytest.fixture(params=KINDS)
def apart(request, tmp_path):
    """A site, and the centre of a second worker, whose folders share nothing.

    Embedded they share an SQLite file and a folder of objects.
    """
    shared = tmp_path / "shared"
    (shared / "objects").mkdir(parents=True)
    database, objects = f"sqlite:///{shared / 'centre.sqlite'}", f"file://{shared / 'objects'}"
    if request.param == "services":
        objects = f"{request.getfixturevalue('s3')}/{uuid.uuid4().hex}"
        database = new_database()
    # Workers die more often than a hand-in may be the cause of.
    settings = CentreSettings(merge_tries=1_000)
    found = Site(tmp_path / "first", database=database, objects=objects, settings=settings)
    found.centre.keep_copies(NAME, "tests")
    with Centre(tmp_path / "second", database, objects, settings, found.clock) as other:
        yield found, other
    found.close()
    if request.param == "services":
        drop_database(database)


def new_database() -> str:
    """Address of an empty database of its own."""
    url = make_url(os.environ["ENGRAM_TEST_POSTGRES"])
    name = f"centre_{uuid.uuid4().hex}"
    _run(url, f'CREATE DATABASE "{name}"')
    return url.set(database=name).render_as_string(hide_password=False)


def drop_database(address: str) -> None:
    _run(os.environ["ENGRAM_TEST_POSTGRES"], f'DROP DATABASE "{make_url(address).database}"')


def _run(url, statement: str) -> None:
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(statement))
    engine.dispose()


@pytest.fixture
def in_process(monkeypatch):
    """Admission without a process of its own: the same steps, and faults reach them."""
    monkeypatch.setattr(merge_job, "admit", admit_here)


def admit_here(manifest, parts, path, *limits) -> None:
    write_checked(manifest, parts, path)
