"""The service's database: its tables, SQLite or PostgreSQL, wake-ups, and the audit log.

The audit log: every change of state, each row bound to the one before by a hash. It is the stream
of events as well.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from sqlalchemy import (
    URL,
    BigInteger,
    Column,
    Connection,
    Engine,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Select,
    Table,
    Text,
    create_engine,
    event,
    insert,
    inspect,
    make_url,
    select,
    text,
)
from sqlalchemy.dialects.postgresql import insert as insert_postgresql
from sqlalchemy.dialects.sqlite import insert as insert_sqlite
from sqlalchemy.exc import ArgumentError, DataError, DBAPIError

from engram import PRE_RELEASE, __version__
from engram.errors import FormatVersionError, InputError, MissingExtraError, StorageFullError
from engram.fleet.centre.errors import StoreError
from engram.sqlite import is_full

VERSION = 3

metadata = MetaData()
_INT = BigInteger().with_variant(Integer(), "sqlite")


def _int(name: str, **given: Any) -> Column[int]:
    return Column(name, _INT, nullable=given.pop("nullable", False), **given)


def _text(name: str, **given: Any) -> Column[str]:
    return Column(name, Text(), nullable=given.pop("nullable", False), **given)


def _bytes(name: str, **given: Any) -> Column[bytes]:
    return Column(name, LargeBinary(), nullable=given.pop("nullable", False), **given)


centre = Table("centre", metadata, _int("key", primary_key=True), _int("version"))

maps = Table(
    "maps",
    metadata,
    _text("name", primary_key=True),
    _int("created_ns"),
    _int("durable_revision"),  # the newest that a backup holds
    _text("options"),  # MapPolicy as JSON
)

refs = Table(
    "refs",
    metadata,
    _text("map", primary_key=True),
    _text("name", primary_key=True),
    _int("revision"),
    _int("version"),  # counts its moves: the ETag
    _int("moved_ns"),
    _text("moved_by"),
)

subjects = Table(
    "subjects",
    metadata,
    _text("id", primary_key=True),
    _text("kind"),  # robot or person
    _text("name"),
    _bytes("public_key", nullable=True),
    _int("created_ns"),
    _int("disabled"),
)

grants = Table(
    "grants",
    metadata,
    _text("subject", primary_key=True),
    _text("map", primary_key=True),  # "*" for all
    _text("role"),
)

codes = Table(
    "codes",
    metadata,
    _bytes("hash", primary_key=True),
    _text("map"),
    _text("follows"),
    _int("expires_ns"),
    _text("used_by", nullable=True),
)

nonces = Table(
    "nonces",
    metadata,
    _text("nonce", primary_key=True),
    _text("subject"),
    _int("expires_ns"),
)

tokens = Table(
    "tokens",
    metadata,
    _bytes("hash", primary_key=True),
    _text("subject"),
    _int("expires_ns", nullable=True),
)

robots = Table(  # a robot on a map
    "robots",
    metadata,
    _text("robot", primary_key=True),
    _text("map", primary_key=True),
    _text("follows"),  # a ref, or the number of a revision
    _text("report"),  # the last one, as JSON
    _int("reported_ns", nullable=True),
)

packs = Table(
    "packs",
    metadata,
    _text("id", primary_key=True),
    _text("map"),
    _int("size"),
    _int("written_ns"),
)

parts = Table(
    "parts",
    metadata,
    _text("map", primary_key=True),
    _bytes("hash", primary_key=True),
    _text("pack"),
    _int("start"),
    _int("size"),
)

given = Table(  # by whom a part was handed in: nothing is taken by its hash alone
    "given",
    metadata,
    _text("map", primary_key=True),
    _text("robot", primary_key=True),
    _bytes("hash", primary_key=True),
)

handins = Table(
    "handins",
    metadata,
    _text("id", primary_key=True),
    _text("map"),
    _text("robot"),
    _text("manifest"),
    _text("base", nullable=True),  # the manifest that it continues
    _text("content_hash"),
    _text("state"),
    _int("bytes"),
    _int("begun_ns"),
    _int("place", nullable=True),  # in the order of completion
    _int("ended_ns", nullable=True),
    _int("revision", nullable=True),
    _int("tries"),
    _int("cancelled"),
    _int("ungated"),  # a person merges it whatever the gate says
    _text("progress"),
    _text("report", nullable=True),
    _text("error", nullable=True),
    Index("handins_by_state", "map", "state"),
)

artifacts = Table(
    "artifacts",
    metadata,
    _text("id", primary_key=True),
    _text("map"),
    _int("revision"),
    _text("options"),
    _text("state"),
    _text("manifest", nullable=True),
    _text("report", nullable=True),
    _text("error", nullable=True),
    _int("asked_ns"),
    _int("used_ns"),
    Index("artifacts_by_state", "state"),
)

artifact_grants = Table(
    "artifact_grants",
    metadata,
    _text("artifact", primary_key=True),
    _text("subject", primary_key=True),
)

dreams = Table(  # looks for a better map in what was handed in
    "dreams",
    metadata,
    _text("id", primary_key=True),
    _text("map"),
    _text("state"),
    _text("asked_by"),
    _int("asked_ns"),
    _int("ended_ns", nullable=True),
    _int("since"),  # revision of the fleet map when it was asked for
    _int("revision", nullable=True),  # that it made
    _text("progress"),
    _text("report", nullable=True),
    _text("error", nullable=True),
)

usage = Table(
    "usage",
    metadata,
    _text("subject", primary_key=True),
    _int("day", primary_key=True),
    _int("bytes"),
)

audit = Table(
    "audit",
    metadata,
    Column("number", _INT, primary_key=True, autoincrement=False),
    _int("at_ns"),
    _text("subject"),
    _text("action"),
    _text("map"),
    _text("detail"),
    _text("hash"),  # over the row before and this one
)


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
    def _make_tables(connection: Connection) -> None:
        """Makes the tables in an empty database; refuses those of another version."""
        if not inspect(connection).has_table(centre.name):
            metadata.create_all(connection)
            connection.execute(insert(centre).values(key=1, version=VERSION))
            return
        version = connection.execute(select(centre.c.version)).scalar_one()
        if version != VERSION:
            raise FormatVersionError(
                f"the centre's tables are of version {version}, Engram {__version__} "
                f"({PRE_RELEASE}) uses {VERSION}: open it with the Engram that wrote it, or copy "
                "its maps/*.engram into a new centre, give each to engram centre map, and enrol "
                "the robots there"
            )


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


_CHANNEL = "engram_work"


def ring(connection: Connection) -> None:
    """Announces work, once the transaction that is open commits."""
    if connection.dialect.name == "postgresql":
        connection.execute(text(f"NOTIFY {_CHANNEL}"))


class Waker:
    """Waits for work. A context manager.

    Args:
        database: address of the service's database; None for SQLite.
        sleep: waits some seconds, or until the worker is stopped.
    """

    def __init__(self, database: str | None, sleep: Callable[[float], object]) -> None:
        url = None if database is None else make_url(database)
        self._url = url if url is not None and url.get_backend_name() == "postgresql" else None
        self._sleep = sleep
        self._line: Any = None  # psycopg's connection

    def __enter__(self) -> Waker:
        return self

    def __exit__(self, *_: object) -> None:
        self._hang_up()

    def wait(self, seconds: float) -> None:
        """Returns after some seconds, or as soon as there is work; a broken line is a sleep."""
        if self._url is None:
            self._sleep(seconds)
            return
        import psycopg

        try:
            self._listen(seconds)
        except psycopg.Error:  # the database is away: the poll finds out, and tells
            self._hang_up()
            self._sleep(seconds)

    def _listen(self, seconds: float) -> None:
        import psycopg

        if self._line is None:
            assert self._url is not None
            address = self._url.set(drivername="postgresql")
            self._line = psycopg.connect(
                address.render_as_string(hide_password=False), autocommit=True
            )
            self._line.execute(f"LISTEN {_CHANNEL}")
            return  # what was announced before is found by looking
        for _ in self._line.notifies(timeout=seconds, stop_after=1):
            pass

    def _hang_up(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()


_log = logging.getLogger(__name__)


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
    newest = select(audit.c.number, audit.c.hash).order_by(audit.c.number.desc()).limit(1)
    last, before = connection.execute(newest).first() or (0, "")
    row = {
        "number": last + 1,
        "at_ns": at_ns,
        "subject": subject,
        "action": action,
        "map": name,
        "detail": json.dumps(detail, sort_keys=True),
    }
    connection.execute(insert(audit).values(**row, hash=_hash(before, row)))
    if _log.isEnabledFor(logging.INFO):
        known = connection.execute(select(subjects.c.name).where(subjects.c.id == subject)).scalar()
        told = "".join(f" {key}={value}" for key, value in detail.items())
        _log.info("%s: %s by %s%s", name or "centre", action, known or subject, told)


def events_after(
    connection: Connection, number: int, name: str | None, limit: int
) -> list[dict[str, Any]]:
    """The next rows after a number, of one map or of all."""
    query = select(audit).where(audit.c.number > number).order_by(audit.c.number).limit(limit)
    if name is not None:
        query = query.where(audit.c.map == name)
    return _events(connection, query)


def newest_events(connection: Connection, name: str, limit: int) -> list[dict[str, Any]]:
    """The last rows of one map, newest first."""
    query = select(audit).where(audit.c.map == name).order_by(audit.c.number.desc()).limit(limit)
    return _events(connection, query)


def _events(connection: Connection, query: Select[Any]) -> list[dict[str, Any]]:
    rows = rows_of(connection, query)
    return [{**row, "detail": json.loads(row["detail"])} for row in rows]


def first_broken(connection: Connection) -> int | None:
    """Number of the first row that was changed, removed or added later; None for a whole log."""
    before = ""
    query = select(audit).order_by(audit.c.number).execution_options(yield_per=1000)
    for number, row in enumerate(map(dict, connection.execute(query).mappings()), 1):
        told = row.pop("hash")
        if row["number"] != number or told != _hash(before, row):
            return number
        before = told
    return None


def _hash(before: str, row: dict[str, Any]) -> str:
    return hashlib.sha256((before + json.dumps(row, sort_keys=True)).encode()).hexdigest()
