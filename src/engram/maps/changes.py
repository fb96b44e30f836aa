"""What counts in one of two views of a map and not in the other, from the rows that may differ.

Those are the rows of the revisions between, the rows that these hide or show again, and what an
index finds for them: the rows of their nodes, and those that they supersede. Nothing else is read.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table, select

from engram.maps.columns import Columns, Visible, in_history, stretches
from engram.maps.marks import Removed, edge_key, removed_measurements, without_removed
from engram.maps.rows import verified
from engram.maps.schema import (
    attempts,
    edges,
    hidden,
    nodes,
    omissions,
    path_entries,
    paths,
    placements,
    removals,
    revisions,
    sessions,
)
from engram.maps.totals import Own, own_rows
from engram.maps.view import View

# Tables whose rows are read whole. Of sessions and attempts only these columns are read.
_WHOLE = (nodes, edges, paths, path_entries, omissions, placements)
_PARTLY = {
    sessions: ("key", "revision", "camera"),
    attempts: ("key", "revision", "session", "count"),
}
# Of rows that are equal in these columns the newest counts.
_SUPERSEDED_BY = {
    edges: ("a", "b", "kind"),
    path_entries: ("path", "sequence"),
    placements: ("node",),
}
_Rows = dict[int, tuple[Any, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Touched:
    """Rows of a table that may count in one of two views and not in the other.

    Attributes:
        rows: N rows, older ones first.
        seen: (2, N) bool, whether they are visible before and after.
        counts: (2, N) bool, whether they also count: neither superseded nor removed.
    """

    rows: Columns
    seen: NDArray[np.bool_]
    counts: NDArray[np.bool_]

    @property
    def before(self) -> Columns:
        """Those that count before."""
        return self.rows.rows(np.flatnonzero(self.counts[0]))

    @property
    def after(self) -> Columns:
        """Those that count after."""
        return self.rows.rows(np.flatnonzero(self.counts[1]))

    @property
    def lost(self) -> Columns:
        """Those that count before only."""
        return self.rows.rows(np.flatnonzero(self.counts[0] & ~self.counts[1]))

    @property
    def gained(self) -> Columns:
        """Those that count after only."""
        return self.rows.rows(np.flatnonzero(self.counts[1] & ~self.counts[0]))


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """What differs between two views.

    Attributes:
        before, after: what each of them shows.
        removed: what was removed between which ends in each of them.
        tables: the rows concerned, by table.
    """

    before: Visible
    after: Visible
    removed: tuple[Removed, Removed]
    tables: Mapping[Table, Touched]

    @staticmethod
    def between(
        connection: Connection, before: View, after: View, own: Own | None = None
    ) -> Changes:
        """What differs between two views, either of which may be the older one.

        Args:
            connection: of the map.
            before, after: the views.
            own: the rows of the one revision between, if known.

        Raises:
            MapCorruptError: a row does not match its checksum.
        """
        shown = Visible.of(connection, before, after)
        found = _Search(connection, shown, own).rows()
        removed = verified(removals, connection.execute(select(removals).order_by(removals.c.key)))
        rows = list(removed)
        gone = _removed(shown[0], rows), _removed(shown[1], rows)
        tables = {one: _touched(one, rows, shown, gone) for one, rows in found.items()}
        return Changes(shown[0], shown[1], gone, tables)

    def __getitem__(self, table: Table) -> Touched:
        return self.tables[table]


def _removed(shown: Visible, rows: Sequence[dict[str, Any]]) -> Removed:
    return removed_measurements(
        row
        for row in rows
        if shown.has(removals, row["key"], row["revision"])
        and not {row["a"], row["b"]} & shown.hidden_of(nodes)
    )


def columns_of(table: Table, rows: Iterable[tuple[Any, ...]]) -> Columns:
    """The columns of rows that were found here."""
    if table in _PARTLY:
        columns = np.array(list(rows), np.int64).reshape(-1, len(_PARTLY[table]))
        return Columns(dict(zip(_PARTLY[table], columns.T, strict=True)), {})
    return Columns.verified(table, list(rows))


def _touched(
    table: Table, rows: _Rows, shown: Sequence[Visible], gone: Sequence[Removed]
) -> Touched:
    """Which of these rows of a table are seen, and which of them count."""
    found = columns_of(table, rows.values())
    places = {**shown[0].places, **shown[1].places}
    found = in_history(places, found)
    seen = np.stack([one.shows(table, found) for one in shown])
    counts = np.zeros_like(seen)
    for at in (0, 1):
        visible = found.rows(np.flatnonzero(seen[at]))
        if table in _SUPERSEDED_BY:
            visible = visible.newest(*_SUPERSEDED_BY[table])
        if table is edges:
            visible = without_removed(gone[at], visible)
        counts[at] = np.isin(found["key"], visible["key"])
    return Touched(found, seen, counts)


class _Search:
    """Finds the rows that may differ.

    Args:
        connection: of the map.
        shown: what the two views show.
        own: the rows of the one revision between, if known.
    """

    def __init__(self, connection: Connection, shown: Sequence[Visible], own: Own | None) -> None:
        self._connection = connection
        self._found: dict[Table, _Rows] = {one: {} for one in (*_WHOLE, *_PARTLY)}
        apart = shown[0].places.keys() ^ shown[1].places.keys()
        self._between = list(_own_of(connection, apart)) if own is None else [own]
        # Keys of rows that are hidden or shown again, by name of the table.
        self._told: dict[str, list[int]] = defaultdict(list)
        for one in self._between:
            if hidden.name not in one.ranges:
                continue
            query = select(hidden).where(one.rows(hidden)).order_by(hidden.c.key)
            for row in verified(hidden, connection.execute(query)):
                self._told[row["record"]].append(row["target"])

    def rows(self) -> dict[Table, _Rows]:
        """The rows by key, by table."""
        for table in self._found:
            for own in self._between:
                if table.name in own.ranges:
                    first, last = own.ranges[table.name]
                    where = f"key BETWEEN ? AND ? AND revision = {own.key}"
                    self._add(table, where, (first, last))
            self._by(table, "key", self._told[table.name])
        concerned = self._told[nodes.name]
        for table, columns in (
            (edges, ("a", "b")),
            (path_entries, ("node",)),
            (omissions, ("node",)),
            (placements, ("node",)),
        ):
            for column in columns:
                self._by(table, column, concerned)
        self._add_removed()
        for table, names in _SUPERSEDED_BY.items():
            self._add_superseded(table, names)
        return self._found

    def _by(self, table: Table, column: str, values: Iterable[int]) -> None:
        self._found[table].update(rows_by(self._connection, table, column, values))

    def _add_removed(self) -> None:
        """Edges between the ends of removals that count in one view only."""
        rows: dict[int, Mapping[str, Any]] = {}
        which = [own.rows(removals) for own in self._between if removals.name in own.ranges]
        told = self._told[removals.name]
        for condition in (*which, *((removals.c.key == key) for key in told)):
            query = select(removals).where(condition).order_by(removals.c.key)
            rows |= {row["key"]: row for row in verified(removals, self._connection.execute(query))}
        for ends, _ in {edge_key(dict(row)) for row in rows.values()}:
            a, b = min(ends), max(ends)
            for pair in ((a, b), (b, a)):
                self._add(edges, "a = ? AND b = ?", pair)

    def _add_superseded(self, table: Table, names: Sequence[str]) -> None:
        """Rows that may take the place of those found, or give theirs to them."""
        same = " AND ".join(f"other.{name} = found.{name}" for name in names)
        columns = ", ".join(f"other.{name}" for name in _names(table))
        # Each of them once, however many rows of a damaged map are equal in these columns.
        statement = (
            f"SELECT {columns} FROM (SELECT DISTINCT {', '.join(names)} FROM {table.name} "
            f"WHERE key BETWEEN ? AND ?) AS found CROSS JOIN {table.name} AS other ON {same} "
            "WHERE other.key NOT BETWEEN ? AND ?"
        )
        for first_and_last in list(stretches(self._found[table])):
            self._put(table, statement, first_and_last * 2)

    def _add(self, table: Table, where: str, values: tuple[int, int]) -> None:
        self._put(table, f"{_select(table)} WHERE {where}", values)

    def _put(self, table: Table, statement: str, values: tuple[int, ...]) -> None:
        self._found[table].update(
            (row[0], row) for row in _rows(self._connection, statement, values)
        )


def rows_by(connection: Connection, table: Table, column: str, values: Iterable[int]) -> _Rows:
    """The rows of a table with one of these values in a column, by key."""
    parts = (rows_within(connection, table, column, one) for one in stretches(values))
    return {row[0]: row for part in parts for row in part}


def rows_within(
    connection: Connection, table: Table, column: str, within: tuple[int, int]
) -> list[tuple[Any, ...]]:
    """The rows of a table with a value in a column from the first up to the second."""
    return _rows(connection, f"{_select(table)} WHERE {column} BETWEEN ? AND ?", within)


def _rows(connection: Connection, statement: str, values: tuple[int, ...]) -> list[tuple[Any, ...]]:
    # As text, since building a statement takes longer than answering it.
    cursor = connection.exec_driver_sql(statement, values).cursor
    assert cursor is not None
    return list(cursor.fetchall())


def _select(table: Table) -> str:
    return f"SELECT {', '.join(_names(table))} FROM {table.name}"


def _names(table: Table) -> Sequence[str]:
    return _PARTLY.get(table) or [column.name for column in table.columns]


def _own_of(connection: Connection, keys: Iterable[int]) -> Iterator[Own]:
    """The rows of these revisions, by number."""
    for first, last in stretches(keys):
        query = select(revisions).where(revisions.c.key.between(first, last))
        found = connection.execute(query.order_by(revisions.c.key))
        yield from map(own_rows, verified(revisions, found))
