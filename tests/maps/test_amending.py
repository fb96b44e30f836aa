"""What is set right about a session: an overlay, and who has the last word."""

import sqlite3

import pytest

from engram.errors import ConfigError, InputError
from engram.graph.clock import hour_of_day
from engram.graph.model import Amendable, Amendment, Clock
from engram.maps.map import Map
from engram.maps.map_files import check_file

from .maps import begin, session, write_drive

DRIVE = session("robot-1")


@pytest.fixture
def path(tmp_path):
    made = tmp_path / "town.engram"
    with Map.create(made) as store:
        writer = begin(store, DRIVE)
        write_drive(writer, 3)
        writer.commit()
    return made


def amend(path, **changes):
    with Map.open(path) as store:
        named = {Amendable(what): value for what, value in changes.items()}
        return store.amend(DRIVE.id, named, author="tests")


def test_an_amendment_changes_what_is_shown_and_no_record(path):
    with Map.open(path) as store:
        before, records = store.load(), store.record_hashes()
    revision = amend(path, robot="lorry", zone="Asia/Tokyo")
    assert revision.contents["amendments"] == 2
    with Map.open(path) as store:
        shown = store.sessions[DRIVE.id]
        assert (shown.robot, shown.zone, shown.longitude_deg) == ("lorry", "Asia/Tokyo", None)
        assert shown.as_recorded == DRIVE
        assert store.load().nodes == before.nodes
        changed = {**records, "amendments": store.record_hashes()["amendments"]}
        assert store.record_hashes() == changed
    with Map.open(path, at=1) as store:
        assert store.sessions[DRIVE.id] == DRIVE
    assert check_file(path).problems == ()


def test_a_start_gives_a_clock_and_moves_the_hours_of_all_stamps(path):
    hour_ns = 3_600_000_000_000
    amend(path, start=str(5 * hour_ns), zone="Etc/UTC")
    with Map.open(path) as store:
        shown = store.sessions[DRIVE.id]
    assert (shown.clock, shown.start_ns, shown.begin_ns) == (Clock.UTC, DRIVE.start_ns, 5 * hour_ns)
    assert hour_of_day(shown, DRIVE.start_ns + hour_ns // 2) == pytest.approx(5.5)


def test_the_latest_revision_has_the_last_word_and_can_be_reverted(path):
    amend(path, robot="lorry")
    amend(path, robot="van")
    with Map.open(path) as store:
        assert store.sessions[DRIVE.id].robot == "van"
        store.revert(3, author="tests")
        assert store.sessions[DRIVE.id].robot == "lorry"
        store.revert(2, author="tests")
        assert store.sessions[DRIVE.id] == DRIVE
    assert check_file(path).problems == ()


@pytest.mark.parametrize(
    ("changes", "error", "fact"),
    [
        ({"zone": "Middle/Earth"}, ConfigError, "unknown"),
        ({"start": "noon"}, InputError, "not valid as the start"),
        ({"robot": ""}, InputError, "not valid as the robot"),
        ({"robot": "robot-1"}, InputError, "nothing to amend"),
    ],
)
def test_what_cannot_be_said_leaves_the_map_alone(path, changes, error, fact):
    with pytest.raises(error, match=fact):
        amend(path, **changes)
    with Map.open(path) as store:
        assert store.revision == 1
        assert store.amendments == ()


def test_a_session_that_is_not_there_cannot_be_amended(path):
    other = session("robot-2").id
    with Map.open(path) as store, pytest.raises(InputError, match="no session"):
        store.amend(other, {Amendable.ROBOT: "van"}, author="tests")


def test_an_amendment_that_another_map_brings_counts_once(path, tmp_path):
    """The order of the map's own revisions decides, not when something was said."""
    amend(path, robot="lorry")
    late, early = (
        Amendment(DRIVE.id, Amendable.ROBOT, name, amended_ns=at)
        for name, at in (("late", 2**62), ("early", 1))
    )
    with Map.open(path, writes=True) as store:
        for one in (late, early, late):
            about = {"author": "tests", "message": "", "configuration": {}}
            with store.begin_revision(**about) as writer:
                writer.add_amendment(one)
                writer.commit()
        assert store.sessions[DRIVE.id].robot == "early"
        assert [one.value for one in store.amendments] == ["lorry", "late", "early"]


def test_the_content_hash_covers_amendments(path):
    with Map.open(path) as store:
        before = store.content_hash()
    amend(path, robot="lorry")
    with Map.open(path) as store:
        assert store.content_hash() != before
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE amendments SET value = 'van'")
    connection.close()
    assert check_file(path).problems[0].table == "amendments"
