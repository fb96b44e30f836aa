"""Maps of strangers: nothing in their definitions is evaluated."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
from sqlalchemy import Table

from engram.errors import EngramError, MapCorruptError
from engram.graph.model import path_id
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.rows import sealed
from engram.maps.schema import (
    attempts,
    cameras,
    edges,
    frontends,
    nodes,
    path_entries,
    paths,
    revisions,
    sessions,
    tags,
)

from .maps import begin, node, session, write_drive

_COLUMNS = (
    '"key" INTEGER NOT NULL, revision INTEGER NOT NULL, name TEXT NOT NULL, body TEXT NOT NULL'
)
_REST = 'checksum INTEGER NOT NULL, PRIMARY KEY ("key"), UNIQUE (name, revision)'
# Each would run a query of minutes as soon as a row is looked at, checked or added.
_SLOW = "(length(hex(zeroblob(100000000))) > 0)"
DEFINITIONS = {
    "check": f"CREATE TABLE statistics ({_COLUMNS}, {_REST}, CHECK {_SLOW}) STRICT",
    "default": f"CREATE TABLE statistics ({_COLUMNS}, checksum INTEGER NOT NULL DEFAULT {_SLOW}, "
    'PRIMARY KEY ("key")) STRICT',
    "generated": f"CREATE TABLE statistics ({_COLUMNS}, checksum INTEGER NOT NULL AS {_SLOW}, "
    'PRIMARY KEY ("key")) STRICT',
    "collate": f"CREATE TABLE statistics ({_COLUMNS} COLLATE nocase, {_REST}) STRICT",
    "partial index": f"CREATE INDEX fast ON statistics (name) WHERE {_SLOW}",
    "index of an expression": "CREATE INDEX fast ON statistics (hex(zeroblob(100000000)))",
    "view": f"CREATE VIEW fast AS SELECT {_SLOW}",
    "trigger": "CREATE TRIGGER fast BEFORE INSERT ON nodes BEGIN SELECT zeroblob(9); END",
    "virtual table": "CREATE VIRTUAL TABLE fast USING fts5(body)",
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = tmp_path_factory.mktemp("strangers") / "town.engram"
    with Map.create(path) as store:
        writer = begin(store, session())
        write_drive(writer, 2)
        writer.commit()
    return path


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_definitions_that_hold_expressions_are_refused_unseen(tmp_path, sound, kind):
    path = shutil.copy(sound, tmp_path / "strange.engram")
    connection = sqlite3.connect(path)
    if DEFINITIONS[kind].startswith("CREATE TABLE"):
        connection.execute("DROP TABLE statistics")
    connection.execute(DEFINITIONS[kind])
    connection.commit()
    connection.close()
    with pytest.raises(MapCorruptError, match=r"not a plain table or index|not have the tables"):
        Map.open(path)
    assert check_file(path).problems


def test_a_name_in_a_definition_cannot_end_it(tmp_path, sound):
    path = shutil.copy(sound, tmp_path / "strange.engram")
    connection = sqlite3.connect(path)
    connection.execute('CREATE TABLE "x y" (a INTEGER) STRICT')
    connection.commit()
    connection.close()
    with pytest.raises(EngramError):
        Map.open(path)


def change(path, table: Table, **values: object) -> None:
    """Changes the first row under a right checksum, as a stranger can."""
    connection = sqlite3.connect(path)
    names = [one.name for one in table.columns]
    first = names[0]
    found = connection.execute(f"SELECT {', '.join(names)} FROM {table.name} ORDER BY 1").fetchone()
    row = sealed(table, dict(zip(names, found, strict=True)) | values)
    given = ", ".join(f"{name} = ?" for name in row)
    connection.execute(
        f"UPDATE {table.name} SET {given} WHERE {first} = ?", [*row.values(), found[0]]
    )
    connection.commit()
    connection.close()


STRANGE_ROWS = [
    (nodes, {"uuid": b"short"}),
    (nodes, {"session": 77}),
    (sessions, {"uuid": b""}),
    (sessions, {"clock": "cuckoo"}),
    (edges, {"a_from_b": b"\xff" * 96}),
    (paths, {"uuid": bytes(17)}),
    (path_entries, {"kind": "forged"}),
    (attempts, {"body": b"\x91" * 100_000}),
    (revisions, {"configuration": "[" * 100_000}),
    (revisions, {"contents": '{"nodes": "many"}'}),
    (frontends, {"descriptor": "unknown"}),
    (cameras, {"width": 2**62}),
]


def questions(store: Map) -> list[Callable[[], object]]:
    """What a merge and a download look up."""
    found, nodes = store.lookups, [node(session("robot-1"), at).id for at in range(2)]
    some = [session("robot-1").id, session("robot-2").id]
    return [
        lambda: found.nodes(nodes),
        lambda: found.omissions(nodes),
        lambda: found.landmark_hashes(nodes),
        lambda: found.blob_sizes(nodes),
        lambda: found.placements(nodes),
        lambda: found.edges(nodes),
        lambda: [found.entries(path_id(one)) for one in some],
        lambda: found.entry_counts([path_id(one) for one in some]),
        lambda: found.attempts(some),
        found.last_stamps_ns,
        found.runs,
        lambda: found.moves(1, []),
        lambda: store.pages.part(0, store.pages.end),
        lambda: store.pages.entries(0, store.pages.end, dict(enumerate(nodes))),
        lambda: store.pages.attempts(np.arange(2)),
    ]


@pytest.mark.parametrize(("table", "values"), STRANGE_ROWS)
def test_what_is_wrong_under_a_right_checksum_is_refused_by_name(tmp_path, sound, table, values):
    path = shutil.copy(sound, tmp_path / "strange.engram")
    change(path, table, **values)
    assert check_file(path).problems
    with suppress(EngramError), Map.open(path) as store:
        for read in (
            store.load,
            store.log,
            store.content_hash,
            store.info,
            lambda: store.graph,
            *questions(store),
            lambda: store.omissions,
            lambda: [store.frames.frame(node.id) for node in store.graph.nodes],
        ):
            with suppress(EngramError):  # any other error is a failure
                read()


def test_a_value_of_another_type_than_its_column_is_refused(tmp_path, sound):
    """A page that was moved into another table, or a table that once was not strict."""
    path = shutil.copy(sound, tmp_path / "strange.engram")
    connection = sqlite3.connect(path)
    (strict,) = connection.execute("SELECT sql FROM sqlite_schema WHERE name = 'frames'").fetchone()
    kept = connection.execute("SELECT * FROM frames ORDER BY 1").fetchall()
    connection.execute("DROP TABLE frames")
    connection.execute(strict.replace("STRICT", ""))
    for key, revision, _, thumbnail, checksum in kept:
        connection.execute(
            "INSERT INTO frames VALUES (?, ?, 'text', ?, ?)", [key, revision, thumbnail, checksum]
        )
    connection.execute("PRAGMA writable_schema = ON")
    connection.execute("UPDATE sqlite_schema SET sql = ? WHERE name = 'frames'", [strict])
    connection.commit()
    connection.close()
    assert check_file(path).problems
    with Map.open(path) as store:
        for node in store.load().nodes:
            with pytest.raises(MapCorruptError):
                store.frames.frame(node.id)


def test_a_key_that_leaves_no_room_is_found_and_nothing_is_written_after_it(tmp_path, sound):
    path = shutil.copy(sound, tmp_path / "strange.engram")
    with Map.open(path, writes=True) as store:
        store.tag("good", author="tests")
    change(path, tags, key=2**63 - 1)
    assert any("leaves no room" in str(one) for one in check_file(path).problems)
    with Map.open(path, writes=True) as store, pytest.raises(MapCorruptError, match="no room"):
        store.tag("next", author="tests")
