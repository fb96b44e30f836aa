"""Visible rows: those of committed revisions up to one, and not hidden."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

from sqlalchemy import ColumnElement, Connection, Select, Table, and_, func, or_, select

from engram.maps.rows import Row, verified
from engram.maps.schema import hidden, nodes, revisions

# Rows of the writer's own open revision are newer than all committed ones.
_NEWEST = 2**62
# Rows that refer to a hidden node are hidden with it.
_NODE_COLUMNS = {"a", "b", "node"}


@dataclass(frozen=True, slots=True)
class View:
    """A map as of one revision.

    Attributes:
        at: number of the newest visible revision; 0 for an empty map.
        own: key of the writer's open revision, which it sees itself; None for readers.
    """

    at: int
    own: int | None = None

    def revision_keys(self) -> Select[tuple[int]]:
        """Keys of the visible revisions."""
        committed = and_(revisions.c.status == "committed", revisions.c.number <= self.at)
        seen = committed if self.own is None else or_(committed, revisions.c.key == self.own)
        return select(revisions.c.key).where(seen)

    def select(self, table: Table) -> Select[tuple[object, ...]]:
        """All columns of the visible rows.

        Ordered by revision, then by key: of rows that supersede each other the newest is last.
        """
        return _rows_seen(self, table)

    def by_key(self, table: Table) -> Select[tuple[object, ...]]:
        """All columns of the visible rows, in the order of their keys, which takes no sorting."""
        return _rows_by_key(self, table)

    def rows(self, connection: Connection, table: Table) -> Iterator[Row]:
        """The visible rows, verified, in the order of `select`."""
        return verified(table, connection.execute(self.select(table)))

    def hidden_keys(self, table: Table) -> Select[tuple[int]]:
        """Keys of the table's rows whose newest `hidden` row hides them."""
        place = place_in_history()
        latest = (
            select(
                hidden.c.target,
                hidden.c.hidden,
                func.row_number()
                .over(partition_by=hidden.c.target, order_by=[place.desc(), hidden.c.key.desc()])
                .label("age"),
            )
            .select_from(hidden.join(revisions, revisions.c.key == hidden.c.revision))
            .where(hidden.c.record == table.name)
            .where(hidden.c.revision.in_(self.revision_keys()))
            .subquery()
        )
        return select(latest.c.target).where(latest.c.age == 1, latest.c.hidden == 1)


# Cached, since reading a map needs the same statements again; views are values.
@lru_cache(maxsize=256)
def _rows_seen(view: View, table: Table) -> Select[tuple[object, ...]]:
    whole = _visible(view, table)
    joined = whole.select_from(table.join(revisions, revisions.c.key == table.c.revision))
    return joined.order_by(place_in_history(), table.primary_key.columns[0])


@lru_cache(maxsize=256)
def _rows_by_key(view: View, table: Table) -> Select[tuple[object, ...]]:
    return _visible(view, table).order_by(table.primary_key.columns[0])


def _visible(view: View, table: Table) -> Select[tuple[object, ...]]:
    query = (
        select(*table.columns)
        .where(table.c.revision.in_(view.revision_keys()))
        .where(table.primary_key.columns[0].not_in(view.hidden_keys(table)))
    )
    for end in sorted(_NODE_COLUMNS & set(table.columns.keys())):
        query = query.where(table.c[end].not_in(view.hidden_keys(nodes)))
    return query


def place_in_history() -> ColumnElement[int]:
    """Order of revisions: by number, with an open one last."""
    return func.coalesce(revisions.c.number, _NEWEST)


def head(connection: Connection) -> int:
    """Number of the newest committed revision; 0 if there is none."""
    newest = select(func.max(revisions.c.number)).where(revisions.c.status == "committed")
    return connection.execute(newest).scalar() or 0
