"""A map as one schema of a PostgreSQL database, with the same tables and an advisory lock.

The address is an SQLAlchemy URL with the map's name in its query, for example
``postgresql+psycopg://engram@centre/fleet?map=town``.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
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
    inspect,
    make_url,
    text,
)
from sqlalchemy.dialects.postgresql import Insert
from sqlalchemy.exc import ArgumentError, DBAPIError
from sqlalchemy.schema import CreateTable

from engram import __version__
from engram.errors import (
    FormatVersionError,
    InputError,
    MapCorruptError,
    MapError,
    MapLockedError,
    MissingExtraError,
    NotAMapError,
    StorageFullError,
)
from engram.files import Holder
from engram.maps.database import (
    damage_named,
    raise_tables,
    reading_rows,
    replaced,
    write_format,
)
from engram.maps.schema import (
    FORMAT_VERSION,
    map_format,
    metadata,
    missing_in,
)

# The first half of the advisory lock's key identifies Engram, the second the map.
_LOCK_CLASS = 0x4547524D
# PostgreSQL cuts application names there.
_NAME_BYTES = 63


class PostgresMap:
    """The `Place` of a map, existing or new.

    Args:
        address: URL with ``map=NAME`` in its query.

    Raises:
        InputError: the address is not valid.
    """

    def __init__(self, address: str) -> None:
        self._url, self._schema = _parse(address)

    def create(self) -> None:
        """Creates an empty map atomically.

        Raises:
            InputError: the map exists.
            MapError: the server cannot be reached.
        """
        schema = self._schema
        engine = _engine(self._url, schema)
        try:
            with _translated(schema), engine.begin() as connection:
                if inspect(connection).has_schema(schema):
                    raise InputError(
                        f"map {schema} exists already; open it, or choose another name"
                    )
                connection.execute(text(f'CREATE SCHEMA "{schema}"'))
                metadata.create_all(connection, checkfirst=False)
                write_format(connection)
        finally:
            engine.dispose()

    def open(self) -> PostgresDatabase:
        """The map's database.

        Raises:
            NotAMapError: the database has no such map.
            FormatVersionError: written by a newer Engram.
            MapError: the server cannot be reached.
        """
        return PostgresDatabase(self._url, self._schema)


class PostgresDatabase:
    """One map in a PostgreSQL database; made by `PostgresMap.open`."""

    def __init__(self, url: URL, schema: str) -> None:
        self.name = f"{url.render_as_string(hide_password=True)} map {schema}"
        self._url, self._schema = url, schema
        self._engine = _engine(url, schema)
        self.format_version = self._read_version()
        if self.format_version < FORMAT_VERSION:
            _show_missing_tables(self._engine, self.format_version)
            self._engine.dispose()

    def _read_version(self) -> int:
        with self.reading() as connection:
            if not inspect(connection).has_table(map_format.name, schema=self._schema):
                raise NotAMapError(f"{self.name}: there is no such map")
            found = connection.execute(text("SELECT version FROM map_format ORDER BY key"))
            version = int(found.scalar() or 0)
        if version > FORMAT_VERSION:
            raise FormatVersionError(
                f"{self.name} is of format {version}, this Engram ({__version__}) reads up to "
                f"{FORMAT_VERSION}; install a newer one"
            )
        return version

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection for selects."""
        with reading_rows(self.name), _translated(self.name), self._engine.connect() as connection:
            yield connection

    def first(self, query: Select[Any], parameters: dict[str, Any]) -> Sequence[Any] | None:
        """The first row of a select."""
        with self.reading() as connection:
            return connection.execute(query, parameters).first()

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """One durable transaction."""
        with damage_named(self.name), _translated(self.name), self._engine.begin() as connection:
            yield connection

    def lock_for_writing(self) -> AdvisoryLock:
        """Locks the map for writing."""
        lock = AdvisoryLock(self._url, self._schema, self)
        try:
            self._raise_format()
        except BaseException:
            lock.release()
            raise
        return lock

    def _raise_format(self) -> None:
        """Upgrades an older map to the newest format in one transaction."""
        if self._read_version() < FORMAT_VERSION:
            self._engine.dispose()
            self._engine = _engine(self._url, self._schema)
            with self.writing() as connection:
                raise_tables(connection, self.format_version, _free_names)
        if self.format_version < FORMAT_VERSION:
            self._engine.dispose()
            self._engine = _engine(self._url, self._schema)
            self.format_version = FORMAT_VERSION

    def writer(self) -> Holder | None:
        """The current writer; None without one."""
        query = text(
            "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a ON a.pid = l.pid "
            "WHERE l.locktype = 'advisory' AND l.granted AND l.classid = :class "
            "AND l.objid = :map AND l.database = (SELECT oid FROM pg_database "
            "WHERE datname = current_database()) ORDER BY a.pid"
        )
        with self.reading() as connection:
            name = connection.execute(
                query, {"class": _LOCK_CLASS, "map": _map_number(self._schema)}
            ).scalar()
        if name is None:
            return None
        match name.split(" ", 3):
            case ["engram", pid, token, host] if pid.isdigit():
                return Holder(int(pid), host, token)
            case _:
                return Holder(0, name, "")

    def replace(self, table: Table, key: tuple[str, ...]) -> Insert:
        """An upsert."""
        statement = Insert(table)
        return statement.on_conflict_do_update(
            index_elements=list(key), set_=replaced(statement.excluded, key)
        )

    def integrity_problems(self) -> list[str]:
        """No faults: PostgreSQL checks its own pages if data checksums are enabled."""
        return []

    def size_bytes(self) -> int:
        """Size of all tables with their indices, bytes."""
        query = text(
            "SELECT coalesce(sum(pg_total_relation_size(c.oid)), 0) FROM pg_class c "
            "JOIN pg_namespace n ON n.oid = c.relnamespace "
            "WHERE n.nspname = :schema AND c.relkind = 'r'"
        )
        with self.reading() as connection:
            return int(connection.execute(query, {"schema": self._schema}).scalar_one())

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()


