"""Maps of strangers: nothing in their definitions is evaluated."""

from __future__ import annotations

import shutil
import sqlite3

import pytest

from engram.errors import EngramError, MapCorruptError
from engram.maps import Map, check_file

from .maps import begin, session, write_drive

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
    with pytest.raises(MapCorruptError, match=r"not a plain table or index|not the tables"):
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
