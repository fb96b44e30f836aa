"""A file that is no map, or no longer the one that was written: found, named, never a crash."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import sqlite3
import threading
from collections.abc import Callable
from functools import partial
from itertools import islice

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import Table

from engram.errors import (
    EngramError,
    InputError,
    MapCorruptError,
    MapError,
    MapLockedError,
    NotAMapError,
    RevisionError,
    StorageFullError,
)
from engram.graph.model import path_id
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.rows import sealed
from engram.maps.schema import edges, nodes, path_entries, placements, revisions
from engram.maps.totals import read_in_stretches
from engram.sqlite import SqliteFile

from .frames import assert_same_landmarks
from .maps import Drive, assert_same_edges, begin, session, write_drive


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A map of two committed sessions, and what is in it."""
    path = tmp_path_factory.mktemp("sound") / "town.engram"
    drives = []
    with Map.create(path) as store:
        for name in ("robot-1", "robot-2"):
            writer = begin(store, session(name))
            drives.append(write_drive(writer, 3))
            writer.commit()
    return path, drives


@pytest.fixture
def broken(sound, tmp_path):
    """A copy to break."""
    return shutil.copy(sound[0], tmp_path / "broken.engram")


def assert_unharmed(path, drives: list[Drive]) -> None:
    with Map.open(path) as store:
        contents = store.load()
        assert contents.sessions == tuple(drive.session for drive in drives)
        assert contents.nodes == tuple(node for drive in drives for node in drive.nodes)
        assert_same_edges(contents.edges, [edge for drive in drives for edge in drive.edges])
        assert contents.path_entries == tuple(e for drive in drives for e in drive.entries)
        assert len(contents.attempts) == sum(len(drive.attempts) for drive in drives)
        assert len(store.log()) == 2
        for drive in drives:
            for node, frame in drive.frames.items():
                assert_same_landmarks(store.frames.frame(node).landmarks, frame.landmarks)


def read_all(path) -> None:
    with Map.open(path) as store:
        for node in store.load().nodes:
            store.frames.frame(node.id)
            store.frames.thumbnail(node.id)
        store.log()
        store.info()
        store.content_hash()


def assert_found_or_harmless(path, drives: list[Drive]) -> None:
    try:
        report = check_file(path)
    except MapError:
        return
    if report.sound:
        assert_unharmed(path, drives)
        return
    with contextlib.suppress(EngramError):  # any other error is a failure
        read_all(path)


@given(where=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_flipped_bit_anywhere_is_found_or_harmless(sound, tmp_path, where, bit):
    original, drives = sound
    content = bytearray(original.read_bytes())
    content[int(where * len(content))] ^= 1 << bit
    path = tmp_path / "flipped.engram"
    path.write_bytes(content)
    assert_found_or_harmless(path, drives)


@given(share=st.floats(0, 1, exclude_max=True))
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_truncated_file_is_found(sound, tmp_path, share):
    original, _ = sound
    content = original.read_bytes()
    path = tmp_path / "cut.engram"
    path.write_bytes(content[: int(share * len(content))])
    try:
        report = check_file(path)
    except MapError:
        return
    assert not report.sound


@given(content=st.binary(max_size=300), head=st.sampled_from([0, 16, 100, 4096]))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_bytes_are_no_map(sound, tmp_path, content, head):
    path = tmp_path / "random.engram"
    path.write_bytes(sound[0].read_bytes()[:head] + content)
    with pytest.raises(MapError):
        Map.open(path)


def test_each_wrong_file_gets_its_own_error(tmp_path, broken):
    empty, text, folder = tmp_path / "empty", tmp_path / "text", tmp_path / "folder"
    empty.touch()
    text.write_text("not a map, but long enough to have a header" * 5)
    folder.mkdir()
    other = tmp_path / "other.sqlite"
    with sqlite3.connect(other) as connection:
        connection.execute("CREATE TABLE t (x)")
    for path, fact in (
        (tmp_path / "missing", "no such file"),
        (empty, "empty file"),
        (text, "is not a map"),
        (folder, "folder"),
        (other, "an SQLite file, but not a map"),
    ):
        for opener in (Map.open, partial(Map.open, writes=True), check_file):
            with pytest.raises(NotAMapError, match=fact):
                opener(path)


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE VIEW sneaky AS SELECT 1",
        "CREATE TRIGGER sneaky AFTER INSERT ON nodes BEGIN DELETE FROM edges; END",
        "CREATE TABLE sneaky (x)",
        "DROP TABLE vocabularies",
        "ALTER TABLE nodes ADD COLUMN sneaky INTEGER",
        "ALTER TABLE nodes ADD COLUMN sneaky INTEGER AS (key + 1) VIRTUAL",
    ],
)
def test_a_strangers_tables_views_and_triggers_are_refused(broken, statement):
    with sqlite3.connect(broken) as connection:
        connection.execute(statement)
    connection.close()
    with pytest.raises(MapCorruptError, match=r"sneaky|vocabularies|'nodes' is not a plain table"):
        Map.open(broken)


