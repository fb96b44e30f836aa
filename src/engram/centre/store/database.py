"""The service's database: SQLite in the centre's folder, or PostgreSQL."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from sqlalchemy import (
    URL,
    Connection,
    Engine,
    Select,
    Table,
    create_engine,
    event,
    insert,
    inspect,
    select,
    text,
    update,
)
from sqlalchemy.dialects.postgresql import insert as insert_postgresql
from sqlalchemy.dialects.sqlite import insert as insert_sqlite
from sqlalchemy.exc import ArgumentError, DataError, DBAPIError

from engram import PRE_RELEASE, __version__
from engram.centre.errors import StoreError
from engram.centre.store.schema import VERSION, centre, metadata
from engram.errors import FormatVersionError, InputError, MissingExtraError, StorageFullError
from engram.sqlite import is_full

_BUSY_S = 30.0
# One writer at a time on PostgreSQL too: numbers of the audit and of completion have no gaps.
_WRITERS = 0x456E6772
_DISK_FULL = "53100"  # of PostgreSQL


class ServiceDatabase:
    """Transactions on the service's tables; makes them where they are missing.

    Args:
        url: SQLAlchemy's.

    Raises:
        InputError: the address is not one.
        FormatVersionError: a newer Engram wrote it.
        StoreError: it cannot be reached.
    """

    def __init__(self, url: str | URL) -> None:
        self._engine = _engine(url)
        self._sqlite = self._engine.dialect.name == "sqlite"
        # Threads queue here: those that SQLite turns away sleep ever longer, and starve.
        self._turn = threading.Lock()
        self._log = _SharedSync(f"{self._engine.url.database}-wal")
        with self.writing() as connection:
            self._migrate(connection)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection for selects."""
        with _errors(), self._engine.connect() as connection:
            yield connection

    @contextmanager
    def writing(self, *, durable: bool = True) -> Iterator[Connection]:
        """One transaction, alone; rolled back if the block raises.

        Args:
            durable: whether it must outlast a power cut. What is said again by itself, such as
                reports and tokens, need not wait for the disk; a kill loses nothing either way.

        Raises:
            InputError: a value that no table takes.
            StorageFullError: no space is left for it.
            StoreError: the database cannot be written to.
        """
        with self._turn, _errors(), self._engine.connect() as connection:
            if self._sqlite:
                connection.exec_driver_sql("BEGIN IMMEDIATE")
            else:
                connection.execute(text(f"SELECT pg_advisory_xact_lock({_WRITERS})"))
                if not durable:
                    connection.execute(text("SET LOCAL synchronous_commit TO OFF"))
            yield connection
            connection.commit()
        if durable and self._sqlite:
            self._log.sync()

    def add(self, connection: Connection, table: Table, rows: list[dict[str, Any]]) -> int:
        """Adds rows whose keys are new; returns how many."""
        if not rows:
            return 0
        make = insert_sqlite if self._sqlite else insert_postgresql
        statement = make(table).on_conflict_do_nothing()
        return connection.execute(statement, rows).rowcount

    def put(self, connection: Connection, table: Table, row: Mapping[str, Any]) -> None:
        """Adds a row, or replaces the one with its key."""
        key = [column.name for column in table.primary_key.columns]
        make = insert_sqlite if self._sqlite else insert_postgresql
        rest = {name: value for name, value in row.items() if name not in key}
        statement = make(table).values(**row)
        connection.execute(statement.on_conflict_do_update(index_elements=key, set_=rest))

    def close(self) -> None:
        """Closes all connections."""
        self._engine.dispose()

    @staticmethod
    def _migrate(connection: Connection) -> None:
        """Brings the tables to this version, in the transaction that is open."""
        if not inspect(connection).has_table(centre.name):
            metadata.create_all(connection)
            connection.execute(insert(centre).values(key=1, version=VERSION))
            return
        version = connection.execute(select(centre.c.version)).scalar_one()
        if version > VERSION:
            raise FormatVersionError(
                f"the centre's tables are of version {version}, this Engram reads up to "
                f"{VERSION}: upgrade Engram ({__version__} is {PRE_RELEASE})"
            )
        for step in range(version, VERSION):
            for statement in MIGRATIONS[step]:
                connection.execute(text(statement))
        connection.execute(update(centre).values(version=VERSION))


# Statements that bring the tables from this version to the next.
MIGRATIONS: dict[int, tuple[str, ...]] = {
    1: (
        "CREATE TABLE dreams (id TEXT NOT NULL PRIMARY KEY, map TEXT NOT NULL, state TEXT NOT NULL,"
        " asked_by TEXT NOT NULL, asked_ns BIGINT NOT NULL, ended_ns BIGINT, since BIGINT NOT NULL,"
        " revision BIGINT, progress TEXT NOT NULL, report TEXT, error TEXT)",
    ),
}


def rows_of(connection: Connection, query: Select[Any]) -> list[dict[str, Any]]:
    """The rows of a select as dicts."""
    return [dict(row) for row in connection.execute(query).mappings()]


def first_row(connection: Connection, query: Select[Any]) -> dict[str, Any] | None:
    """The first row of a select; None if there is none."""
    return next(iter(rows_of(connection, query.limit(1))), None)


class _SharedSync:
    """Makes SQLite's log durable, after the turn: one sync covers all earlier commits.

    SQLite syncs the log by itself only before it moves rows from there into the database.

    Args:
        path: of the log.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._turn = threading.Lock()
        self._count = threading.Lock()
        self._asked = self._done = 0

    def sync(self) -> None:
        """Returns once all that was committed before the call is on the disk.

        Raises:
            StoreError: the disk does not take it.
        """
        with self._count:
            self._asked += 1
            mine = self._asked
        with self._turn:
            if self._done >= mine:
                return
            served = self._asked
            try:
                self._sync_file()
            except OSError as error:
                fact = f"the centre's database: {self._path}: {error.strerror}"
                raise StoreError(fact) from error
            self._done = served

    def _sync_file(self) -> None:
        try:
            file = os.open(self._path, os.O_RDONLY)
        except FileNotFoundError:  # the last connection moved all of it into the database
            return
        try:
            os.fsync(file)
        finally:
            os.close(file)


def _engine(url: str | URL) -> Engine:
    try:
        engine = create_engine(url, pool_size=8, max_overflow=-1)
    except ArgumentError as error:
        raise InputError(f"not a valid database address: {error}") from error
    except ImportError as error:
        raise MissingExtraError(
            "a centre on PostgreSQL needs its driver: pip install 'engram-localisation[server]'"
        ) from error
    if engine.dialect.name == "sqlite":

        @event.listens_for(engine, "connect")
        def connect(connection: Any, _: object) -> None:
            connection.isolation_level = None  # transactions begin explicitly
            connection.execute(f"PRAGMA busy_timeout={round(_BUSY_S * 1000)}")
            connection.execute("PRAGMA journal_mode=WAL")
            connection.execute("PRAGMA synchronous=NORMAL")  # `writing` syncs what must be durable

    return engine


@contextmanager
def _errors() -> Iterator[None]:
    try:
        yield
    except DataError as error:  # a NUL, or a number beyond 64 bits, which no column takes
        raise InputError(f"a value that no table takes: {error.orig}") from error
    except DBAPIError as error:
        full = is_full(error.orig) or getattr(error.orig, "sqlstate", None) == _DISK_FULL
        kind = StorageFullError if full else StoreError
        raise kind(f"the centre's database: {error.orig}") from error
