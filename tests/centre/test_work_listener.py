"""A worker wakes when there is work, and looks by itself where nobody rings."""

from __future__ import annotations

import os
import threading
import time

import pytest

from engram.fleet.centre.database import WorkListener, notify

from .conftest import drive

# Far longer than an announcement takes.
_LONG_S = 60.0


needs_postgresql = pytest.mark.skipif(
    "ENGRAM_TEST_POSTGRES" not in os.environ, reason="no PostgreSQL: make test-services"
)


@pytest.fixture
def database(site) -> str:
    address = site.centre.addresses[0]
    if address is None:
        pytest.skip("SQLite announces nothing")
    return address


def test_without_announcements_a_worker_looks_after_a_while(tmp_path):
    slept: list[float] = []
    with WorkListener(f"sqlite:///{tmp_path / 'centre.sqlite'}", slept.append) as listener:
        listener.wait(3.0)
    with WorkListener(None, slept.append) as listener:
        listener.wait(4.0)
    assert slept == [3.0, 4.0]


def test_where_the_database_is_away_a_worker_looks_after_a_while():
    pytest.importorskip("psycopg")
    slept: list[float] = []
    nowhere = "postgresql+psycopg://engram@/postgres?host=/nowhere"
    with WorkListener(nowhere, slept.append) as listener:
        listener.wait(3.0)
    assert slept == [3.0]


@needs_postgresql
def test_a_complete_hand_in_wakes_a_worker(site, database):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    agent.hand_in()
    with WorkListener(database, time.sleep) as listener:
        listener.wait(_LONG_S)  # only begins to listen
        sender = threading.Thread(target=agent.step, kwargs={"fetch": False})
        started = time.monotonic()
        sender.start()
        listener.wait(_LONG_S)
        assert time.monotonic() - started < _LONG_S / 2
        sender.join()


@needs_postgresql
def test_a_broken_line_is_taken_up_again(site, database):
    slept: list[float] = []
    with WorkListener(database, slept.append) as listener:
        listener.wait(_LONG_S)
        listener._connection.close()
        listener.wait(_LONG_S)
        assert slept == [_LONG_S]
        listener.wait(_LONG_S)
        with site.centre.database.writing() as connection:
            notify(connection)
        started = time.monotonic()
        listener.wait(_LONG_S)
        assert time.monotonic() - started < _LONG_S / 2
