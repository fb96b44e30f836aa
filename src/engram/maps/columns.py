"""Many rows of one table at once, as verified columns: a map is opened by these."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Select, Table, bindparam, func, select

from engram import _core
from engram.errors import MapCorruptError
from engram.maps.rows import Row, describe, mismatch, verified
from engram.maps.schema import attempts, edges, hidden, nodes, path_entries, receipts, revisions
from engram.maps.view import LARGEST_KEY, View, place_in_history, places_in_history

Keys = NDArray[np.int64]
Ask = Callable[[Select[Any], dict[str, Any]], Iterable[Any]]
# What was said of rows of a table, oldest first.
_SAID = (
    select(hidden.c.key, hidden.c.revision, hidden.c.target, hidden.c.hidden)
    .where(hidden.c.record == bindparam("record"))
    .where(hidden.c.target.between(bindparam("first"), bindparam("last")))
    .order_by(hidden.c.key)
)
# Older views, which do not know that it was hidden, show nothing of what was erased, either.
_ERASED = (
    select(receipts.c.target)
    .where(receipts.c.record == bindparam("record"))
    .where(receipts.c.target.between(bindparam("first"), bindparam("last")))
)
# The tables of which rows were ever hidden: a look-up each, where DISTINCT would read all.
_RECORDS = """
    WITH RECURSIVE known(record) AS (
        SELECT min(record) FROM hidden
        UNION ALL
        SELECT (SELECT min(record) FROM hidden WHERE record > known.record) FROM known
        WHERE known.record IS NOT NULL
    )
    SELECT record FROM known WHERE record IS NOT NULL
