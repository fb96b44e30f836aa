"""A centre that is hindered, by a full disk say: jobs wait, nothing is refused, it says why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from engram.errors import EngramError, MapCorruptError, StorageFullError
from engram.fleet.centre import downloads, handins, jobs, merge_job, worker
from engram.fleet.centre.database import _errors
from engram.fleet.centre.merge_job import KilledError
from engram.fleet.centre.service import Centre
from engram.fleet.centre.tables import HandIn

from .conftest import NAME, POLICY, drive

pytestmark = pytest.mark.usefixtures("in_process")


def handed(site) -> HandIn:
    """A complete hand-in."""
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    agent.hand_in()
    agent.step()
    return jobs.pending(site.centre, HandIn, NAME)[0]


def full(*_, **__):
    raise StorageFullError("no space is left")


def test_a_hand_in_waits_for_a_full_disk_and_says_so(site, monkeypatch):
    row = handed(site)
    with monkeypatch.context() as patch:
        patch.setattr(merge_job, "merge", full)
        for _ in range(site.centre.settings.merge_tries + 1):
            with pytest.raises(EngramError, match=r"fleet: hand-in .* waits: no space is left"):
                site.work()
    row = jobs.get(site.centre, HandIn, row.id)
    assert (row.state, row.progress) == ("complete", "waits: no space is left")
    site.settle()
    assert jobs.get(site.centre, HandIn, row.id).state == "merged"


def test_a_held_out_drive_that_is_gone_refuses_no_hand_in(site, tmp_path):
    row = handed(site)
    gone = replace(POLICY, gate=(str(tmp_path / "gone.framelog"),))
    site.centre.set_policy(NAME, gone, "tests")
    with pytest.raises(EngramError, match=r"gone\.framelog"):
        site.work()
    site.centre.set_policy(NAME, POLICY, "tests")
    site.work()
    assert jobs.get(site.centre, HandIn, row.id).state == "merged"


def test_a_map_that_is_hindered_hinders_no_other(site, monkeypatch):
    row, merged = handed(site), []

    def of_one(centre, row):
        if row.map == NAME:
            raise merge_job.WaitsError("its disk is full")
        merged.append(row.map)

    monkeypatch.setattr(merge_job, "merge_hand_in", of_one)
    site.centre.add_map("town", "tests", POLICY)
    with site.centre.database.writing() as connection:
        in_town = replace(row, id="town", map="town", place=row.place + 1)
        site.centre.database.add(connection, in_town)
    with pytest.raises(merge_job.WaitsError):
        site.work()
    assert merged == ["town"]


def test_a_download_is_made_when_there_is_room_again(site, monkeypatch):
    handed(site)
    site.work()
    robot = site.robot("r2")
    robot.step()
    drive(robot.live, "r2", 2_000)
    robot.hand_in()
    robot.step()
    with monkeypatch.context() as patch:
        patch.setattr(downloads, "download", full)
        with pytest.raises(StorageFullError):
            site.work()
    assert not jobs.pending(site.centre, HandIn, NAME)  # a merge takes less room
    site.settle()
    assert robot.status()["staged"] is not None


def test_a_check_that_is_killed_is_made_again_but_not_for_ever(site, monkeypatch):
    row = handed(site)

    def killed(*_):
        raise KilledError("the check was killed")

    monkeypatch.setattr(merge_job, "admit", killed)
    for _ in range(site.centre.settings.merge_tries):
        with pytest.raises(EngramError, match="waits: the check was killed"):
            site.work()
    site.work()
    row = jobs.get(site.centre, HandIn, row.id)
    assert row.state == "failed"
    assert "died 3 times; an operator may have it merged anyway" in row.error


def test_two_workers_do_not_make_the_same_download(site, monkeypatch):
    handed(site)
    site.work()
    robot, real, made = site.robot("r2"), downloads.download, []
    robot.step()

    def beside_another_worker(*given, **options):
        made.append(given)
        assert site.work() == 0
        return real(*given, **options)

    monkeypatch.setattr(downloads, "download", beside_another_worker)
    site.work()
    assert len(made) == 1
    site.settle()
    assert robot.status()["staged"] is not None


def test_a_worker_goes_on_after_what_hindered_it_and_tells_it(site, monkeypatch, caplog):
    row, waits = handed(site), []
    monkeypatch.setattr(merge_job, "merge", full)

    def wait(seconds):
        waits.append(seconds)
        monkeypatch.undo()

    monkeypatch.setattr(merge_job, "admit", lambda *_: full())
    monkeypatch.setattr(worker.work_off, "__defaults__", (merge_job.merge_hand_in,))
    worker.work(site.centre, wait, lambda: len(waits) == 1)
    assert waits == [worker._AGAIN_S]
    assert f"hand-in {row.id[:8]} waits: no space is left; tried again in" in caplog.text


def test_a_full_disk_of_the_tables_is_told_apart():
    engine = create_engine("sqlite://")
    with engine.connect() as connection:
        connection.execute(text("PRAGMA max_page_count = 1"))
        with pytest.raises(StorageFullError, match="database or disk is full"), _errors():
            connection.execute(text("CREATE TABLE x (y)"))


def test_robots_learn_that_the_centre_is_full_and_send_again(site, monkeypatch):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    agent.hand_in()
    with monkeypatch.context() as patch:
        patch.setattr(type(site.centre.objects), "put", full)
        agent.step()
        assert "(507): no space is left" in str(agent.trouble)
        assert [row["state"] for row in agent.status()["outbox"]] == ["queued"]
    site.settle()
    assert [row["state"] for row in agent.status()["outbox"]] == ["settled"]


def test_errors_do_not_say_where_the_centre_lies(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "to?wn").symlink_to(tmp_path / "elsewhere")
    with Centre(tmp_path / "elsewhere") as centre:
        centre.add_map(NAME, "tests")
    with Centre(Path("to?wn")) as centre:
        assert centre.map_names() == [NAME]
        with centre.reading(NAME) as store, pytest.raises(EngramError) as told:
            store.resolve(9)
        assert centre.words_of(told.value).startswith("maps/fleet.engram has revisions")
        assert centre.words_of(MapCorruptError("x")) == "x"


def test_a_hand_in_that_expired_is_open_again_when_its_robot_is_back(site):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    agent.hand_in()
    site.link.fates = ["well", "well", "well", "well", "lost"]  # begun, and no part arrives
    agent.step()
    (row,) = handins.listed(site.centre, NAME)
    assert row.state == "open"
    site.clock.forward(15 * 86_400)
    site.work()
    assert jobs.get(site.centre, HandIn, row.id).state == "cancelled"
    site.settle()
    assert jobs.get(site.centre, HandIn, row.id).state == "merged"
