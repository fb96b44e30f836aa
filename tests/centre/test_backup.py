"""Backups: of what is in the folder, after which robots may forget what they handed in."""

from __future__ import annotations

from dataclasses import replace

import pytest
from sqlalchemy import update

from engram.errors import InputError, StorageFullError
from engram.fleet.centre import serving
from engram.fleet.centre.fleet import move_ref, revision_of
from engram.fleet.centre.service import Centre
from engram.fleet.centre.serving import back_up
from engram.fleet.centre.tables import handins
from engram.maps.map import Map
from engram.maps.map_files import copy_map

from .conftest import NAME, drive


def test_a_backup_holds_the_folder_and_robots_may_forget(site, in_process, tmp_path):
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000)
    agent.hand_in()
    site.settle()
    assert back_up(site.centre, tmp_path / "backup") == {NAME: 1}
    assert site.centre.map_row(NAME).durable_revision == 1
    with Map.open(tmp_path / "backup" / "maps" / f"{NAME}.engram") as copy:
        assert copy.content_hash() == site.content()
    # PostgreSQL and a bucket are copied by their own tools.
    database, bucket = site.centre.addresses
    assert (tmp_path / "backup" / "centre.sqlite").exists() == (database is None)
    assert (tmp_path / "backup" / "objects").exists() == (bucket is None)
    with pytest.raises(InputError, match="exists already"):
        back_up(site.centre, tmp_path / "backup")


def test_a_map_whose_file_is_gone_is_not_made_anew(site):
    site.centre.close()
    path = site.centre.map_path(NAME)
    path.unlink()
    with pytest.raises(InputError, match=r"fleet\.engram is missing, .*restore it"):
        site.centre.add_map(NAME, "tests")
    assert not path.exists()
    health = site.http.get(f"/maps/{NAME}/health", headers=site.token("viewer"))
    assert "the file of the map is gone" in health.text


def test_robots_hand_in_again_what_an_older_file_that_was_put_back_lacks(
    site, in_process, tmp_path
):
    agent = site.robot("r1", follows="stable")
    drive(agent.live, "r1", 1_000)
    agent.hand_in()
    site.settle()
    path = site.centre.map_path(NAME)
    copy_map(path, tmp_path / "older.engram")
    drive(agent.live, "r1", 2_000)
    agent.hand_in()
    site.settle()
    move_ref(site.centre, NAME, "stable", 2, "tests")
    row = replace(site.centre.map_row(NAME), durable_revision=2)
    with site.centre.database.writing() as connection:
        site.centre.database.put(connection, row)
        tried = site.centre.settings.merge_tries
        connection.execute(update(handins).values(tries=tried))
    site.centre.close()
    for one in path.parent.glob(f"{path.name}*"):
        one.unlink()
    (tmp_path / "older.engram").rename(path)
    site.restart()
    site.centre.add_map(NAME, "tests")
    assert site.centre.map_row(NAME).durable_revision == 1
    assert revision_of(site.centre, NAME, "stable") == 1
    site.settle()
    with Map.open(path) as store:
        assert {one.start_ns for one in store.sessions.values()} == {1_000, 2_000}
    states = [row["state"] for row in site.agents["r1"].status()["outbox"]]
    assert states == ["settled"]  # the first is in a backup


def test_tables_that_name_no_map_are_those_of_another_centre(tmp_path):
    with (
        Centre(tmp_path / "centre") as centre,
        pytest.raises(InputError, match="set ENGRAM_DATABASE"),
    ):
        back_up(centre, tmp_path / "backup")
    assert not (tmp_path / "backup").exists()


def test_a_backup_that_does_not_fit_leaves_nothing_and_robots_forget_nothing(
    site, in_process, tmp_path, monkeypatch
):
    def full(*_):
        raise StorageFullError("no space is left")

    with monkeypatch.context() as patch:
        patch.setattr(serving, "copy_map", full)
        with pytest.raises(StorageFullError):
            back_up(site.centre, tmp_path / "held" / "backup")
    assert list((tmp_path / "held").iterdir()) == []
    assert site.centre.map_row(NAME).durable_revision == 0
    assert back_up(site.centre, tmp_path / "held" / "backup") == {NAME: 0}
