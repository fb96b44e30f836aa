"""The service's database, SQLite or PostgreSQL: transactions, wake-ups, and the audit log.

The audit log: every change of state, each row bound to the one before by a hash. It is the stream
of events as well.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from sqlalchemy import (
    URL,
    ColumnElement,
    Connection,
    CursorResult,
    Engine,
    create_engine,
    event,
    insert,
    inspect,
    make_url,
    select,
    text,
    update,
)
from sqlalchemy.dialects.postgresql import insert as insert_postgresql
from sqlalchemy.dialects.sqlite import insert as insert_sqlite
from sqlalchemy.exc import ArgumentError, DataError, DBAPIError

from engram import __version__
from engram.errors import (
    FormatVersionError,
    InputError,
    MapLockedError,
    StorageFullError,
    extra,
)
from engram.files import WriterLock
from engram.fleet.centre.problems import StoreError
from engram.fleet.centre.tables import (
    TABLES,
    VERSION,
    Event,
    Row,
    Schema,
    audit,
    centre,
    metadata,
    published,
    subjects,
    values_of,
)
from engram.sqlite import is_full

_BUSY_S = 30.0
# One writer at a time on PostgreSQL too: numbers of the audit and of completion have no gaps.
_WRITERS = 0x456E6772
_DISK_FULL = "53100"  # of PostgreSQL
# Of tables that lack only the one of published maps.
_WITHOUT_COPIES = 3
# A machine that is gone without a word is noticed within a minute, and its lanes are free.
_KEPT_ALIVE = {"idle": 30, "interval": 10, "count": 3}


class ServiceDatabase:
    """Transactions on the service's tables; makes them where they are missing.

    Args:
        url: SQLAlchemy's.

    Raises:
        InputError: the address is not one.
        FormatVersionError: its tables are of another version.
        StoreError: it cannot be reached.
    """

    def __init__(self, url: str | URL) -> None:
        self._engine = _engine(url)
        self._sqlite = self._engine.dialect.name == "sqlite"
        # Threads queue here: those that SQLite turns away sleep ever longer, and starve.
        self._turn = threading.Lock()
        self._log = _SharedSync(f"{self._engine.url.database}-wal")
        with self.writing() as connection:
            self._make_tables(connection)

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

    def add(self, connection: Connection, row: object) -> bool:
        """Adds a row if its key is new; returns whether it was."""
        return self._insert(connection, type(row), values_of(row)).rowcount == 1

    def add_all(self, connection: Connection, rows: Sequence[object]) -> None:
        """Adds those rows of one table whose keys are new."""
        if rows:
            self._insert(connection, type(rows[0]), [values_of(row) for row in rows])

    def _insert(self, connection: Connection, kind: type, values: Any) -> CursorResult[Any]:
        make = insert_sqlite if self._sqlite else insert_postgresql
        return connection.execute(make(TABLES[kind]).on_conflict_do_nothing(), values)

    def put(self, connection: Connection, row: object) -> None:
        """Adds a row, or replaces the one with its key."""
        table, values = TABLES[type(row)], values_of(row)
        key = [column.name for column in table.primary_key.columns]
        make = insert_sqlite if self._sqlite else insert_postgresql
        rest = {name: value for name, value in values.items() if name not in key}
        statement = make(table).values(**values)
        connection.execute(statement.on_conflict_do_update(index_elements=key, set_=rest))

    def rows(
        self,
        kind: type[Row],
        *where: ColumnElement[bool],
        order: Any = (),
        limit: int | None = None,
    ) -> list[Row]:
        """Rows of a table; see `rows_of`."""
        with self.reading() as connection:
            return rows_of(connection, kind, *where, order=order, limit=limit)

    def row(self, kind: type[Row], *where: ColumnElement[bool]) -> Row | None:
        """The first row of a table to which the conditions apply; None if there is none."""
        return next(iter(self.rows(kind, *where, limit=1)), None)

    def lane(self, name: str) -> WriterLock | AdvisoryLock:
        """Takes a lock that all who use this database share, until `release` or death.

        Raises:
            MapLockedError: another worker has it.
            StoreError: the database cannot be reached.
        """
        if self._sqlite:
            path = Path(self._engine.url.database or "")
            return WriterLock(path.with_name(f"{path.name}.{name}.lane"))
        return AdvisoryLock(self._engine, name)

    def close(self) -> None:
        """Closes all connections."""
        self._engine.dispose()

    @staticmethod
    def _make_tables(connection: Connection) -> None:
        """Makes the tables in an empty database; refuses those of another version."""
        if not inspect(connection).has_table(centre.name):
            metadata.create_all(connection)
            connection.execute(insert(centre).values(**values_of(Schema(1, VERSION))))
            return
        version = connection.execute(select(centre.c.version)).scalar_one()
        if version == _WITHOUT_COPIES:
            published.create(connection, checkfirst=True)
            connection.execute(update(centre).values(version=VERSION))
        elif version != VERSION:
            raise FormatVersionError(
                f"the centre's tables are of version {version}, Engram {__version__} uses "
                f"{VERSION}: open it with the Engram that wrote it, or copy its maps/*.engram into "
                "a new centre, give each to engram centre map, and enrol the robots there"
            )


def rows_of(
    connection: Connection,
    kind: type[Row],
    *where: ColumnElement[bool],
    order: Any = (),
    limit: int | None = None,
) -> list[Row]:
    """The rows of a table to which all conditions apply.

    Args:
        connection: a connection.
        kind: the class of the rows.
        *where: conditions.
        order: by which they are sorted: columns.
        limit: how many at most; None for all.
    """
    columns = order if isinstance(order, tuple) else (order,)
    query = select(TABLES[kind]).where(*where).order_by(*columns).limit(limit)
    return [kind(*row) for row in connection.execute(query)]


def first_row(connection: Connection, kind: type[Row], *where: ColumnElement[bool]) -> Row | None:
    """The first row of a table to which the conditions apply; None if there is none."""
    return next(iter(rows_of(connection, kind, *where, limit=1)), None)


class AdvisoryLock:
    """A lock in PostgreSQL, held by a connection of its own.

    Raises:
        MapLockedError: another connection holds it.
        StoreError: the database cannot be reached.
    """

    def __init__(self, engine: Engine, name: str) -> None:
        key = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big", signed=True)
        with _errors():
            self._connection = engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        try:
            with _errors():
                self._connection.detach()  # closed, not kept for others: it never keeps the lock
                for what, value in _KEPT_ALIVE.items():
                    self._connection.execute(text(f"SET tcp_keepalives_{what} = {value}"))
                take = text(f"SELECT pg_try_advisory_lock({key})")
                if not self._connection.execute(take).scalar():
                    raise MapLockedError(f"another worker has {name}; wait until it is done")
        except BaseException:
            self._connection.close()
            raise

    def release(self) -> None:
        """Lets others take it.

        Raises:
            StoreError: the database is away; the lock goes with the connection.
        """
        try:
            with _errors():  # at once: the server notices a closed connection a little later
                self._connection.execute(text("SELECT pg_advisory_unlock_all()"))
        finally:
            self._connection.close()


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
        with extra("server", "a centre on PostgreSQL needs its driver"):
            engine = create_engine(url, pool_size=8, max_overflow=-1)
    except ArgumentError as error:
        raise InputError(f"not a valid database address: {error}") from error
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


_CHANNEL = "engram_work"


def notify(connection: Connection) -> None:
    """Announces work, once the transaction that is open commits."""
    if connection.dialect.name == "postgresql":
        connection.execute(text(f"NOTIFY {_CHANNEL}"))


class WorkListener:
    """Waits for work. A context manager.

    Args:
        database: address of the service's database; None for SQLite.
        sleep: waits some seconds, or until the worker is stopped.
    """

    def __init__(self, database: str | None, sleep: Callable[[float], object]) -> None:
        url = None if database is None else make_url(database)
        self._url = url if url is not None and url.get_backend_name() == "postgresql" else None
        self._sleep = sleep
        self._connection: Any = None  # psycopg's connection

    def __enter__(self) -> WorkListener:
        return self

    def __exit__(self, *_: object) -> None:
        self._disconnect()

    def wait(self, seconds: float) -> None:
        """Returns after some seconds, or as soon as there is work; a broken line is a sleep."""
        if self._url is None:
            self._sleep(seconds)
            return
        import psycopg

        try:
            self._listen(seconds)
        except psycopg.Error:  # the database is away: the poll finds out, and tells
            self._disconnect()
            self._sleep(seconds)

    def _listen(self, seconds: float) -> None:
        import psycopg

        if self._connection is None:
            assert self._url is not None
            address = self._url.set(drivername="postgresql")
            self._connection = psycopg.connect(
                address.render_as_string(hide_password=False), autocommit=True
            )
            self._connection.execute(f"LISTEN {_CHANNEL}")
            return  # what was announced before is found by looking
        for _ in self._connection.notifies(timeout=seconds, stop_after=1):
            pass

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


_log = logging.getLogger(__name__)
# All rows of the audit log are read again so often.
_WHOLE_EVERY_NS = 3_600_000_000_000


def note(
    connection: Connection, at_ns: int, subject: str, action: str, name: str, /, **detail: Any
) -> None:
    """Adds a row; call it in the transaction that changes the state.

    Args:
        connection: in a writing transaction.
        at_ns: the time.
        subject: who did it.
        action: what.
        name: of the map; "" for none.
        **detail: plain data.
    """
    last = next(iter(rows_of(connection, Event, order=audit.c.number.desc(), limit=1)), None)
    number, before = (0, "") if last is None else (last.number, last.hash)
    text_of = json.dumps(detail, sort_keys=True)
    row = Event(number + 1, at_ns, subject, action, name, text_of, "")
    row = replace(row, hash=_hash(before, row))
    connection.execute(insert(audit).values(**values_of(row)))
    if _log.isEnabledFor(logging.INFO):
        known = connection.execute(select(subjects.c.name).where(subjects.c.id == subject)).scalar()
        more = "".join(f" {key}={value}" for key, value in detail.items())
        _log.info("%s: %s by %s%s", name or "centre", action, known or subject, more)


def events_after(
    connection: Connection, number: int, name: str, limit: int
) -> list[dict[str, Any]]:
    """The next events of a map after a number, as the API shows them."""
    later = (audit.c.number > number, audit.c.map == name)
    rows = rows_of(connection, Event, *later, order=audit.c.number, limit=limit)
    return list(map(_shown, rows))


def newest_events(connection: Connection, name: str, limit: int) -> list[dict[str, Any]]:
    """The last events of a map, newest first."""
    newest = audit.c.number.desc()
    rows = rows_of(connection, Event, audit.c.map == name, order=newest, limit=limit)
    return list(map(_shown, rows))


def _shown(row: Event) -> dict[str, Any]:
    return {**values_of(row), "detail": json.loads(row.detail)}


class AuditCheck:
    """Checks the audit log for a service: all rows once an hour, in between those that came since.

    A row that was changed with all that follow is found at once, by the last one that was
    checked; a row that was changed alone within the hour.

    Attributes:
        whole_ns: when all rows were read last.
    """

    def __init__(self) -> None:
        self.whole_ns = 0
        self._lock = threading.Lock()
        self._last = (0, "")

    def first_broken(self, connection: Connection, now_ns: int) -> int | None:
        """Number of the first row that was changed, removed or slipped in; None for a whole log."""
        with self._lock:
            if now_ns - self.whole_ns > _WHOLE_EVERY_NS or not self._last_holds(connection):
                self._last, self.whole_ns = (0, ""), now_ns
            broken = self._read_on(connection)
            if broken is not None:
                self._last, self.whole_ns = (0, ""), 0
            return broken

    def _last_holds(self, connection: Connection) -> bool:
        number, checked = self._last
        query = select(audit.c.hash).where(audit.c.number == number)
        return number == 0 or connection.execute(query).scalar() == checked

    def _read_on(self, connection: Connection) -> int | None:
        """Checks the rows after the last one; None if they follow."""
        number, before = self._last
        query = select(audit).where(audit.c.number > number).order_by(audit.c.number)
        for values in connection.execute(query.execution_options(yield_per=1000)):
            row, number = Event(*values), number + 1
            if row.number != number or row.hash != _hash(before, row):
                return number
            before = row.hash
        self._last = number, before
        return None


def _hash(before: str, row: Event) -> str:
    """Hash of a row, bound to the one before; without its own."""
    values = values_of(row)
    del values["hash"]
    return hashlib.sha256((before + json.dumps(values, sort_keys=True)).encode()).hexdigest()