def test_creating_never_replaces_anything(tmp_path, broken):
    before = broken.read_bytes()
    with pytest.raises(InputError, match="exists already"):
        Map.create(broken)
    assert broken.read_bytes() == before
    with pytest.raises(InputError, match="is not a folder"):
        Map.create(tmp_path / "nowhere" / "town.engram")


def test_a_link_to_a_map_is_the_same_map(tmp_path, broken):
    link = tmp_path / "link.engram"
    link.symlink_to(broken)
    with Map.open(broken, writes=True), pytest.raises(MapLockedError):
        Map.open(link, writes=True)


def test_a_map_is_made_where_there_are_no_hard_links(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "no hard links")

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "town.engram"
    Map.create(path).close()
    assert check_file(path).problems == ()
    with pytest.raises(InputError, match="exists already"):
        Map.create(path)


def change(path, statement: str, *values: object) -> None:
    with sqlite3.connect(path) as connection:
        assert connection.execute(statement, values).rowcount == 1
    connection.close()


def insert_row(path, table: Table, row: dict[str, object]) -> None:
    sealed(table, row)
    marks = ", ".join("?" * len(row))
    names = ", ".join(row)
    change(path, f"INSERT INTO {table.name} ({names}) VALUES ({marks})", *row.values())


def problems(path) -> list[str]:
    return [str(problem) for problem in check_file(path).problems]


