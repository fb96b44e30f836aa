"""Which rows can be seen: those of committed revisions up to one, and not hidden."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

from sqlalchemy import ColumnElement, Connection, Select, Table, and_, func, or_, select

from engram.maps.rows import Row, verified
from engram.maps.schema import hidden, nodes, revisions

# Rows of the writer's own open revision are newer than all that is committed.
_NEWEST = 2**62
# What refers to a hidden node is hidden with it.
_NODE_COLUMNS = {"a", "b", "node"}


@dataclass(frozen=True, slots=True)
class View:
    """A map as of one revision.

    Attributes:
        at: number of the newest revision that is seen; 0 sees nothing.
        own: key of the open revision that is being written and sees itself; None for readers.
    """

    at: int
    own: int | None = None

    def revision_keys(self) -> Select[tuple[int]]:
        """Keys of the revisions that are seen."""
        committed = and_(revisions.c.status == "committed", revisions.c.number <= self.at)
        seen = committed if self.own is None else or_(committed, revisions.c.key == self.own)
        return select(revisions.c.key).where(seen)

    def select(self, table: Table) -> Select[tuple[object, ...]]:
        """All columns of the rows that are seen.

        Ordered by their revision's place in history, then by key: of rows that supersede each
        other the newest is last.
        """
        return _rows_seen(self, table)

    def rows(self, connection: Connection, table: Table) -> Iterator[Row]:
        """The rows that are seen, verified, in the order of `select`."""
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


# A map's statements are asked for again and again while it is read: views are values.
@lru_cache(maxsize=256)
def _rows_seen(view: View, table: Table) -> Select[tuple[object, ...]]:
    query = (
        select(*table.columns)
        .select_from(table.join(revisions, revisions.c.key == table.c.revision))
        .where(table.c.revision.in_(view.revision_keys()))
        .where(table.primary_key.columns[0].not_in(view.hidden_keys(table)))
        .order_by(place_in_history(), table.primary_key.columns[0])
    )
    for end in sorted(_NODE_COLUMNS & set(table.columns.keys())):
        query = query.where(table.c[end].not_in(view.hidden_keys(nodes)))
    return query


def place_in_history() -> ColumnElement[int]:
    """By what revisions are ordered: their numbers, and an open one after all."""
    return func.coalesce(revisions.c.number, _NEWEST)


def head(connection: Connection) -> int:
    """Number of the newest committed revision; 0 if there is none."""
    newest = select(func.max(revisions.c.number)).where(revisions.c.status == "committed")
    return connection.execute(newest).scalar() or 0
