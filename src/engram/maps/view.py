"""Visible rows of a map, and the keys by which rows refer to each other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

from sqlalchemy import (
    ColumnElement,
    Connection,
    Select,
    Table,
    and_,
    bindparam,
    func,
    or_,
    select,
)

from engram.errors import MapCorruptError
from engram.graph.model import NodeId
from engram.maps.rows import Row, verified
from engram.maps.schema import KEYED, hidden, nodes, revisions
from engram.maps.sqlite import SqliteDatabase

# Rows of the writer's own open revision are newer than all committed ones.
_NEWEST = 2**62
_FEW = 500
_Key = TypeVar("_Key")
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
        return _hidden_keys(self, table)


# Cached, since reading a map needs the same statements again; views are values.
@lru_cache(maxsize=256)
def _rows_seen(view: View, table: Table) -> Select[tuple[object, ...]]:
    whole = _visible(view, table)
    joined = whole.select_from(table.join(revisions, revisions.c.key == table.c.revision))
    return joined.order_by(place_in_history(), table.primary_key.columns[0])


@lru_cache(maxsize=256)
def _rows_by_key(view: View, table: Table) -> Select[tuple[object, ...]]:
    return _visible(view, table).order_by(table.primary_key.columns[0])


@lru_cache(maxsize=256)
def _hidden_keys(view: View, table: Table) -> Select[tuple[int]]:
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
        .where(hidden.c.revision.in_(view.revision_keys()))
        .subquery()
    )
    return select(latest.c.target).where(latest.c.age == 1, latest.c.hidden == 1)


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


def places_in_history(connection: Connection) -> dict[int, int]:
    """`place_in_history` of all revisions, by key."""
    query = select(revisions.c.key, place_in_history()).order_by(revisions.c.key)
    return dict(map(tuple, connection.execute(query)))


def few(keys: Sequence[_Key]) -> Iterator[Sequence[_Key]]:
    """Parts of keys, each no more than one statement takes."""
    for at in range(0, len(keys), _FEW):
        yield keys[at : at + _FEW]


def head(connection: Connection) -> int:
    """Number of the newest committed revision; 0 if there is none."""
    newest = select(func.max(revisions.c.number)).where(revisions.c.status == "committed")
    return connection.execute(newest).scalar() or 0


# Of 64 bits, with room left: no writer comes near it.
LARGEST_KEY = 2**62
# Keys of erased rows are not given again: other rows still name them.
_NEWEST_KEYS = "SELECT " + ", ".join(
    f"(SELECT max(key) FROM (SELECT max(key) AS key FROM {one.name} UNION ALL "
    f"SELECT max(target) FROM receipts WHERE record = '{one.name}'))"
    for one in KEYED
)
_NODE_OF_UUID = (
    select(nodes.c.key, nodes.c.revision)
    .where(nodes.c.uuid == bindparam("uuid"))
    .order_by(nodes.c.key)
)


class KeyBook:
    """The next free key of each table, and the keys of nodes by their UUIDs.

    Only for the holder of the writer lock, so that no other process assigns keys.
    """

    def __init__(self, database: SqliteDatabase, view: View) -> None:
        self._database = database
        self._view = view
        self._nodes: dict[bytes, int] = {}
        # The visible revisions and the hidden nodes; read on first use.
        self._seen: tuple[frozenset[object], frozenset[object]] | None = None
        with database.reading() as connection:
            newest = connection.exec_driver_sql(_NEWEST_KEYS).one()
        self._next = {table: (key or 0) + 1 for table, key in zip(KEYED, newest, strict=True)}

    def next(self, table: Table) -> int:
        """An unused key of the table.

        Raises:
            MapCorruptError: a stranger's row has a key after which there are none.
        """
        key = self._next[table]
        if key > LARGEST_KEY:
            raise MapCorruptError(
                f"{self._database.name}: table {table.name} has the key {key - 1}, after which "
                "there is no room; run engram check"
            )
        self._next[table] = key + 1
        return key

    def first_keys(self, tables: Iterable[Table]) -> dict[str, int]:
        """The next key of each table, by name; that of a table without keys is its node's."""
        return {table.name: self._next[table if table in self._next else nodes] for table in tables}

    def begin_at(self, first_keys: Mapping[str, int]) -> None:
        """Gives no key below these, by table: keys of rows that were removed are free again."""
        for table in self._next:
            self._next[table] = max(self._next[table], first_keys.get(table.name, 0))

    def set_view(self, view: View) -> None:
        """Changes the visible revision."""
        self._view = view
        self._seen = None

    def find_node(self, node: NodeId) -> int | None:
        """Key of a node that is visible or was announced by `learn_node`; None if there is none."""
        key = self._nodes.get(node.bytes)
        if key is None:
            found = self._database.first(_NODE_OF_UUID, {"uuid": node.bytes})
            if found is None or not self._is_seen(*found):
                return None
            key = self._nodes[node.bytes] = int(found[0])
        return key

    def learn_node(self, node: NodeId, key: int) -> None:
        """Announces a node that will be written."""
        self._nodes[node.bytes] = key

    def forget_nodes(self) -> None:
        """Forgets announced nodes, and which are hidden."""
        self._nodes.clear()
        self._seen = None

    def _is_seen(self, key: int, revision: int) -> bool:
        if self._seen is None:
            with self._database.reading() as connection:
                self._seen = (
                    frozenset(connection.execute(self._view.revision_keys()).scalars()),
                    frozenset(connection.execute(self._view.hidden_keys(nodes)).scalars()),
                )
        return revision in self._seen[0] and key not in self._seen[1]
