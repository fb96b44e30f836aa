"""The rows of a map as plain values, a map made of such rows, and one that is brought up to date.

Only rows of committed revisions leave a map: they never change, and later ones come after them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
from sqlalchemy import Connection, Select, Table, delete, func, insert, or_, select

from engram.files import new_file
from engram.maps.content import verified_hash
from engram.maps.counting import count_open
from engram.maps.rows import count_tags, verified
from engram.maps.runs import save_runs
from engram.maps.schema import (
    VERSIONED,
    cameras,
    frontends,
    metadata,
    nodes,
    place_blocks,
    receipts,
    revisions,
    tag_tally,
    tags,
    words,
)
from engram.maps.sqlite import SqliteDatabase
from engram.maps.totals import own_rows, runs_of
from engram.maps.view import View, head

# In the order in which rows refer to each other.
EXCHANGED: tuple[Table, ...] = (
    revisions, cameras, frontends, *VERSIONED, receipts, tags, words,
)  # fmt: skip
# All tables but those of the format, of the tally, of the runs and of the blocks of places.
assert len(EXCHANGED) == len(metadata.tables) - 4

_ROWS_AT_ONCE = 200

Values: TypeAlias = Sequence[Any]
PutRows: TypeAlias = Callable[[Table, Iterable[Values]], None]


class MapRows:
    """The rows of the committed revisions of a map, up to one.

    Args:
        location: the map file.
        at: number of the last revision; None for the newest.

    Raises:
        MapError: the map cannot be read.
    """

    def __init__(self, location: Path, at: int | None = None) -> None:
        self._database = SqliteDatabase(location)
        with self._database.reading() as connection:
            self.revision = head(connection) if at is None else at

    def of(self, table: Table, since: int | None = None) -> Iterator[Values]:
        """Rows of one table as values in the order of its columns, by primary key, verified.

        Args:
            table: the table.
            since: the least primary key; None for all rows.
        """
        with self._database.reading() as connection:
            yield from _rows_of(connection, table, self.revision, since)

    def one(self, table: Table, key: int) -> Values:
        """The row with this primary key."""
        (column,) = table.primary_key.columns
        with self._database.reading() as connection:
            found = connection.execute(select(table).where(column == key))
            return tuple(next(iter(verified(table, found))).values())

    def close(self) -> None:
        """Closes the map."""
        self._database.close()


def _rows_of(connection: Connection, table: Table, at: int, since: int | None) -> Iterator[Values]:
    query = _query(table, at)
    if since is not None:
        query = query.where(table.primary_key.columns[0] >= since)
    found = connection.execute(query.execution_options(yield_per=_ROWS_AT_ONCE))
    for row in verified(table, found):
        yield tuple(row.values())


def _query(table: Table, at: int) -> Select[Any]:
    seen = View(at).revision_keys()
    query = select(table).order_by(*table.primary_key.columns)
    if table is revisions:
        return query.where(revisions.c.key.in_(seen))
    if table in VERSIONED or table is receipts:
        return query.where(table.c.revision.in_(seen))
    if table is words:
        saved = select(nodes.c.key).where(nodes.c.revision.in_(seen))
        return query.where(words.c.node.in_(saved))
    if table is tags:
        return query.where((tags.c.number <= at) | tags.c.number.is_(None))
    return query


@contextmanager
def map_of_rows(path: Path) -> Iterator[PutRows]:
    """Makes a map file; yields the function that adds rows of a table. Whole or not at all.

    Raises:
        InputError: the file exists already, or its folder does not.
        MapCorruptError: a row does not match its checksum, or refers to none.
        MapError: a row contradicts another one, or the file cannot be written.
    """
    with new_file(path) as draft:
        SqliteDatabase.create(draft)
        with closing(SqliteDatabase(draft)) as database, database.writing() as connection:

            def put(table: Table, rows: Iterable[Values]) -> None:
                values = list(verified(table, rows))
                if values:
                    connection.execute(insert(table), values)

            yield put
            count_tags(connection)
            save_runs(connection, None, runs_of(connection, View(head(connection))))


def stamp_of(location: Path, at: int | None = None) -> tuple[int, str]:
    """The newest revision of a map, and a hash that only copies of this file share.

    Equal content hashes may have other keys and times; a stamp names the commit itself, by the
    row of its revision, and what was erased and tagged since.

    Args:
        location: the map file.
        at: number of the revision that is hashed; None for the newest.

    Raises:
        MapError: the map cannot be read.
    """
    with closing(SqliteDatabase(location)) as database, database.reading() as connection:
        newest = head(connection)
        query = _query(revisions, newest).where(
            revisions.c.number == (newest if at is None else at)
        )
        row = [tuple(one.values()) for one in verified(revisions, connection.execute(query))]
        erased = connection.execute(select(func.max(receipts.c.key))).scalar()
        tally = connection.execute(select(tag_tally.c.rows, tag_tally.c.digest)).one()
        told = msgspec.msgpack.encode([row, erased, tuple(tally)])
    return newest, hashlib.sha256(told).hexdigest()


class Rewriting:
    """A map within the one transaction that replaces rows of it; see `rewriting`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        # The revision whose runs are stored; None if rows went since.
        self._counted: int | None = None

    def of(self, table: Table, at: int, since: int | None = None) -> Iterator[Values]:
        """Rows as of revision `at`, with those that were put; see `MapRows.of`."""
        return _rows_of(self._connection, table, at, since)

    def has(self, revision: Values) -> bool:
        """Whether the map holds this row of `revisions`."""
        query = select(revisions).where(revisions.c.key == revision[0])
        found = [
            tuple(row.values()) for row in verified(revisions, self._connection.execute(query))
        ]
        return found == [tuple(revision)]

    def clear(self) -> None:
        """Removes all rows."""
        for table in (*EXCHANGED, place_blocks):
            self._connection.execute(delete(table))

    def go_back(self, common: int) -> None:
        """Removes what came after a revision: later ones, and those that were not committed."""
        self._counted = common
        later = or_(revisions.c.number.is_(None), revisions.c.number > common)
        found = self._connection.execute(select(revisions).where(later))
        for row in list(verified(revisions, found)):
            if row["number"] is not None:
                self._counted = None
            own = own_rows(row)
            lost = select(nodes.c.key).where(own.rows(nodes))
            self._connection.execute(delete(words).where(words.c.node.in_(lost)))
            for table in reversed(VERSIONED):
                gone = self._connection.execute(delete(table).where(own.rows(table))).rowcount
                if table is nodes and gone:
                    self._connection.execute(delete(place_blocks))
            self._connection.execute(delete(revisions).where(revisions.c.key == row["key"]))

    def cut(self, table: Table, since: int) -> None:
        """Removes the rows of a table from a primary key on."""
        (key,) = table.primary_key.columns
        self._connection.execute(delete(table).where(key >= since))

    def put(self, table: Table, rows: Iterable[Values]) -> None:
        """Adds rows."""
        values = list(verified(table, rows))
        if values:
            self._connection.execute(insert(table), values)

    def verified_hash(self, at: int, since: int) -> str:
        """The content hash as of `at`, worked out from the rows that came after `since`.

        Raises:
            MapCorruptError: a row is damaged or points at nothing, or a stored hash is another.
        """
        return verified_hash(self._connection, at, since)

    def count(self) -> None:
        """Stores what follows from the rows: the tally of tags, and the runs."""
        count_tags(self._connection)
        if self._counted is None:
            every = runs_of(self._connection, View(head(self._connection)))
            save_runs(self._connection, None, every)
            return
        later = select(revisions).where(revisions.c.number > self._counted)
        found = self._connection.execute(later.order_by(revisions.c.number))
        for row in list(verified(revisions, found)):
            seen = View(row["number"] - 1, row["key"])
            _, after, before = count_open(self._connection, seen, own_rows(row))
            save_runs(self._connection, before, after)


@contextmanager
def rewriting(location: Path) -> Iterator[Rewriting]:
    """Locks a map for writing, and yields it to be rewritten: whole or not at all.

    Whoever has the map open at a revision whose rows stay reads on.

    Raises:
        MapLockedError: another process writes to it.
        MapError: a row contradicts another one, or the file cannot be written.
    """
    with closing(SqliteDatabase(location)) as database:
        lock = database.lock_for_writing()
        try:
            with database.writing() as connection:
                copy = Rewriting(connection)
                yield copy
                copy.count()
        finally:
            lock.release()