class TestCheckNamesTableUuidAndFact:
    def test_a_flipped_byte_of_a_landmark_blob(self, broken, sound):
        node = sound[1][0].nodes[1].id
        change(
            broken,
            "UPDATE frames SET landmarks = CAST(substr(landmarks, 1, 99) || x'ff' || "
            "substr(landmarks, 101) AS BLOB) WHERE node = (SELECT key FROM nodes WHERE uuid = ?)",
            node.bytes,
        )
        (fact, *_) = problems(broken)
        assert fact == f"frames {node}: does not match its checksum"
        with Map.open(broken) as store, pytest.raises(MapCorruptError, match=str(node)):
            store.frames.frame(node)

    def test_a_changed_stamp(self, broken, sound):
        node = sound[1][1].nodes[2].id
        change(broken, "UPDATE nodes SET stamp_ns = stamp_ns + 1 WHERE uuid = ?", node.bytes)
        assert f"nodes {node}: does not match its checksum" in problems(broken)
        with Map.open(broken) as store, pytest.raises(MapCorruptError, match=str(node)):
            store.load()

    def test_whoever_meets_damage_is_told_the_map_once(self, broken, sound):
        node = sound[1][1].nodes[2]
        with Map.open(broken) as store:
            change(broken, "UPDATE nodes SET stamp_ns = 0 WHERE uuid = ?", node.id.bytes)
            for read in (
                store.load,
                store.verified_hash,
                lambda: store.frames.frame(node.id),
                lambda: list(store.frames.stored([node])),
            ):
                with pytest.raises(MapCorruptError) as raised:
                    read()
                assert str(raised.value).startswith(f"{broken.resolve()}: table nodes: {node.id}")
                assert str(raised.value).count(broken.name) == 1

    def test_a_missing_node(self, broken, sound):
        node = sound[1][0].nodes[1].id
        change(broken, "DELETE FROM nodes WHERE uuid = ?", node.bytes)
        found = problems(broken)
        first = sound[1][0].nodes[0].id
        expected = f"edges {first} → row 2 (odometry): its b (row 2 of nodes) is missing"
        assert expected in found
        assert any("path_entries" in fact and "is missing" in fact for fact in found)
        assert "nodes: revision 1 added 3 rows, but 2 are stored" in found

    def test_a_missing_frame(self, broken, sound):
        node = sound[1][0].nodes[1].id
        change(
            broken,
            "DELETE FROM frames WHERE node = (SELECT key FROM nodes WHERE uuid = ?)",
            node.bytes,
        )
        assert f"nodes {node}: its frame is missing" in problems(broken)

    def test_a_missing_session_and_a_missing_camera(self, broken, sound):
        drive = sound[1][1]
        change(broken, "DELETE FROM sessions WHERE uuid = ?", drive.session.id.bytes)
        expected = f"nodes {drive.nodes[0].id}: its session (row 2 of sessions) is missing"
        assert expected in problems(broken)
        change(broken, "DELETE FROM cameras")
        assert any("camera (row 1 of cameras) is missing" in fact for fact in problems(broken))

    def test_a_dangling_edge_with_a_right_checksum(self, broken, sound):
        insert_row(
            broken,
            edges,
            {
                "key": 99,
                "revision": 1,
                "a": 1,
                "b": 77,
                "kind": "match",
                "a_from_b": bytes(96),
                "covariance": bytes(168),
            },
        )
        found = problems(broken)
        name = f"edges {sound[1][0].nodes[0].id} → row 77 (match)"
        assert f"{name}: its b (row 77 of nodes) is missing" in found
        assert any(fact.startswith(f"{name}: its rotation is off") for fact in found)

    def test_an_edge_that_is_not_finite(self, broken):
        row = {
            "key": 99,
            "revision": 1,
            "a": 1,
            "b": 2,
            "kind": "match",
            "a_from_b": b"\xff" * 96,
            "covariance": bytes(168),
        }
        insert_row(broken, edges, row)
        assert any("(match)" in fact and "not finite" in fact for fact in problems(broken))

    def test_a_reference_into_a_later_revision(self, broken, sound):
        row = {
            "key": 99,
            "revision": 1,
            "path": 1,
            "sequence": 50,
            "node": 5,
            "kind": "matched",
            "stamp_ns": 0,
        }
        insert_row(broken, path_entries, row)
        node = sound[1][1].nodes[1].id
        expected = (
            f"path_entries {path_id(sound[1][0].session.id)} #50: its node ({node} of nodes) is of "
            "a revision that is not before its own"
        )
        assert expected in problems(broken)

    def test_a_place_that_is_filed_elsewhere(self, broken):
        with sqlite3.connect(broken) as connection:
            connection.row_factory = sqlite3.Row
            row = dict(connection.execute("SELECT * FROM placements WHERE key = 2").fetchone())
        connection.close()
        change(broken, "DELETE FROM placements WHERE key = 2")
        insert_row(broken, placements, {**row, "cell": row["cell"] + 1})
        (problem,) = problems(broken)
        assert problem.startswith(f"placements row 2: it is filed in cell {row['cell'] + 1}")

    def test_a_uuid_that_is_none(self, broken):
        row = {
            "key": 99,
            "uuid": b"short",
            "revision": 1,
            "session": 1,
            "camera": 1,
            "frontend": 1,
            "stamp_ns": 0,
            "driven_m": 0.0,
            "status": "ok",
            "landmark_hash": bytes(16),
        }
        insert_row(broken, nodes, row)
        assert any("nodes row 99" in fact and "UUID" in fact for fact in problems(broken))

    def test_a_broken_index(self, broken):
        with sqlite3.connect(broken) as connection:
            page_bytes = connection.execute("PRAGMA page_size").fetchone()[0]
            (page,) = connection.execute(
                "SELECT rootpage FROM sqlite_schema WHERE name = 'sqlite_autoindex_nodes_1'"
            ).fetchone()
        connection.close()
        content = bytearray(broken.read_bytes())
        content[page * page_bytes - 5] ^= 1
        broken.write_bytes(content)
        assert any(fact.startswith("file: ") for fact in problems(broken))


@pytest.mark.parametrize("table", ["nodes", "sessions", "paths", "edges", "cameras"])
def test_a_page_that_cannot_be_read_is_found_whoever_refers_to_its_rows(broken, table):
    with contextlib.closing(sqlite3.connect(broken)) as connection:
        (size,) = connection.execute("PRAGMA page_size").fetchone()
        query = "SELECT rootpage FROM sqlite_schema WHERE name = ?"
        (page,) = connection.execute(query, [table]).fetchone()
    body = bytearray(broken.read_bytes())
    body[(page - 1) * size : page * size] = bytes(size)
    broken.write_bytes(body)
    assert any("malformed" in one and one.startswith(table) for one in problems(broken))