"""
_EVERY = (-(2**63), 2**63 - 1)
_KINDS = {int: "i", float: "f", str: "s"}


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """The visible rows of a table without empty values, in the order of `View.select`.

    Attributes:
        values: (N,) int64 or float64 in the unit of the column, or (N, size) uint8; by column.
        texts: (N,) int32 codes and the texts that they stand for, by column.
    """

    values: Mapping[str, NDArray[Any]]
    texts: Mapping[str, tuple[NDArray[np.int32], list[str]]]

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.values[name]

    def __len__(self) -> int:
        return len(self.values["revision"])

    @staticmethod
    def verified(table: Table, rows: Sequence[tuple[Any, ...]]) -> Columns:
        """Those of rows, in their order; see `verified_arrays`."""
        named = verified_arrays(table, list(rows))
        return Columns(
            {name: array for name, array in named.items() if not isinstance(array, tuple)},
            {name: array for name, array in named.items() if isinstance(array, tuple)},
        )

    def rows(self, chosen: NDArray[np.intp]) -> Columns:
        """The chosen rows, (n,) intp by place, in that order."""
        return Columns(
            {name: values[chosen] for name, values in self.values.items()},
            {name: (codes[chosen], texts) for name, (codes, texts) in self.texts.items()},
        )

    def newest(self, *key: str) -> Columns:
        """The last row of each combination of these columns, in their order."""
        keys = [self.texts[name][0] if name in self.texts else self.values[name] for name in key]
        order = np.lexsort(keys[::-1])
        last = np.ones(len(order), np.bool_)
        last[:-1] = np.any([one[order][1:] != one[order][:-1] for one in keys], axis=0)
        return self if last.all() else self.rows(np.sort(order[last]))


def read_columns(
    connection: Connection,
    view: View,
    table: Table,
    *,
    within: tuple[int, int] | None = None,
) -> Columns:
    """The visible rows of a table.

    Args:
        connection: a connection for reading.
        view: which rows are visible.
        table: has neither columns that may be empty nor bytes of varying number.
        within: only rows with primary keys from the first up to the second.

    Raises:
        MapCorruptError: a row does not match its checksum, or holds another number of bytes.
    """
    query = view.by_key(table)
    if within is not None:
        query = query.where(table.primary_key.columns[0].between(*within))
    found = connection.execute(query).cursor
    assert found is not None
    whole = Columns.verified(table, found.fetchall())
    return _in_history(connection, whole)


def verified_arrays(table: Table, rows: list[tuple[Any, ...]]) -> dict[str, Any]:
    """The columns of rows, each checked against its checksum; see `_core.verified_columns`."""
    columns = list(table.columns)[:-1]
    kinds = [_KINDS.get(column.type.python_type) or f"b{column.info['size']}" for column in columns]
    arrays, bad, at = _core.verified_columns(rows, kinds)
    if arrays is None:
        if at < 0:
            raise mismatch(table, rows[bad])
        raise MapCorruptError(
            f"table {table.name}: {describe(table, rows[bad])}: column {columns[at].name} takes "
            f"{kinds[at][1:]} bytes, not {rows[bad][at]!r:.40}"
        )
    return {column.name: array for column, array in zip(columns, arrays, strict=True)}


def _in_history(connection: Connection, columns: Columns) -> Columns:
    """Rows that are ordered by key, ordered by revision and then by key."""
    place_of = places_in_history(connection)
    known, which = np.unique(columns["revision"], return_inverse=True)
    place = np.array([place_of[key] for key in known.tolist()], np.int64)[which]
    if (np.diff(place) >= 0).all():
        return columns
    return columns.rows(np.argsort(place, kind="stable"))


@dataclass(frozen=True, slots=True, eq=False)
class Visible:
    """Which rows a view shows, without asking the database.

    What hides rows is looked up when they are met: a map may hide many more.

    Attributes:
        places: of the visible revisions in the history, by key.
        ask: gives rows of `_SAID`.
        records: the tables that have rows which were ever hidden, by name.
        until: largest key of the rows that are shown, by name of the table; of other tables all.
        erased: whether the map has erased rows.
    """

    places: Mapping[int, int]
    ask: Ask
    records: frozenset[str]
    until: Mapping[str, int] = field(default_factory=dict)
    erased: bool = False
    _hidden: dict[str, frozenset[int]] = field(default_factory=dict)

    @staticmethod
    def of(connection: Connection, *views: View, ask: Ask | None = None) -> list[Visible]:
        """What each view shows.

        Args:
            connection: of the map.
            views: the views.
            ask: for use when the connection is closed; None to ask the connection.
        """
        query = select(revisions.c.key, revisions.c.status, place_in_history())
        known = connection.execute(query.order_by(revisions.c.key)).fetchall()
        records = frozenset(connection.exec_driver_sql(_RECORDS).scalars())
        erased = connection.execute(select(receipts.c.key).limit(1)).first() is not None
        found = []
        for view in views:
            places = {
                key: place
                for key, status, place in known
                if key == view.own or (status == "committed" and place <= view.at)
            }
            asks = ask or connection.execute
            found.append(Visible(places, asks, records, erased=erased))
        return found

    def as_of_now(self, connection: Connection) -> Visible:
        """Without what an open revision adds, hides or shows later in the tables of a graph."""
        tables = (nodes, edges, path_entries, attempts, hidden)
        newest = {
            one.name: connection.execute(select(func.max(one.c.key))).scalar() or 0
            for one in tables
        }
        return replace(self, until=newest, _hidden={})

    def has(self, table: Table, key: int, revision: int) -> bool:
        """Whether a row is visible, by itself."""
        kept = key <= self.until.get(table.name, key) and key not in self.hidden_of(table)
        return kept and revision in self.places

    def hidden_of(self, table: Table) -> frozenset[int]:
        """Keys of all hidden rows of the table."""
        if table.name not in self._hidden:
            self._hidden[table.name] = self._hides(table, [_EVERY])
        return self._hidden[table.name]

    def hides(self, table: Table, keys: Keys) -> NDArray[np.bool_]:
        """(N,) whether the rows with these keys, (N,), are hidden."""
        gone = self._hidden.get(table.name)
        if gone is None:
            gone = self._hides(table, list(stretches(keys)))
        return np.isin(keys, list(gone)) if gone else np.zeros(len(keys), np.bool_)

    def _hides(self, table: Table, within: Sequence[tuple[int, int]]) -> frozenset[int]:
        erased = self.erased and table is nodes  # other erased rows are referred to by none
        if table.name not in self.records and not erased:
            return frozenset()
        newest: dict[int, tuple[int, int]] = {}
        last_key = self.until.get(hidden.name, LARGEST_KEY)
        for first, last in within:
            asked = {"record": str(table.name), "first": first, "last": last}
            for key, revision, target, hides in self.ask(_SAID, asked):
                place = self.places.get(revision, -1)
                if key <= last_key and place >= newest.get(target, (0, 0))[0]:
                    newest[target] = place, hides
        gone = {target for target, (_, hides) in newest.items() if hides}
        for first, last in within if erased else ():
            asked = {"record": str(table.name), "first": first, "last": last}
            gone |= {target for (target,) in self.ask(_ERASED, asked)}
        return frozenset(gone)

    def rows(self, connection: Connection, table: Table) -> Iterator[Row]:
        """The visible rows of a table without references to nodes, verified, by key."""
        query = select(table).order_by(table.primary_key.columns[0])
        for row in verified(table, connection.execute(query)):
            if self.has(table, next(iter(row.values())), row["revision"]):
                yield row

    def shows(self, table: Table, rows: Columns) -> NDArray[np.bool_]:
        """(N,) whether rows are visible: those that refer to a hidden node are hidden with it."""
        known, which = np.unique(rows["revision"], return_inverse=True)
        seen = np.array([key in self.places for key in known.tolist()], np.bool_)[which]
        key = table.primary_key.columns[0].name
        if table.name in self.until:
            seen &= rows[key] <= self.until[table.name]
        at_nodes = [(name, nodes) for name in ("a", "b", "node") if name in table.c]
        for name, target in ((key, table), *at_nodes):
            seen &= ~self.hides(target, rows[name])
        return seen

    def in_history(self, rows: Columns) -> Columns:
        """Rows ordered by revision, those of invisible ones first, and then by key."""
        return in_history(self.places, rows)


def in_history(places: Mapping[int, int], rows: Columns) -> Columns:
    """Rows ordered by the places of their revisions, by key, and then by their own keys."""
    known, which = np.unique(rows["revision"], return_inverse=True)
    place = np.array([places.get(key, 0) for key in known.tolist()], np.int64)[which]
    return rows.rows(np.lexsort((rows["key"], place)))


def stretches(keys: Iterable[int] | Keys) -> Iterator[tuple[int, int]]:
    """First and last of each stretch of successive keys."""
    ordered = np.unique(np.fromiter(keys, np.int64))
    ends = np.flatnonzero(np.diff(ordered) != 1)
    firsts = ordered[np.append(0, ends + 1)[: len(ordered)]]
    lasts = ordered[np.append(ends, len(ordered) - 1)[: len(ordered)]]
    yield from zip(firsts.tolist(), lasts.tolist(), strict=True)
