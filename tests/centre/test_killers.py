"""Hand-ins that would kill a worker end by themselves, with a report; the worker goes on."""

from __future__ import annotations

import ctypes
import os
import signal
import sqlite3
from contextlib import closing, suppress

import pytest

from engram.errors import EngramError
from engram.fleet.centre import handins, jobs, merge_job
from engram.fleet.centre.tables import HandIn
from engram.fleet.centre.worker import work, work_off
from engram.maps.map import Map
from engram.maps.rows import sealed
from engram.maps.schema import sessions
from engram.maps.sqlite import SqliteDatabase
from engram.maps.upgrading import complete_history

from .conftest import NAME, drive


def handed(site, robot: str, start_ns: int = 1_000) -> HandIn:
    """A complete hand-in of a robot."""
    agent = site.robot(robot)
    drive(agent.live, robot, start_ns)
    agent.hand_in()
    agent.step()
    return jobs.pending(site.centre, HandIn, NAME)[-1]


def state_of(site, row: HandIn) -> tuple[str, str | None]:
    found = jobs.get(site.centre, HandIn, row.id)
    return found.state, found.error


def end_by_signal(pipe, folder, addresses, settings, key) -> None:
    (folder / "work" / f"{key}.engram").write_bytes(b"half a map")
    os.kill(os.getpid(), signal.SIGKILL)


def end_by_a_fault_of_memory(pipe, folder, addresses, settings, key) -> None:
    signal.signal(signal.SIGSEGV, signal.SIG_DFL)
    ctypes.string_at(0)


def end_by_exit(pipe, folder, addresses, settings, key) -> None:
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("end", "how"),
    [
        (end_by_signal, "by SIGKILL"),
        (end_by_a_fault_of_memory, "by SIGSEGV"),
        (end_by_exit, "with exit code 3"),
    ],
)
def test_what_kills_its_process_is_not_taken_again_without_an_operator(site, monkeypatch, end, how):
    killer = handed(site, "r1")
    with monkeypatch.context() as patch:
        patch.setattr(merge_job, "_merge", end)
        assert work_off(site.centre) == 1
        state, error = state_of(site, killer)
        assert state == "failed"
        assert error == (
            f"the process that merged it ended {how}; an operator may have it merged anyway"
        )
        assert list((site.centre.folder / "work").iterdir()) == []
        assert work_off(site.centre) == 0
        handins.merge_anyway(site.centre, jobs.get(site.centre, HandIn, killer.id), "operator")
        assert work_off(site.centre) == 1
        assert state_of(site, killer)[0] == "failed"
    other = handed(site, "r2", 5_000)
    work_off(site.centre)
    assert state_of(site, other) == ("merged", None)


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize(
    "fault", [MemoryError, RecursionError, AssertionError, ValueError, KeyError]
)
def test_whatever_is_raised_over_a_hand_in_ends_that_one_alone(site, monkeypatch, fault, caplog):
    killer = handed(site, "r1")

    def raising(*_, **__):
        raise fault("x" * 10_000)

    with monkeypatch.context() as patch:
        patch.setattr(merge_job, "merge", raising)
        site.work()
    state, error = state_of(site, killer)
    assert state == "failed"
    assert error.startswith(f"an unexpected fault, {fault.__name__}: ")
    assert len(error) < 400
    assert "Traceback" in caplog.text
    other = handed(site, "r2", 5_000)
    site.work()
    assert state_of(site, other) == ("merged", None)


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("where", ["merge", "download"])
def test_a_worker_goes_on_after_a_fault_that_nobody_foresaw(site, monkeypatch, where):
    waits: list[float] = []

    def raising(*_, **__):
        raise AssertionError(where)

    handed(site, "r1")
    monkeypatch.setattr("engram.fleet.centre.worker.work_off", raising)
    work(site.centre, waits.append, lambda: len(waits) == 2)
    assert waits == [10.0, 10.0]


def with_session(agent, **values: object) -> None:
    """Changes the session of a robot's map, sealed as a stranger would."""
    columns = [column.name for column in sessions.columns]
    with closing(sqlite3.connect(agent.live)) as connection, connection:
        found = connection.execute(f"SELECT {', '.join(columns)} FROM sessions").fetchone()
        row = sealed(sessions, {**dict(zip(columns, found, strict=True)), **values})
        told = ", ".join(f"{name} = ?" for name in row)
        connection.execute(f"UPDATE sessions SET {told}", list(row.values()))
    with (
        suppress(EngramError),  # of what cannot be counted
        closing(SqliteDatabase(agent.live)) as database,
        database.writing() as connection,
    ):
        complete_history(connection)


STRANGE = {
    "newer": ({"zone": "Mars/Olympus_Mons", "longitude_deg": None}, "merged"),
    "local": ({"zone": "localtime", "longitude_deg": None}, "merged"),
    "path": ({"zone": "../../etc/passwd", "longitude_deg": None}, "failed"),
    "empty": ({"zone": "", "longitude_deg": None}, "failed"),
    "long": ({"zone": "Europe/" + "x" * 10_000, "longitude_deg": None}, "failed"),
    "zero": ({"zone": "Europe/Ber\0lin", "longitude_deg": None}, "failed"),
    "line": ({"zone": "Europe/Berlin\n", "longitude_deg": None}, "failed"),
    "nowhere": ({"zone": None, "longitude_deg": 1e300}, "failed"),
    "named": ({"robot": "r" * 100_000}, "failed"),
    "nameless": ({"robot": ""}, "failed"),
}


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(one, marks=[pytest.mark.long] * (one not in {"newer", "path", "named"}))
        for one in STRANGE
    ],
)
def test_sessions_of_strange_zones_and_names_harm_nobody(site, kind):
    values, expected = STRANGE[kind]
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    with_session(agent, **values)
    agent.hand_in()
    agent.step()
    site.work()
    rows = handins.listed(site.centre, NAME)
    # A map that Engram cannot read leaves its robot in no whole hand-in, either.
    assert [row.state for row in rows] == [expected] or (expected == "failed" and not rows)
    other = handed(site, "r2", 5_000)
    site.work()
    assert state_of(site, other)[0] == "merged"
    with Map.open(site.centre.map_path(NAME)) as store:
        assert len(store.sessions) == 1 + (expected == "merged")
