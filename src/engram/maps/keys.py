"""Keys of rows: 64-bit integers, assigned by the only writer in the order of writing."""

from __future__ import annotations

from sqlalchemy import Table, func, select

from engram.errors import MapCorruptError
from engram.graph.model import NodeId
from engram.maps.schema import KEYED, nodes
from engram.maps.sqlite import SqliteDatabase
from engram.maps.view import View

# Of 64 bits, with room left: no writer comes near it.
LARGEST_KEY = 2**62


class KeyBook:
    """The next free key of each table, and the keys of nodes by their UUIDs.

    Only for the holder of the writer lock, so that no other process assigns keys.
    """

    def __init__(self, database: SqliteDatabase, view: View) -> None:
        self._database = database
        self._view = view
        self._nodes: dict[bytes, int] | None = None  # read on first use
        with database.reading() as connection:
            self._next = {
                table: (connection.execute(select(func.max(table.c.key))).scalar() or 0) + 1
                for table in KEYED
            }

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

    def set_view(self, view: View) -> None:
        """Changes the visible revision."""
        self._view = view

    def find_node(self, node: NodeId) -> int | None:
        """Key of a node that is visible or was announced by `learn_node`; None if there is none."""
        return self._known_nodes().get(node.bytes)

    def learn_node(self, node: NodeId, key: int) -> None:
        """Announces a node that will be written."""
        self._known_nodes()[node.bytes] = key

    def forget_nodes(self) -> None:
        """Forgets announced nodes."""
        self._nodes = None

    def _known_nodes(self) -> dict[bytes, int]:
        if self._nodes is None:
            query = self._view.select(nodes).with_only_columns(nodes.c.uuid, nodes.c.key)
            with self._database.reading() as connection:
                self._nodes = {row[0]: row[1] for row in connection.execute(query)}
        return self._nodes
