"""What the store asks of a database: SQLite is one (`sqlite`), PostgreSQL another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol

from sqlalchemy import Connection, Executable, Select, Table

from engram.errors import MapCorruptError
from engram.maps.lock import Holder


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