class TestCheckSinceARevision:
    def test_only_later_rows_are_read(self, broken, sound):
        whole, later = check_file(broken), check_file(broken, since=1)
        assert later.problems == ()
        assert later.rows < whole.rows
        assert check_file(broken, since="head~1") == later
        assert check_file(broken, since=2).rows < later.rows
        node = sound[1][0].nodes[1].id
        change(broken, "UPDATE frames SET landmarks = x'00' WHERE node = 2")
        assert check_file(broken, since=1).problems == ()
        (fact,) = check_file(broken, since=0).problems[:1]
        assert str(fact) == f"frames {node}: does not match its checksum"

    @pytest.mark.parametrize(
        ("statement", "fact"),
        [
            ("UPDATE frames SET landmarks = x'00' WHERE node = 5", "does not match its checksum"),
            ("UPDATE nodes SET stamp_ns = 0 WHERE key = 5", "does not match its checksum"),
            ("DELETE FROM edges WHERE key = 4", "revision 2 added 2 rows, but 1 are stored"),
            ("DELETE FROM frames WHERE node = 6", "its frame is missing"),
            ("DELETE FROM sessions WHERE key = 2", "its session (row 2 of sessions) is missing"),
            ("DELETE FROM revisions WHERE key = 1", "is number 1 of the history"),
        ],
    )
    def test_damage_in_later_rows_is_found(self, broken, statement, fact):
        change(broken, statement)
        assert any(fact in str(one) for one in check_file(broken, since=1).problems)

    def test_later_rows_are_those_that_were_hashed(self, broken):
        with sqlite3.connect(broken) as connection:
            connection.row_factory = sqlite3.Row
            row = dict(connection.execute("SELECT * FROM nodes WHERE key = 5").fetchone())
        connection.close()
        change(broken, "DELETE FROM nodes WHERE key = 5")
        insert_row(broken, nodes, {**row, "driven_m": 99.0})
        (problem,) = check_file(broken, since=1).problems
        assert "revision 2: its rows have the content hash" in problem.fact

    @pytest.mark.parametrize("key", [1, 2])
    def test_a_committed_revision_without_a_number_is_found(self, broken, key):
        with sqlite3.connect(broken) as connection:
            connection.row_factory = sqlite3.Row
            found = connection.execute("SELECT * FROM revisions WHERE key = ?", [key])
            row = dict(found.fetchone())
            tie = dict(connection.execute("SELECT * FROM edges WHERE revision = 2").fetchone())
        connection.close()
        change(broken, "DELETE FROM revisions WHERE key = ?", key)
        insert_row(broken, revisions, {**row, "number": None})
        insert_row(broken, edges, {**tie, "key": 100, "a": 1})  # to a node of the first
        facts = problems(broken)
        assert any("is committed and has the number None" in fact for fact in facts)

    def test_keys_beyond_the_largest_end_a_reading(self, broken):
        with sqlite3.connect(broken) as connection:
            connection.row_factory = sqlite3.Row
            row = dict(connection.execute("SELECT * FROM placements").fetchone())
        connection.close()
        insert_row(broken, placements, {**row, "key": 2**63 - 1})
        with Map.open(broken) as store:
            parts = store._read(
                lambda connection, view: list(
                    islice(read_in_stretches(connection, view, placements), 9)
                )
            )
        assert len(parts) == 2

    def test_a_revision_that_is_not_there_is_refused(self, broken):
        with pytest.raises(RevisionError, match="1 to 2"):
            check_file(broken, since=3)


