"""A map of format 6 becomes one of this format: the same rows, or it stays as it was."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from tests.maps.test_format import STORED

from engram.errors import FormatVersionError, MapCorruptError, MapLockedError, StorageFullError
from engram.maps import upgrading
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.upgrading import upgrade_map

OLD = STORED.with_name("format-6.engram")


@pytest.fixture
def old(tmp_path: Path) -> Path:
    return Path(shutil.copy(OLD, tmp_path / "town.engram"))


def version_of(path: Path) -> int:
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])


def rows_of(path: Path) -> list[tuple[object, ...]]:
    """The rows of all tables but those that an upgrade changes."""
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
        names = [row[0] for row in connection.execute(
            "SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name"
        )]  # fmt: skip
        rewritten = {"revisions", "map_format", "runs", "attempts", "hidden", "placements"}
        kept = [name for name in names if name not in rewritten]
        return [row for name in kept for row in connection.execute(f"SELECT * FROM {name}")]


def test_it_holds_the_same_and_answers_the_same(old: Path) -> None:
    before = rows_of(old)
    done = upgrade_map(old)
    assert (done.before, done.after, done.revisions) == (6, 7, 6)
    assert done.after_bytes <= 1.4 * done.before_bytes  # each new table or index takes a page
    assert rows_of(old) == before
    assert check_file(old).problems == ()
    for at in range(1, 5):  # later ones hold the time at which they were made
        with Map.open(old, at=at) as upgraded, Map.open(STORED, at=at) as written:
            assert upgraded.record_hashes() == written.record_hashes()
            assert upgraded.totals().agrees(written.totals())
            assert set(upgraded.load().nodes) == set(written.load().nodes)
            assert upgraded.verified_hash() == upgraded.content_hash()


def test_it_can_be_written_on_and_upgraded_once(old: Path) -> None:
    upgrade_map(old)
    with Map.open(old, writes=True) as store:
        (left,) = store.interrupted()
        assert store.seal(left.session.id).contents["nodes"] == 2
        store.revert("head", author="tests")
    assert check_file(old).problems == ()
    content = old.read_bytes()
    assert upgrade_map(old).before == 7
    assert old.read_bytes() == content


def test_a_format_before_6_is_refused(old: Path) -> None:
    with closing(sqlite3.connect(old)) as connection:
        connection.execute("PRAGMA user_version=5")
    with pytest.raises(FormatVersionError, match="map the drives of older ones again"):
        upgrade_map(old)


def test_while_another_process_has_it_open_it_stays(old: Path) -> None:
    with closing(sqlite3.connect(old)) as reader:
        reader.execute("SELECT count(*) FROM nodes").fetchone()
        with pytest.raises(MapLockedError, match="close it there first"):
            upgrade_map(old)
    assert version_of(old) == 6


def test_what_comes_out_otherwise_is_not_kept(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    complete = upgrading.complete_history

    def loses_an_edge(connection: object) -> int:
        count = complete(connection)
        connection.exec_driver_sql("DELETE FROM edges WHERE key = 2")
        return count

    monkeypatch.setattr(upgrading, "complete_history", loses_an_edge)
    before = rows_of(old)
    with pytest.raises(MapCorruptError, match="edges"):
        upgrade_map(old)
    assert (version_of(old), rows_of(old)) == (6, before)
    assert [one.name for one in old.parent.iterdir() if one.suffix == ".draft"] == []


def test_a_full_disk_leaves_the_old_map(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def is_full(connection: sqlite3.Connection) -> None:
        connection.execute("PRAGMA journal_mode=OFF")
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
        connection.execute(f"PRAGMA max_page_count={pages}")

    monkeypatch.setattr(upgrading, "_without_log", is_full)
    before = rows_of(old)
    with pytest.raises(StorageFullError):
        upgrade_map(old)
    assert (version_of(old), rows_of(old)) == (6, before)


_KILLED = """
import os, signal, sys
from pathlib import Path
from engram.maps import upgrading
name, calls = sys.argv[2], 0
def stop(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)
if name == "replace":
    Path.replace = stop
else:
    setattr(upgrading, name, stop)
upgrading.upgrade_map(Path(sys.argv[1]))
"""


@pytest.mark.parametrize("at", ["_convert", "complete_history", "_compare", "replace"])
def test_killed_anywhere_the_map_is_sound_and_the_command_begins_again(old: Path, at: str) -> None:
    before = rows_of(old)
    ended = subprocess.run([sys.executable, "-c", _KILLED, old, at], check=False, timeout=120)
    assert ended.returncode == -signal.SIGKILL
    assert (version_of(old), rows_of(old)) == (6, before)
    assert upgrade_map(old).after == 7
    assert check_file(old).problems == ()
    left = {one.name for one in old.parent.iterdir()}
    assert left <= {old.name, f"{old.name}-lock", f"{old.name}-wal", f"{old.name}-shm"}
    assert os.access(old, os.W_OK)
