"""What a map asks of a database, and how one of an older format is brought to the newest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol

from sqlalchemy import Connection, Executable, Select, Table, delete, insert, text
from sqlalchemy.schema import CreateTable
from sqlalchemy.sql.base import ReadOnlyColumnCollection

from engram import __version__
from engram.errors import MapCorruptError
from engram.files import Holder
from engram.maps.rows import sealed
from engram.maps.schema import FORMAT_VERSION, map_format, missing_in, rebuilt_from


@contextmanager
def damage_named(name: str) -> Iterator[None]:
    """Says of which map it is what finds its rows damaged: rows do not know, and maps are many.

    Args:
        name: path or address of the map.

    Raises:
        MapCorruptError: as it was raised within, with the name before it, once.
    """
    try:
        yield
    except MapCorruptError as error:
        if str(error).startswith(name):
            raise
        raise MapCorruptError(f"{name}: {error}") from error


class Lock(Protocol):
    """The right to be the only writer."""

    @property
    def holder(self) -> Holder:
        """Who has it."""
        ...

    def release(self) -> None:
        """Let others write."""
        ...


class Database(Protocol):
    """Connections, transactions, errors and the few statements that differ between databases.

    All errors that a connection raises inside `reading` and `writing` come out as `MapError`s,
    and a `MapCorruptError` that is raised there bears the map's name.
    """

    @property
    def name(self) -> str:
        """Path or address, for messages."""
        ...

    @property
    def format_version(self) -> int:
        """Format of the map as it lies there; becoming its writer raises it to the newest."""
        ...

    def reading(self) -> AbstractContextManager[Connection]:
        """A connection for selects, from any thread."""
        ...

    def first(self, query: Select[Any], parameters: dict[str, Any]) -> Sequence[Any] | None:
        """The first row of a select, by the shortest way, from any thread; None if there is none.

        For the one select that runs thousands of times a second.
        """
        ...

    def writing(self) -> AbstractContextManager[Connection]:
        """One durable transaction: all of it, or nothing if the block raises."""
        ...

    def lock_for_writing(self) -> Lock:
        """Become the only writer. A map of an older format is raised to the newest.

        Raises:
            MapLockedError: somebody else is.
        """
        ...

    def writer(self) -> Holder | None:
        """Who writes now."""
        ...

    def replace(self, table: Table, key: tuple[str, ...]) -> Executable:
        """An insert that takes the place of a row with the same values in the columns `key`.

        The row takes on all other values, its primary key too.
        """
        ...

    def integrity_problems(self) -> list[str]:
        """What the database itself finds wrong with its file."""
        ...

    def size_bytes(self) -> int:
        """Bytes on disk."""
        ...

    def close(self) -> None:
        """Give back all connections."""
        ...


class Place(Protocol):
    """Where a map lies, or is to lie, that is not a file."""

    def create(self) -> None:
        """Make an empty map.

        Raises:
            InputError: there is one already.
        """
        ...

    def open(self) -> Database:
        """The database of the map.

        Raises:
            NotAMapError: there is none.
        """
        ...


def replaced(proposed: ReadOnlyColumnCollection[str, Any], key: tuple[str, ...]) -> dict[str, Any]:
    """What an upsert sets: all columns of the row that is in the way, but those of the key."""
    return {column.name: column for column in proposed if column.name not in key}


def raise_tables(
    connection: Connection,
    version: int,
    free_names: Callable[[Connection, str], None] | None = None,
) -> None:
    """Make the tables that are new, copy those whose constraints changed, note the format.

    Args:
        connection: in a transaction, which makes it all or nothing.
        version: the format that the map has.
        free_names: called with a table that was renamed out of the way: frees those names of its
            constraints that its successor needs; None where constraints have no names.
    """
    for table in missing_in(version):
        connection.execute(CreateTable(table))
    for table in rebuilt_from(version):
        connection.execute(text(f"ALTER TABLE {table.name} RENAME TO older"))
        if free_names is not None:
            free_names(connection, "older")
        connection.execute(CreateTable(table))
        columns = ", ".join(table.columns.keys())
        copied = f"INSERT INTO {table.name} ({columns}) SELECT {columns} FROM older ORDER BY key"
        connection.execute(text(copied))
        connection.execute(text("DROP TABLE older"))
    connection.execute(delete(map_format))
    row = {"key": 1, "version": FORMAT_VERSION, "tool_version": __version__}
    connection.execute(insert(map_format), sealed(map_format, row))