def in_a_child_without_rights(work: Callable[[], list[str]]) -> list[str]:
    """Permissions do not bind root: do the work in a child process that is somebody else."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            if os.geteuid() == 0:
                os.setgroups([])
                os.setgid(65534)
                os.setuid(65534)
            os.write(write, "\n".join(work()).encode())
        except BaseException as error:
            os.write(write, repr(error).encode())
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        lines = pipe.read().splitlines()
    os.waitpid(child, 0)
    return lines


def test_a_map_on_read_only_media_is_read(sound, tmp_path_factory):
    folder = tmp_path_factory.mktemp("media")
    path = shutil.copy(sound[0], folder / "town.engram")
    for parent in folder.parents[:3]:
        if parent.owner() == folder.owner():
            parent.chmod(0o755)
    path.chmod(0o444)
    folder.chmod(0o555)

    def read() -> list[str]:
        with Map.open(path) as store:
            frames = [store.frames.frame(node.id) for node in store.load().nodes]
        try:
            Map.open(path, writes=True)
        except MapError as error:
            refusal = str(error)
        return [str(len(frames)), str(check_file(path).problems), refusal]

    count, found, refusal = in_a_child_without_rights(read)
    assert (count, found) == ("6", "()")
    assert "read-only" in refusal
    assert sorted(file.name for file in folder.iterdir()) == ["town.engram"]
    folder.chmod(0o755)


def test_a_map_written_under_a_reader_without_rights_is_no_damaged_one(sound, tmp_path_factory):
    """SQLite cannot follow what others write from a folder where nothing can be made."""
    folder = tmp_path_factory.mktemp("shared")
    path = shutil.copy(sound[0], folder / "town.engram")
    for parent in folder.parents[:3]:
        if parent.owner() == folder.owner():
            parent.chmod(0o755)
    folder.chmod(0o555)
    opened, go_on = folder.parent / "opened", folder.parent / "go-on"
    for pipe in (opened, go_on):
        os.mkfifo(pipe)
        pipe.chmod(0o666)

    def write() -> None:
        opened.read_bytes()
        folder.chmod(0o755)
        with Map.open(path, writes=True) as store:
            store.tag("seen", author="tester")
        folder.chmod(0o555)
        go_on.write_bytes(b"")

    def read() -> list[str]:
        with Map.open(path) as store:
            first = len(store.load().nodes)
            opened.write_bytes(b"")
            go_on.read_bytes()
            try:
                told = str(len(store.load().nodes))
            except MapError as error:
                told = f"{type(error).__name__}: {error}"
        with Map.open(path) as store:
            return [str(first), told, str(len(store.load().nodes))]

    writer = threading.Thread(target=write)
    writer.start()
    first, told, again = in_a_child_without_rights(read)
    writer.join()
    folder.chmod(0o755)
    assert (first, again) == ("6", "6")
    assert told.startswith("MapError: ")
    assert "was written since it was opened" in told


def test_a_map_on_a_full_disk_is_read(sound, tmp_path, monkeypatch):
    """There is no room for the file in which readers and writers agree."""
    path = shutil.copy(sound[0], tmp_path / "town.engram")
    connect = SqliteFile.connect

    def no_room(self: SqliteFile, options: str) -> object:
        if "immutable" in options or self.path != path:
            return connect(self, options)
        error = sqlite3.OperationalError("disk I/O error")
        error.sqlite_errorcode = sqlite3.SQLITE_IOERR_SHMSIZE
        raise error

    monkeypatch.setattr(SqliteFile, "connect", no_room)
    with Map.open(path) as store:
        assert len(store.load().nodes) == 6
    # A log may hold what the file does not have yet.
    path.with_name("town.engram-wal").write_bytes(b"something")
    with pytest.raises(StorageFullError, match="cannot grow"):
        Map.open(path)


@pytest.mark.parametrize("gone", ["key = 2", "key = 1", "TRUE"])
def test_tags_that_are_gone_with_their_rows_are_missed(broken, gone):
    with Map.open(broken, writes=True) as store:
        for name in ("good", "better"):
            store.tag(name, 1, author="tests")
    assert check_file(broken).problems == ()
    with contextlib.closing(sqlite3.connect(broken)) as connection, connection:
        connection.execute(f"DELETE FROM tags WHERE {gone}")
    (problem,) = check_file(broken).problems
    assert "counts 2 rows of tags" in problem.fact


def test_tables_that_a_disk_exchanged_are_found_by_the_check(sound, broken):
    with Map.open(broken, writes=True) as store:
        store.tag("one", 1, author="tests")
    with contextlib.closing(sqlite3.connect(broken)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        found = connection.execute("SELECT name, rootpage FROM sqlite_schema WHERE type = 'table'")
        roots = dict(found.fetchall())
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    whole = broken.read_bytes()
    for name, root in roots.items():
        if name == "tags":
            continue
        body = bytearray(whole)
        one, other = (slice((at - 1) * size, at * size) for at in (root, roots["tags"]))
        body[one], body[other] = whole[other], whole[one]
        broken.write_bytes(body)
        assert not check_file(broken).sound, name
