"""The interface of a map to its database, and the upgrade of older formats."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol

from sqlalchemy import Connection, Executable, Select, Table, delete, insert, text
from sqlalchemy.exc import NoResultFound
from sqlalchemy.schema import CreateTable
from sqlalchemy.sql.base import ReadOnlyColumnCollection

from engram import __version__
from engram.errors import EngramError, MapCorruptError
from engram.files import Holder
from engram.maps.rows import sealed
from engram.maps.schema import FORMAT_VERSION, map_format, missing_in, rebuilt_from
from engram.maps.tally import count_tags

_STUMBLES = (TypeError, ValueError, LookupError, ArithmeticError, NoResultFound)


@contextmanager
def damage_named(name: str) -> Iterator[None]:
    """Adds the map's name to errors about damaged rows.

    Args:
        name: path or address of the map.

    Raises:
        MapCorruptError: as raised within, with the name before it, once.
    """
    try:
        yield
    except MapCorruptError as error:
        if str(error).startswith(name):
            raise
        raise MapCorruptError(f"{name}: {error}") from error


@contextmanager
def reading_rows(name: str) -> Iterator[None]:
    """`damage_named`, where rows become records: what they stumble over is a damaged row.

    Checksums find damage, not what a stranger wrote on purpose: a text of the wrong form, a number
    out of range, a row that refers to none. Whatever such values raise is one error, with its
    cause.

    Args:
        name: path or address of the map.

    Raises:
        MapCorruptError: a row holds what no map holds.
    """
    with damage_named(name):
        try:
            yield
        except EngramError:
            raise
        except _STUMBLES as error:
            raise MapCorruptError(
                f"a record is malformed ({type(error).__name__}: {error!s:.200}); run "
                "engram check, and restore a copy"
            ) from error


class Lock(Protocol):
    """The lock of the only writer."""

    @property
    def holder(self) -> Holder:
        """The process that holds the lock."""
        ...

    def release(self) -> None:
        """Releases the lock."""
        ...


class Database(Protocol):
    """Connections, transactions, errors and the few statements that differ between databases.

    All errors that a connection raises inside `reading` and `writing` come out as `MapError`s,
    and a `MapCorruptError` that is raised there names the map.
    """

    @property
    def name(self) -> str:
        """Path or address, for messages."""
        ...

    @property
    def format_version(self) -> int:
        """Stored format of the map; locking it for writing upgrades it to the newest."""
        ...

    def reading(self) -> AbstractContextManager[Connection]:
        """A connection for selects, from any thread."""
        ...

    def first(self, query: Select[Any], parameters: dict[str, Any]) -> Sequence[Any] | None:
        """The first row of a select, from any thread; None if there is none.

        A fast path, for the one select that runs thousands of times a second.
        """
        ...

    def writing(self) -> AbstractContextManager[Connection]:
        """One durable transaction; rolled back if the block raises."""
        ...

    def lock_for_writing(self) -> Lock:
        """Locks the map for writing, and upgrades it to the newest format.

        Raises:
            MapLockedError: another process holds the lock.
        """
        ...

    def writer(self) -> Holder | None:
        """The current writer; None without one."""
        ...

    def replace(self, table: Table, key: tuple[str, ...]) -> Executable:
        """An insert that replaces a row with the same values in the columns `key`.

        The row takes all other values, including its primary key.
        """
        ...

    def integrity_problems(self) -> list[str]:
        """Faults that the database itself finds in its file."""
        ...

    def size_bytes(self) -> int:
        """Size on disk, bytes."""
        ...

    def close(self) -> None:
        """Closes all connections."""
        ...


class Place(Protocol):
    """The place of a map, existing or new, that is not a file."""

    def create(self) -> None:
        """Creates an empty map.

        Raises:
            InputError: the map exists.
        """
        ...

    def open(self) -> Database:
        """The database of the map.

        Raises:
            NotAMapError: the map does not exist.
        """
        ...


def replaced(proposed: ReadOnlyColumnCollection[str, Any], key: tuple[str, ...]) -> dict[str, Any]:
    """The columns that an upsert sets: all but those of the key."""
    return {column.name: column for column in proposed if column.name not in key}


def raise_tables(
    connection: Connection,
    version: int,
    free_names: Callable[[Connection, str], None] | None = None,
) -> None:
    """Creates new tables, copies those whose constraints changed, and writes the format.

    Args:
        connection: in a transaction, which makes the upgrade atomic.
        version: the format of the map so far.
        free_names: called with a renamed old table, to free the names of its constraints for
            its successor; None if constraints have no names.
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
    write_format(connection)


def write_format(connection: Connection) -> None:
    """Writes the rows that every map has: its format, and the tally of its tags."""
    connection.execute(delete(map_format))
    row = {"key": 1, "version": FORMAT_VERSION, "tool_version": __version__}
    connection.execute(insert(map_format), sealed(map_format, row))
    count_tags(connection)
