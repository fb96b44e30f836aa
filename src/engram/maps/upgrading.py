"""Converts a map of format 6: the same rows, with what format 7 adds to them.

The new file is written next to the old one, compared with it row by row, and takes its name in one
step. Whenever the process ends, one sound map has the name; the same command begins again.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from sqlalchemy import Connection, MetaData, Table, func, insert, select, text

from engram.errors import MapCorruptError, MapError, MapLockedError
from engram.files import WriterLock, draft_folder
from engram.graph.paths import Attempts
from engram.maps.attempts import COLUMNS, pack, unpack, unpack_drive
from engram.maps.changes import Changes
from engram.maps.content import EMPTY_HASH, Identities, chained
from engram.maps.counting import count_on
from engram.maps.map_files import log_damage
from engram.maps.rows import (
    Row,
    cell_of,
    from_json,
    sealed,
    to_json,
    transform_from_bytes,
    verified,
)
from engram.maps.runs import Runs, save_runs
from engram.maps.schema import (
    FORMAT_VERSION,
    VERSIONED,
    attempts,
    forgotten,
    hidden,
    map_format,
    metadata,
    place_blocks,
    placements,
    receipts,
    revisions,
    runs,
)
from engram.maps.sqlite import MAP_FILE, keep_log, write_format
from engram.maps.totals import Own, Totals
from engram.maps.view import LARGEST_KEY, View
from engram.sqlite import SqliteFile, is_full

_NEW_COLUMNS = {
    revisions: ("ranges", "totals", "chain"),
    attempts: ("page",),
    placements: ("cell",),
}
_NEW_TABLES = (runs, place_blocks, forgotten, receipts)
# Tables whose rows are written again, and what they are called meanwhile.
_REWRITTEN = {table: f"{table.name}_6" for table in (revisions, attempts, hidden, placements)}
# How long to wait for a process that is just closing the map.
_PATIENCE_MS = 1000


def _format_6() -> MetaData:
    """The tables of format 6."""
    old = MetaData()
    for table in metadata.sorted_tables:
        if table not in _NEW_TABLES:
            new = _NEW_COLUMNS.get(table, ())
            kept = [one for one in table.columns if one.name not in new]
            Table(table.name, old, *(one._copy() for one in kept))
    return old


_FORMAT_6 = replace(MAP_FILE, format_version=6, metadata=_format_6())


@dataclass(frozen=True, slots=True)
class Upgraded:
    """The result of an upgrade.

    Attributes:
        before, after: format of the file.
        revisions: number of revisions.
        rows: number of rows that were compared.
        before_bytes, after_bytes: size of the file.
    """

    before: int
    after: int
    revisions: int
    rows: int
    before_bytes: int
    after_bytes: int


def upgrade_map(path: Path) -> Upgraded:
    """Converts a map of format 6 to this format; one that has it stays as it is.

    Raises:
        NotAMapError: the file is not a map.
        FormatVersionError: it is of another format.
        MapCorruptError: it is damaged.
        MapLockedError: another process has it open.
        StorageFullError: no space for the copy; the map is unchanged.
        MapError: the file or its folder cannot be written.
    """
    path = path.resolve()
    file = SqliteFile(path, _FORMAT_6)
    file.check_regular()
    if not os.access(path, os.W_OK):
        raise MapError(f"{path} is read-only; copy it to a writable folder")
    lock = WriterLock(path)
    try:
        if _version(file) == FORMAT_VERSION:
            size = path.stat().st_size
            return Upgraded(FORMAT_VERSION, FORMAT_VERSION, 0, 0, size, size)
        damage = log_damage(path)
        if damage is not None and damage.lost:
            raise MapCorruptError(f"{path}: {damage.fact}; restore a copy")
        with _to_itself(file) as source, draft_folder(path) as folder:
            return _upgraded(source, path, folder / path.name)
    finally:
        lock.release()


def _upgraded(source: sqlite3.Connection, path: Path, draft: Path) -> Upgraded:
    before = path.stat().st_size
    old = SqliteFile(draft, _FORMAT_6)
    with old.errors(), closing(old.connect("mode=rwc")) as copy:
        source.backup(copy)
    shutil.copymode(path, draft)
    new = SqliteFile(draft, MAP_FILE)
    with new.errors():
        engine = new.engine("mode=rw", _without_log)
        with engine.begin() as connection:
            count = _convert(connection, new)
        engine.dispose()
        with closing(new.connect("mode=ro")) as made:
            rows = _compare(source, made)
        keep_log(new)
    _sync(draft)
    draft.replace(path)
    _sync(path.parent)
    return Upgraded(6, FORMAT_VERSION, count, rows, before, path.stat().st_size)


def _version(file: SqliteFile) -> int:
    """The format of a map: 6, or this one."""
    with file.errors(), closing(file.connect("mode=rw")) as connection:
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        kind = MAP_FILE if version == FORMAT_VERSION else _FORMAT_6
        SqliteFile(file.path, replace(kind, older=MAP_FILE.older)).identify(connection.execute)
        SqliteFile(file.path, kind).check_tables(connection.execute)
    return int(version)


@contextmanager
def _to_itself(file: SqliteFile) -> Iterator[sqlite3.Connection]:
    """A connection to a map that no other process has open, and that has no log.

    A process that had it open would remove the log of the new file when it ends.
    """
    with file.errors(), closing(file.connect("mode=rw")) as connection:
        connection.execute(f"PRAGMA busy_timeout={_PATIENCE_MS}")
        try:
            connection.execute("PRAGMA journal_mode=DELETE")
        except sqlite3.OperationalError as error:
            if is_full(error):
                raise
            raise MapLockedError(
                f"{file.path} is open in another process; close it there first"
            ) from error
        try:
            yield connection
        except BaseException:
            connection.execute("PRAGMA journal_mode=WAL")
            raise


def _without_log(connection: sqlite3.Connection) -> None:
    """Of a draft, which is thrown away if anything goes wrong."""
    connection.execute("PRAGMA journal_mode=OFF")
    connection.execute("PRAGMA synchronous=OFF")


def _convert(connection: Connection, file: SqliteFile) -> int:
    """Adds what format 7 has; returns the number of revisions."""
    for table, name in _REWRITTEN.items():
        for index in table.indexes:
            connection.execute(text(f"DROP INDEX IF EXISTS {index.name}"))
        connection.execute(text(f"ALTER TABLE {table.name} RENAME TO {name}"))
    metadata.create_all(connection)
    more = _copy_hidden(connection, _split_attempts(connection))
    for row in _old_rows(connection, placements):
        pose = transform_from_bytes(row["map_from_node"], f"placement {row['key']}")
        connection.execute(insert(placements), sealed(placements, row | {"cell": cell_of(pose)}))
    for row in _old_rows(connection, revisions):
        row |= {"ranges": "{}", "totals": "{}", "chain": ""}
        if row["key"] in more:
            contents = from_json(row["contents"], f"contents of revision {row['number']}")
            row["contents"] = to_json(contents | {hidden.name: more[row["key"]]})
        connection.execute(insert(revisions), sealed(revisions, row))
    for name in _REWRITTEN.values():
        connection.execute(text(f"DROP TABLE {name}"))
    for table in metadata.sorted_tables:  # in what those leave free
        for index in table.indexes:
            index.create(connection, checkfirst=True)
    count = complete_history(connection)
    write_format(connection)
    file.mark(connection.exec_driver_sql)
    return count


def complete_history(connection: Connection) -> int:
    """Works out what each revision keeps of its rows, and the runs; returns the number of those.

    Only for rows that were not written by commits: a map of format 6, and synthetic ones.
    """
    ranges = _ranges(connection)
    query = select(revisions).order_by(revisions.c.number, revisions.c.key)
    rows = list(verified(revisions, connection.execute(query)))
    committed = [row for row in rows if row["number"] is not None]
    for row in rows:
        row["ranges"] = to_json(_ranges_of(row, ranges))
    _put(connection, rows)  # by which the rest finds the rows of each revision
    _count(connection, committed, ranges)
    _put(connection, committed)
    return len(committed)


def _put(connection: Connection, rows: list[Row]) -> None:
    for row in rows:
        sealed(revisions, row)
        connection.execute(revisions.update().where(revisions.c.key == row["key"]).values(row))


def _old_rows(connection: Connection, table: Table) -> Iterator[Row]:
    """The rows of a table that is written again."""
    old = _FORMAT_6.metadata.tables[table.name].to_metadata(MetaData(), name=_REWRITTEN[table])
    keys = connection.execute(select(old.c.key).order_by(old.c.key)).scalars().all()
    for key in keys:
        yield from verified(old, connection.execute(select(old).where(old.c.key == key)))


def _split_attempts(connection: Connection) -> dict[int, list[int]]:
    """Writes the attempts by page; returns the new keys of each old body."""
    found: dict[int, list[int]] = {}
    places: Counter[tuple[int, int]] = Counter()
    key = 0
    for row in _old_rows(connection, attempts):
        _, made = unpack(row["body"], row["count"])
        drive = row["revision"], row["session"]
        bodies = pack(made, places[drive])
        places[drive] += len(made)
        found[row["key"]] = list(range(key + 1, key + 1 + len(bodies)))
        for one in bodies:
            key += 1
            new = {"key": key, "revision": row["revision"], "session": row["session"]}
            connection.execute(insert(attempts), sealed(attempts, new | one))
    return found


def _copy_hidden(connection: Connection, bodies: Mapping[int, list[int]]) -> dict[int, int]:
    """Writes the rows that hide others; returns their number by revision.

    Args:
        connection: of the draft.
        bodies: new keys of each old body of attempts.
    """
    key, counts = 0, Counter[int]()
    for row in _old_rows(connection, hidden):
        target = row["target"]
        targets = bodies.get(target, []) if row["record"] == attempts.name else [target]
        for one in targets:
            key += 1
            connection.execute(insert(hidden), sealed(hidden, row | {"key": key, "target": one}))
        counts[row["revision"]] += len(targets)
    return dict(counts)


Ranges = Mapping[int, Mapping[str, tuple[int, int]]]


def _ranges(connection: Connection) -> Ranges:
    """First and last key of the rows of each revision by table, in one pass over each table."""
    found: dict[int, dict[str, tuple[int, int]]] = {}
    for table in VERSIONED:
        key = table.primary_key.columns[0]
        query = select(table.c.revision, func.min(key), func.max(key)).group_by(table.c.revision)
        for revision, first, last in connection.execute(query.order_by(table.c.revision)):
            found.setdefault(revision, {})[str(table.name)] = (first, last)
    return found


def _ranges_of(row: Row, ranges: Ranges) -> dict[str, tuple[int, int]]:
    """The ranges of a revision; an open one may still get rows of every table."""
    known = ranges.get(row["key"], {})
    if row["status"] != "open":
        return dict(known)
    found = {}
    for name in map(str, (one.name for one in VERSIONED)):
        beyond = 1 + max((one[name][1] for one in ranges.values() if name in one), default=0)
        found[name] = (known.get(name, (beyond, 0))[0], LARGEST_KEY)
    return found


def _count(connection: Connection, rows: list[Row], ranges: Ranges) -> None:
    """Sets totals and content hashes of the committed revisions, in order; writes the runs."""
    totals, held, chain = Totals(), Runs.none(), EMPTY_HASH
    known = Identities(connection)
    for row in rows:
        own = Own(row["key"], ranges.get(row["key"], {}))
        before, now = View(row["number"] - 1), View(row["number"])
        changes = Changes.between(connection, before, now)
        totals, held = count_on(connection, now, totals, held, changes)
        chain = chained(connection, chain, row, own, known)
        row |= {"totals": totals.to_json(), "chain": chain}
    save_runs(connection, None, held)


def _compare(source: sqlite3.Connection, made: sqlite3.Connection) -> int:
    """Compares all that both formats have, row by row; returns the number of rows.

    Attempts are compared drive by drive, and of rows that hide others all but those of attempts.

    Raises:
        MapCorruptError: something differs.
    """
    compared = _compare_attempts(source, made)
    for table in _FORMAT_6.metadata.sorted_tables:
        if table.name in {map_format.name, attempts.name}:
            continue
        left_out = _NOT_COMPARED.get(table.name, set())
        kept = ", ".join(one.name for one in table.columns if one.name not in left_out)
        which = f"WHERE record != '{attempts.name}'" if table.name == hidden.name else ""
        order = "key" if "key" in table.c else "1"
        query = f"SELECT {kept} FROM {table.name} {which} ORDER BY {order}"
        for old, new in zip(source.execute(query), made.execute(query), strict=True):
            compared += 1
            if old != new:
                raise MapCorruptError(f"table {table.name}: row {old[0]} came out differently")
    return compared


_NOT_COMPARED = {
    revisions.name: {"checksum", "contents"},
    hidden.name: {"key", "checksum"},
    placements.name: {"checksum"},
}


_DRIVES = "SELECT DISTINCT revision, session FROM attempts ORDER BY revision, session"
_HIDDEN_DRIVES = (
    "SELECT DISTINCT h.revision, h.hidden, a.revision, a.session FROM hidden h "
    "JOIN attempts a ON a.key = h.target WHERE h.record = 'attempts' ORDER BY 1, 2, 3, 4"
)
_BODIES = (
    "SELECT revision, count, body FROM attempts WHERE revision = ? AND session = ? ORDER BY key"
)


def _compare_attempts(source: sqlite3.Connection, made: sqlite3.Connection) -> int:
    """Compares the attempts of each drive and revision; returns the number of old rows.

    Raises:
        MapCorruptError: they differ.
    """
    for query in (_DRIVES, _HIDDEN_DRIVES):
        if source.execute(query).fetchall() != made.execute(query).fetchall():
            raise MapCorruptError("table attempts: other drives have attempts than before")
    compared = 0
    for drive in source.execute(_DRIVES).fetchall():
        before, after = (
            [dict(zip(("revision", "count", "body"), row, strict=True)) for row in rows]
            for rows in (one.execute(_BODIES, drive).fetchall() for one in (source, made))
        )
        compared += len(before)
        old = Attempts.joined([unpack(row["body"], row["count"])[1] for row in before])
        new = unpack_drive(after)
        if old.policies != new.policies or any(
            getattr(old, name).tobytes() != getattr(new, name).tobytes()
            for name in (*COLUMNS, "policy")
        ):
            raise MapCorruptError(f"table attempts: those of row {drive[1]} came out differently")
    return compared


def _sync(path: Path) -> None:
    held = os.open(path, os.O_RDONLY)
    try:
        os.fsync(held)
    finally:
        os.close(held)
