"""Changes of a schema: whatever SQLite would evaluate, and definitions that are not quite right."""

from __future__ import annotations

import random
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

from engram_lab.mutations.case import Case, Samples, Subject

# Whoever evaluates one of these calls a function that Engram itself never calls.
_EXPRESSIONS = (
    "(length(hex(zeroblob(1000000000))) > 0)",
    "(hex(randomblob(9)))",
    "(load_extension('/tmp/owned'))",
    "((SELECT count(*) FROM sqlite_schema a, sqlite_schema b, sqlite_schema c))",
    "(printf('%.*c', 1000000000, 'x'))",
)
_STAND_IN = "(1)"
_OBJECTS = (
    "CREATE VIEW seen AS SELECT {e}",
    "CREATE TRIGGER seen BEFORE INSERT ON tags BEGIN SELECT {e}; END",
    "CREATE TRIGGER seen AFTER UPDATE ON revisions BEGIN DELETE FROM edges; END",
    "CREATE VIRTUAL TABLE seen USING fts5(body)",
    "CREATE VIRTUAL TABLE seen USING rtree(a, b, c)",
    "CREATE INDEX seen ON nodes (key) WHERE {e}",
    "CREATE INDEX seen ON nodes ({e})",
    "CREATE TABLE seen (a INTEGER DEFAULT {e}) STRICT",
    "CREATE TABLE seen (a INTEGER) STRICT",
)
_ENDINGS = (
    " CHECK {e}",
    " DEFAULT {e}",
    " AS {e}",
    " COLLATE nocase",
    " REFERENCES nodes (key)",
    " /* {e} */",
    " -- {e}",
)


def of_a_file(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """The schema of a map or a drive."""
    source = chance.choice([samples.town, samples.town, samples.framelog])
    path = Path(shutil.copy(source, folder / source.name))
    expression = chance.choice(_EXPRESSIONS)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        try:
            what = _changed(connection, chance, expression)
        except sqlite3.Error:
            what = "nothing"  # SQLite itself refuses it
    subject = Subject.MAP if source == samples.town else Subject.DRIVE
    return Case(subject, f"schema: {what}", sealed=True, path=path)


def _changed(connection: sqlite3.Connection, chance: random.Random, expression: str) -> str:
    if chance.random() < 0.4:
        made = chance.choice(_OBJECTS)
        connection.execute(made.format(e=_STAND_IN))  # the harness evaluates nothing itself
        connection.execute("PRAGMA writable_schema = ON")
        statement = made.format(e=expression)
        connection.execute("UPDATE sqlite_schema SET sql = ? WHERE name = 'seen'", [statement])
        return statement
    kept = connection.execute(
        "SELECT rowid, sql FROM sqlite_schema WHERE sql IS NOT NULL ORDER BY 1"
    )
    row, definition = chance.choice(kept.fetchall())
    changed = _redefined(definition, chance, expression)
    connection.execute("PRAGMA writable_schema = ON")
    connection.execute("UPDATE sqlite_schema SET sql = ? WHERE rowid = ?", [changed, row])
    return changed


def _redefined(definition: str, chance: random.Random, expression: str) -> str:
    wild: str
    match chance.randrange(4):
        case 0:
            at = chance.choice([at for at, one in enumerate(definition) if one in ",)"])
            ending = chance.choice(_ENDINGS).format(e=expression)
            return definition[:at] + ending + definition[at:]
        case 1:
            at = chance.randrange(len(definition))
            wild = chance.choice([*"(),;'\"`[]\0", "\u202e", " TEXT", " NOT NULL"])
            return definition[:at] + wild + definition[at:]
        case 2:
            return definition.replace(" STRICT", "").replace("STRICT", "")
        case _:
            words = definition.split(" ")
            words[chance.randrange(len(words))] = chance.choice(words)
            return " ".join(words)
