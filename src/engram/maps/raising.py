"""Bringing a map of an older format to the newest, in whatever database it lies."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Connection, delete, insert, text
from sqlalchemy.schema import CreateTable

from engram import __version__
from engram.maps.rows import sealed
from engram.maps.schema import FORMAT_VERSION, map_format, missing_in, rebuilt_from


def raise_tables(
    connection: Connection, version: int, free_names: Callable[[Connection, str], None]
) -> None:
    """Makes the tables that are new, copies those whose constraints changed, notes the format.

    Args:
        connection: in a transaction, which makes it all or nothing.
        version: the format that the map has.
        free_names: called with a table that was renamed out of the way: frees those names of its
            constraints that its successor needs.
    """
    for table in missing_in(version):
        connection.execute(CreateTable(table))
    for table in rebuilt_from(version):
        connection.execute(text(f"ALTER TABLE {table.name} RENAME TO older"))
        free_names(connection, "older")
        connection.execute(CreateTable(table))
        columns = ", ".join(table.columns.keys())
        copied = f"INSERT INTO {table.name} ({columns}) SELECT {columns} FROM older ORDER BY key"
        connection.execute(text(copied))
        connection.execute(text("DROP TABLE older"))
    connection.execute(delete(map_format))
    row = {"key": 1, "version": FORMAT_VERSION, "tool_version": __version__}
    connection.execute(insert(map_format), sealed(map_format, row))