class AdvisoryLock:
    """The lock of a map's only writer; the server releases it with the connection.

    Attributes:
        holder: this process.

    Raises:
        MapLockedError: another process holds it.
    """

    def __init__(self, url: URL, schema: str, database: PostgresDatabase) -> None:
        self.holder = Holder.this_process()
        name = f"engram {self.holder.pid} {self.holder.token} {self.holder.host}"
        self._engine = _engine(url, schema, application_name=name[:_NAME_BYTES])
        with _translated(database.name):
            self._connection = self._engine.connect().execution_options(
                isolation_level="AUTOCOMMIT"
            )
            taken = self._connection.execute(
                text("SELECT pg_try_advisory_lock(:class, :map)"),
                {"class": _LOCK_CLASS, "map": _signed(_map_number(schema))},
            ).scalar_one()
        if not taken:
            self.release()
            raise MapLockedError(
                f"{database.name} is being written by {database.writer() or 'another process'}; "
                "wait until it is done, or read the map meanwhile"
            )

    def release(self) -> None:
        """Releases the lock."""
        self._connection.close()
        self._engine.dispose()


def _parse(address: str) -> tuple[URL, str]:
    try:
        url = make_url(address)
    except ArgumentError as error:
        raise InputError(f"{address!r} is not a database address: {error}") from error
    schema = url.query.get("map")
    if not isinstance(schema, str) or not schema.isidentifier():
        raise InputError(
            f"{url.render_as_string(hide_password=True)} must name the map in its query, for "
            "example ?map=town (letters, digits, underscores)"
        )
    return url.difference_update_query(["map"]), schema


def _engine(url: URL, schema: str, **options: str) -> Engine:
    try:
        return create_engine(
            url,
            connect_args={"options": f"-csearch_path={schema}", **options},
            pool_size=5,
            max_overflow=-1,
        )
    except ImportError as error:
        raise MissingExtraError(
            "maps in PostgreSQL need its driver: pip install 'engram-localisation[server]'"
        ) from error


def _show_missing_tables(engine: Engine, version: int) -> None:
    """Adds tables that an older format lacks as empty temporary tables of each connection."""
    definitions = [
        str(CreateTable(table).compile(dialect=engine.dialect)).replace(
            "CREATE TABLE", "CREATE TEMP TABLE", 1
        )
        for table in missing_in(version)
    ]

    @event.listens_for(engine, "connect")
    def connect(connection: Any, _: object) -> None:
        for definition in definitions:
            connection.execute(definition)
        connection.commit()


def _free_names(connection: Connection, renamed: str) -> None:
    """Renames the constraints of a renamed table, since the new table needs their names."""
    names = connection.execute(
        text("SELECT conname FROM pg_constraint WHERE conrelid = CAST(:table AS regclass)"),
        {"table": renamed},
    )
    for name in names.scalars().all():
        connection.execute(text(f'ALTER TABLE {renamed} RENAME CONSTRAINT "{name}" TO "o_{name}"'))


def _map_number(schema: str) -> int:
    return zlib.crc32(schema.encode())


def _signed(number: int) -> int:
    return number - 2**32 if number >= 2**31 else number


@contextmanager
def _translated(name: str) -> Iterator[None]:
    """Converts PostgreSQL's errors into Engram's, by SQLSTATE."""
    try:
        yield
    except DBAPIError as error:
        state = getattr(error.orig, "sqlstate", None) or ""
        if state.startswith("53"):
            raise StorageFullError(
                f"{name} has no room left ({error.orig}); everything up to the last checkpoint is "
                "safe"
            ) from error
        if state in {"XX001", "XX002"}:
            raise MapCorruptError(f"{name} is damaged: {error.orig}") from error
        raise MapError(f"{name}: {error.orig}") from error
