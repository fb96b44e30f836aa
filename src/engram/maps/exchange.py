"""The rows of a map as plain values, and a map made of such rows.

Only rows of committed revisions leave a map: they never change, and later ones come after them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from sqlalchemy import Select, Table, insert, select

from engram.files import new_file
from engram.maps.rows import count_tags, verified
from engram.maps.runs import save_runs
from engram.maps.schema import (
    VERSIONED,
    cameras,
    frontends,
    metadata,
    nodes,
    receipts,
    revisions,
    tags,
    words,
)
from engram.maps.sqlite import SqliteDatabase
from engram.maps.totals import runs_of
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

    def of(self, table: Table) -> Iterator[Values]:
        """Rows of one table as values in the order of its columns, by primary key, verified."""
        query = self._query(table).execution_options(yield_per=_ROWS_AT_ONCE)
        with self._database.reading() as connection:
            for row in verified(table, connection.execute(query)):
                yield tuple(row.values())

    def one(self, table: Table, key: int) -> Values:
        """The row with this primary key."""
        (column,) = table.primary_key.columns
        with self._database.reading() as connection:
            found = connection.execute(select(table).where(column == key))
            return tuple(next(iter(verified(table, found))).values())

    def close(self) -> None:
        """Closes the map."""
        self._database.close()

    def _query(self, table: Table) -> Select[Any]:
        seen = View(self.revision).revision_keys()
        query = select(table).order_by(*table.primary_key.columns)
        if table is revisions:
            return query.where(revisions.c.key.in_(seen))
        if table in VERSIONED or table is receipts:
            return query.where(table.c.revision.in_(seen))
        if table is words:
            saved = select(nodes.c.key).where(nodes.c.revision.in_(seen))
            return query.where(words.c.node.in_(saved))
        if table is tags:
            return query.where((tags.c.number <= self.revision) | tags.c.number.is_(None))
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
