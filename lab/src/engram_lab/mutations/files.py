"""Changes of files: bytes, as failing disks make them; rows and schemas, as strangers do."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sqlalchemy import Table

from engram.frontend.blobs import content_digest
from engram.maps.rows import sealed
from engram.maps.schema import frames, metadata, nodes
from engram.sequences.framelog.file import frames_table, log_digest, log_table, row_digest
from engram_lab.mutations import case
from engram_lab.mutations.case import Case, Samples, Subject

_PAGE = 4096
_LOG_HEADER, _LOG_FRAME = 32, 24 + _PAGE
_RUN = 64


def bytes_of_a_map(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Any bytes of a map file without a log."""
    path = Path(shutil.copy(samples.town, folder / "town.engram"))
    return Case(Subject.MAP, _changed(path, chance, _PAGE, 0), path=path)


def bytes_of_a_log(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Bytes of the write-ahead log of a map; one that only ends early is an earlier state."""
    path = logged_copy(samples, folder)
    log = path.with_name(f"{path.name}-wal")
    whole = log.read_bytes()
    what = _changed(log, chance, _LOG_FRAME, _LOG_HEADER)
    return Case(Subject.MAP, f"log: {what}", whole.startswith(log.read_bytes()), path)


def bytes_of_a_map_with_a_log(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Bytes of a map file that has a log."""
    path = logged_copy(samples, folder)
    return Case(Subject.MAP, _changed(path, chance, _PAGE, 0), path=path)


def bytes_of_a_drive(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Any bytes of a frame log or a flight record."""
    source = chance.choice([samples.framelog, samples.flight])
    path = Path(shutil.copy(source, folder / source.name))
    return Case(Subject.DRIVE, _changed(path, chance, _PAGE, 0), path=path)


def logged_copy(samples: Samples, folder: Path) -> Path:
    """A copy of the map with a log, log included."""
    path = folder / "logged.engram"
    for suffix in ("", "-wal"):
        shutil.copyfile(f"{samples.logged}{suffix}", f"{path}{suffix}")
    return path


def _changed(path: Path, chance: random.Random, page: int, first: int) -> str:
    """Changes a file; says how."""
    body = bytearray(path.read_bytes())
    how = chance.choice(list(_WAYS))
    what = _WAYS[how](body, chance, page, first)
    path.write_bytes(body)
    return f"{how} {what}"


def _flip(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    del page, first
    places = [chance.randrange(len(body)) for _ in range(chance.choice([1, 1, 1, 2, 8]))]
    for at in places:
        body[at] ^= 1 << chance.randrange(8)
    return f"at {places}"


def _head(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    del page, first
    at = chance.randrange(100)
    body[at] = chance.choice([0, 1, 0x7F, 0x80, 0xFF, chance.randrange(256)])
    return f"at {at}"


def _overwrite(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    del page, first
    at, length = chance.randrange(len(body)), chance.randint(1, _RUN)
    run = chance.choice([bytes(length), b"\xff" * length, chance.randbytes(length)])
    body[at : at + length] = run[: len(body) - at]
    return f"{length} bytes at {at}"


def _cut(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    at = chance.randrange(len(body))
    if chance.random() < 0.5:
        at = min(len(body), first + page * ((at - first) // page)) if at > first else first
    del body[at:]
    return f"at {at}"


def _append(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    del first
    run = chance.choice([bytes(page), chance.randbytes(page), bytes(body[-page:])])
    body += run[: chance.choice([page, chance.randint(1, page)])]
    return f"to {len(body)} bytes"


def _exchange(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    count = (len(body) - first) // page
    a, b = (first + page * chance.randrange(count) for _ in range(2))
    one, other = bytes(body[a : a + page]), bytes(body[b : b + page])
    body[a : a + page], body[b : b + page] = other, one
    return f"pages at {a} and {b}"


def _lose(body: bytearray, chance: random.Random, page: int, first: int) -> str:
    at = first + page * chance.randrange((len(body) - first) // page)
    if chance.random() < 0.5:
        body[at : at + page] = bytes(page)
        return f"page at {at} to zeros"
    del body[at : at + page]
    return f"page at {at}"


_WAYS = {
    "flip": _flip,
    "head": _head,
    "overwrite": _overwrite,
    "cut": _cut,
    "append": _append,
    "exchange": _exchange,
    "lose": _lose,
}


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


def schema_of_a_file(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """The schema of a map or a drive."""
    source = chance.choice([samples.town, samples.town, samples.framelog])
    path = Path(shutil.copy(source, folder / source.name))
    expression = chance.choice(_EXPRESSIONS)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        try:
            what = _redefine(connection, chance, expression)
        except sqlite3.Error:
            what = "nothing"  # SQLite itself refuses it
    subject = Subject.MAP if source == samples.town else Subject.DRIVE
    return Case(subject, f"schema: {what}", sealed=True, path=path)


def _redefine(connection: sqlite3.Connection, chance: random.Random, expression: str) -> str:
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


Row = dict[str, Any]


def rows_of_a_map(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Rows of a map under their old checksums, which `check` must miss."""
    return _in_a_map(samples, folder, chance, sealing=False)


def sealed_rows_of_a_map(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Rows of a map under right checksums, which readers must survive."""
    return _in_a_map(samples, folder, chance, sealing=True)


def blobs_of_a_map(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Landmarks, thumbnails, attempts under right hashes and checksums."""
    path = Path(shutil.copy(samples.town, folder / "town.engram"))
    with closing(sqlite3.connect(path)) as connection, connection:
        what = chance.choice([_landmarks, _thumbnail, _attempts, _vocabulary])(connection, chance)
    return Case(Subject.MAP, what, sealed=True, path=path)


def many_rows(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """One row of a map over and over."""
    path = Path(shutil.copy(samples.town, folder / "town.engram"))
    table = chance.choice(_keyed())
    count = chance.choice([2, 100, 20_000])
    with closing(sqlite3.connect(path)) as connection, connection:
        row = _any_row(connection, table, chance)
        keys = range(10_000, 10_000 + count) if row else ()
        for key in keys:
            copy = {**row, "key": key}
            if "uuid" in copy:
                copy["uuid"] = chance.randbytes(16)
            try:
                _insert(connection, table, sealed(table, copy))
            except sqlite3.IntegrityError:
                break
    return Case(Subject.MAP, f"{count} times a row of {table.name}", sealed=True, path=path)


def rows_of_a_drive(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Rows of a frame log, under their old hashes or new ones."""
    source = chance.choice([samples.framelog, samples.flight])
    path = Path(shutil.copy(source, folder / source.name))
    sealing = chance.random() < 0.7
    with closing(sqlite3.connect(path)) as connection, connection:
        what = _change_drive(connection, chance, sealing)
    return Case(Subject.DRIVE, what, sealed=sealing, path=path)


def changed_value(value: Any, chance: random.Random) -> Any:
    """A value of the same type."""
    ways: dict[type, Callable[[Any, random.Random], Any]] = {
        int: case.integer,
        float: case.real,
        str: case.text,
        bytes: case.blob,
    }
    return ways[type(value)](value, chance) if type(value) in ways else value


def _in_a_map(samples: Samples, folder: Path, chance: random.Random, *, sealing: bool) -> Case:
    path = Path(shutil.copy(samples.town, folder / "town.engram"))
    what = []
    with closing(sqlite3.connect(path)) as connection, connection:
        for _ in range(chance.choice([1, 1, 1, 2, 4])):
            table = chance.choice(metadata.sorted_tables)
            try:
                what.append(_change(connection, table, chance, sealing))
            except (sqlite3.IntegrityError, sqlite3.DataError, OverflowError):
                what.append("nothing")  # the table itself refuses it
    return Case(Subject.MAP, "; ".join(what), sealed=sealing, path=path)


def _change(connection: sqlite3.Connection, table: Table, chance: random.Random, seal: bool) -> str:
    row = _any_row(connection, table, chance)
    if not row:
        return f"{table.name} is empty"
    key = next(iter(row))
    name = f"{table.name} {row[key]}"
    deed = chance.randrange(10)
    if deed == 0:
        connection.execute(f"DELETE FROM {table.name} WHERE {key} = ?", [row[key]])
        return f"{name} deleted"
    if deed == 1 and not seal:
        copy = {**row, key: row[key] + 1_000}
        _insert(connection, table, copy)
        return f"{name} copied"
    columns = [one for one in row if one != "checksum" or not seal]
    column = chance.choice(columns)
    nullable = table.c[column].nullable and chance.random() < 0.3
    new = None if nullable else changed_value(row[column], chance)
    changed = {**row, column: new}
    if seal:
        sealed(table, changed)
    _update(connection, table, changed, key, row[key])
    return f"{name} {column} = {new!r:.60}"


def _landmarks(connection: sqlite3.Connection, chance: random.Random) -> str:
    frame = _any_row(connection, frames, chance)
    body = case.landmarks(frame["landmarks"][16:], chance)
    digest_ = content_digest(body)
    _update(connection, frames, sealed(frames, {**frame, "landmarks": digest_ + body}))
    (node,) = _rows(connection, nodes, f"WHERE key = {frame['node']}")
    _update(connection, nodes, sealed(nodes, {**node, "landmark_hash": digest_}))
    return f"landmarks of node row {frame['node']}"


def _thumbnail(connection: sqlite3.Connection, chance: random.Random) -> str:
    frame = _any_row(connection, frames, chance)
    picture = case.picture(frame["thumbnail"], chance)
    _update(connection, frames, sealed(frames, {**frame, "thumbnail": picture}))
    return f"thumbnail of node row {frame['node']}"


def _vocabulary(connection: sqlite3.Connection, chance: random.Random) -> str:
    table = metadata.tables["vocabularies"]
    row = _any_row(connection, table, chance)
    body = case.landmarks(row["body"], chance)
    _update(connection, table, sealed(table, {**row, "body": body, "hash": content_digest(body)}))
    return f"vocabulary row {row['key']}"


def _attempts(connection: sqlite3.Connection, chance: random.Random) -> str:
    table = metadata.tables["attempts"]
    row = _any_row(connection, table, chance)
    body = case.packed_attempts(row["body"], chance)
    _update(connection, table, sealed(table, {**row, "body": body}))
    return f"attempts row {row['key']}"


def _change_drive(connection: sqlite3.Connection, chance: random.Random, seal: bool) -> str:
    if chance.random() < 0.3:
        (row,) = _rows(connection, log_table)
        header = case.text(row["header"], chance)
        changed = {**row, "header": header}
        if seal:
            known = header.encode(errors="replace").decode()
            changed["digest"] = log_digest(known, row["complete"])
        _update(connection, log_table, changed)
        return f"header {header!r:.60}"
    row = _any_row(connection, frames_table, chance)
    names = [one for one in row if one not in {"number", "digest"}]
    column = chance.choice(names)
    new = _drive_value(column, row[column], chance)
    changed = {**row, column: new}
    if seal:
        _seal_frame(changed)
    try:
        _update(connection, frames_table, changed)
    except sqlite3.IntegrityError:
        return "nothing"
    return f"frame {row['number']} {column} = {new!r:.60}"


def _drive_value(column: str, value: Any, chance: random.Random) -> Any:
    if column in {"landmarks", "thumbnail"}:
        make = case.landmarks if column == "landmarks" else case.picture
        body = make(value[16:], chance)
        return content_digest(body) + body
    return changed_value(value, chance)


def _seal_frame(row: Row) -> None:
    thumbnail = row["thumbnail"]
    row["digest"] = row_digest(
        row, row["landmarks"][:16], None if thumbnail is None else thumbnail[:16]
    )


def _keyed() -> Sequence[Table]:
    return [table for table in metadata.sorted_tables if "key" in table.c]


def _rows(connection: sqlite3.Connection, table: Table, where: str = "") -> list[Row]:
    names = [one.name for one in table.columns]
    listed = ", ".join(names)
    found = connection.execute(f"SELECT {listed} FROM {table.name} {where} ORDER BY 1")
    return [dict(zip(names, row, strict=True)) for row in found]


def _any_row(connection: sqlite3.Connection, table: Table, chance: random.Random) -> Row:
    found = _rows(connection, table)
    return chance.choice(found) if found else {}


def _insert(connection: sqlite3.Connection, table: Table, row: Row) -> None:
    marks = ", ".join("?" * len(row))
    connection.execute(
        f"INSERT INTO {table.name} ({', '.join(row)}) VALUES ({marks})", list(row.values())
    )


def _update(
    connection: sqlite3.Connection,
    table: Table,
    row: Row,
    key: str | None = None,
    value: Any = None,
) -> None:
    if key is None:
        key = next(iter(row))
        value = row[key]
    given = ", ".join(f"{name} = ?" for name in row)
    connection.execute(f"UPDATE {table.name} SET {given} WHERE {key} = ?", [*row.values(), value])
