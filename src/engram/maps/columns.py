"""Many rows of one table at once, as verified columns: a map is opened by these."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table

from engram import _core
from engram.errors import MapCorruptError
from engram.maps.rows import describe, mismatch
from engram.maps.view import View, places_in_history

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
    sizes: Mapping[str, int] | None = None,
    *,
    within: tuple[int, int] | None = None,
) -> Columns:
    """The visible rows of a table.

    Args:
        connection: a connection for reading.
        view: which rows are visible.
        table: has neither columns that may be empty nor bytes of varying number.
        sizes: number of bytes in each column of bytes.
        within: only rows with primary keys from the first up to the second.

    Raises:
        MapCorruptError: a row does not match its checksum, or holds another number of bytes.
    """
    query = view.by_key(table)
    if within is not None:
        query = query.where(table.primary_key.columns[0].between(*within))
    found = connection.execute(query).cursor
    assert found is not None
    named = verified_arrays(table, list(found.fetchall()), sizes or {})
    whole = Columns(
        {name: array for name, array in named.items() if not isinstance(array, tuple)},
        {name: array for name, array in named.items() if isinstance(array, tuple)},
    )
    return _in_history(connection, whole)


def verified_arrays(
    table: Table, rows: list[tuple[Any, ...]], sizes: Mapping[str, int]
) -> dict[str, Any]:
    """The columns of rows, each checked against its checksum; see `_core.verified_columns`."""
    columns = list(table.columns)[:-1]
    kinds = [_KINDS.get(column.type.python_type) or f"b{sizes[column.name]}" for column in columns]
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
