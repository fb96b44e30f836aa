"""What the service says that it keeps is on the disk, though one sync serves many."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import select

from engram.errors import MapError
from engram.fleet.centre.database import ServiceDatabase
from engram.fleet.centre.tables import Usage, usage

THREADS = 8


@pytest.fixture
def database(tmp_path):
    found = ServiceDatabase(f"sqlite:///{tmp_path / 'centre.sqlite'}")
    yield found
    found.close()


def write(database, subject: str, *, durable: bool = True) -> None:
    with database.writing(durable=durable) as connection:
        database.put(connection, Usage(subject, day=1, bytes=1))


def days(database) -> set[str]:
    with database.reading() as connection:
        return set(connection.execute(select(usage.c.subject)).scalars())


@pytest.fixture
def syncs(monkeypatch):
    """Each sync of a file by `os.fsync`: what its file holds then."""
    found: list[bytes] = []
    real = os.fsync

    def fsync(file: int) -> None:
        found.append(os.pread(file, 2**24, 0))
        real(file)

    monkeypatch.setattr(os, "fsync", fsync)
    return found


def test_a_row_is_synced_before_its_writer_goes_on(database, syncs):
    for name in ("first-robot", "second-robot"):
        write(database, name)
        assert name.encode() in syncs[-1]
    assert len(syncs) == 2


def test_what_is_said_again_by_itself_waits_for_no_disk(database, syncs):
    write(database, "a-robot", durable=False)
    assert not syncs
    assert days(database) == {"a-robot"}


def test_one_sync_serves_all_who_committed_before_it_began(database, syncs, monkeypatch):
    begun, go_on, waiting = threading.Event(), threading.Event(), threading.Semaphore(0)
    held, sync = os.fsync, database._log.sync

    def counted() -> None:
        waiting.release()
        sync()

    def first(file: int) -> None:
        monkeypatch.setattr(os, "fsync", held)
        begun.set()
        assert go_on.wait(60)
        held(file)

    monkeypatch.setattr(os, "fsync", first)
    monkeypatch.setattr(database._log, "sync", counted)
    names = [f"robot-{number}" for number in range(THREADS)]
    with ThreadPoolExecutor(THREADS + 1) as threads:
        leader = threads.submit(write, database, "leader")
        assert begun.wait(60)
        others = [threads.submit(write, database, name) for name in names]
        assert all(waiting.acquire(timeout=60) for _ in ("leader", *names))
        assert days(database) == {"leader", *names}  # committed, but not kept yet
        assert not any(one.done() for one in others)
        go_on.set()
        for one in (leader, *others):
            one.result()
    # The leader's, then one for those who committed meanwhile; who came late makes another.
    assert all(any(name.encode() in body for body in syncs[1:]) for name in names)
    assert len(syncs) < 1 + THREADS


def test_a_disk_that_fails_is_an_error_and_the_next_writer_tries_again(database, monkeypatch):
    real = os.fsync

    def fails(file: int) -> None:
        monkeypatch.setattr(os, "fsync", real)
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(MapError, match="Input/output error"):
        write(database, "a-robot")
    write(database, "another")
    assert days(database) == {"a-robot", "another"}


def test_a_log_that_was_moved_into_the_database_needs_no_sync(database, tmp_path, syncs):
    write(database, "a-robot")
    database.close()  # the last connection takes the log away
    assert not (tmp_path / "centre.sqlite-wal").exists()
    syncs.clear()
    database._log.sync()
    assert not syncs
