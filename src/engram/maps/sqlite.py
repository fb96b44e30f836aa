"""A map as one SQLite file.

Write-ahead log, so that readers and the writer never wait for each other. `synchronous=FULL`: a
checkpoint that has returned survives a power cut, not only a kill; that costs one fsync, on the
saving thread (20 nodes of 25 kB on ext4: 2.1 ms a checkpoint, 1.5 ms with NORMAL). No memory
mapping: a file that is cut while it is mapped would kill the process.
"""

from __future__ import annotations

import os
import sqlite3
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, Select, Table, event, insert
from sqlalchemy.dialects import sqlite as sqlite_dialect
from sqlalchemy.dialects.sqlite import Insert
from sqlalchemy.schema import CreateTable
from sqlalchemy.sql.compiler import SQLCompiler

from engram import __version__
from engram.errors import InputError, MapCorruptError, MapError, NotAMapError, StorageFullError
from engram.files import Holder, WriterLock, current_holder, naming, new_file, publish
from engram.maps.database import damage_named, raise_tables, replaced
from engram.maps.rows import sealed
from engram.maps.schema import FORMAT_VERSION, map_format, metadata, missing_in
from engram.sqlite import FileKind, SqliteFile

MAP_FILE = FileKind(
    noun="map",
    application_id=0x4547524D,  # "EGRM"
    format_version=FORMAT_VERSION,
    metadata=metadata,
    strange=NotAMapError,
    cure="run engram check, and restore a copy",
    busy_s=30.0,  # writers hold the file for a checkpoint only; longer, and somebody is stuck
)
# SQLite then takes no locks, and does not notice what others write.
_NOBODY_WRITES = "mode=ro&immutable=1"
_BESIDE = ("-wal", "-shm", "-journal")


class SqliteDatabase:
    """One map file. Checks on opening that it is a map of a format that this version reads.

    Args:
        path: the file.

    Raises:
        NotAMapError: nothing is there, or something else.
        FormatVersionError: written by a newer Engram.
        MapCorruptError: a map whose tables are not as they must be.
        MapError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()  # one lock per map, whatever links lead to it
        self._file = SqliteFile(self.path, MAP_FILE)
        self._file.check_regular()
        self._options, self.format_version = self._way_of_reading()
        nobody_writes = self._options == _NOBODY_WRITES
        self._as_opened = _state(self.path) if nobody_writes else None
        self._reader = self._file.engine(self._options, self._prepare_reader)
        self._writer: Engine | None = None
        self._compiled: dict[Select[Any], tuple[str, tuple[str, ...]]] = {}
        self._idle: deque[sqlite3.Connection] = deque()  # as many as there were threads at once
        missing = {table.name for table in missing_in(self.format_version)}
        with self.reading() as connection:
            self._file.check_tables(connection.exec_driver_sql, missing)

    @staticmethod
    def create(path: Path) -> None:
        """Make an empty map. It appears under its name whole or not at all.

        Raises:
            InputError: something is there already, or the folder is not.
            MapError: it cannot be written.
        """
        with _new_map(path) as draft:
            file = SqliteFile(draft, MAP_FILE)
            engine = _writing_engine(file, "mode=rwc")
            with SqliteFile(path, MAP_FILE).errors():
                with engine.begin() as connection:
                    metadata.create_all(connection)
                    row = {"key": 1, "version": FORMAT_VERSION, "tool_version": __version__}
                    connection.execute(insert(map_format), sealed(map_format, row))
                    file.mark(connection.exec_driver_sql)
                engine.dispose()
                _keep_log(file)

    @property
    def name(self) -> str:
        """The path."""
        return str(self.path)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection for selects."""
        with (
            self._unchanged(),
            damage_named(self.name),
            self._file.errors(),
            self._reader.connect() as connection,
        ):
            yield connection

    @contextmanager
    def _unchanged(self) -> Iterator[None]:
        """What is read is of the file as it was opened, or it is told that it was written since.

        Only where SQLite was told that nobody writes: then it mixes old pages and new ones, which
        looks like damage, or like nothing at all.
        """
        try:
            yield
        except MapError as error:
            self._check_unchanged(error)
            raise
        self._check_unchanged(None)

    def _check_unchanged(self, cause: MapError | None) -> None:
        if self._as_opened is not None and _state(self.path) != self._as_opened:
            raise MapError(
                f"{self.name} was written since it was opened, where this user may only read: "
                "open it again"
            ) from cause

    def first(self, query: Select[Any], parameters: dict[str, Any]) -> Sequence[Any] | None:
        """The first row of a select, without SQLAlchemy between: that takes 100 µs a time."""
        if query not in self._compiled:
            compiled = query.compile(dialect=self._reader.dialect)
            assert isinstance(compiled, SQLCompiler)
            self._compiled[query] = (str(compiled), tuple(compiled.positiontup or ()))
        statement, names = self._compiled[query]
        with self._unchanged(), self._file.errors():
            try:
                connection = self._idle.pop()
            except IndexError:
                connection = self._file.connect(self._options)
                self._prepare_reader(connection)
            try:
                row: tuple[Any, ...] | None = connection.execute(
                    statement, [parameters[name] for name in names]
                ).fetchone()
            finally:
                self._idle.append(connection)
        return row

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """One transaction, durable when the block is left."""
        if self._writer is None:
            self._writer = _writing_engine(self._file, "mode=rw")
        with damage_named(self.name), self._file.errors(), self._writer.begin() as connection:
            yield connection

    def lock_for_writing(self) -> WriterLock:
        """Become the only writer."""
        if not os.access(self.path, os.W_OK):
            raise MapError(f"{self.path} is read-only; copy it where it may be written")
        lock = WriterLock(self.path)
        try:
            self._raise_format()
        except BaseException:
            lock.release()
            raise
        return lock

    def writer(self) -> Holder | None:
        """Who writes now."""
        return current_holder(self.path)

    def replace(self, table: Table, key: tuple[str, ...]) -> Insert:
        """An upsert."""
        statement = Insert(table)
        return statement.on_conflict_do_update(
            index_elements=list(key), set_=replaced(statement.excluded, key)
        )

    def integrity_problems(self) -> list[str]:
        """What `PRAGMA integrity_check` says."""
        try:
            with self.reading() as connection:
                found = connection.exec_driver_sql("PRAGMA integrity_check(100)").scalars().all()
        except MapCorruptError as error:
            return [str(error)]
        return [str(fact) for fact in found if fact != "ok"]

    def copy_to(self, target: Path) -> None:
        """Copies the map as it is now, whoever writes to it meanwhile; whole or not at all.

        Raises:
            InputError: something is there already, or the folder is not.
            MapError: it cannot be written.
        """
        with self._written_anew(target) as (source, draft):
            with closing(draft.connect("mode=rwc")) as copy:
                source.backup(copy)
            _keep_log(draft)

    def compact_to(self, target: Path) -> None:
        """Writes the map anew, without what deleting and growing left; whole or not at all.

        Raises:
            InputError: something is there already, or the folder is not.
            MapError: it cannot be written.
        """
        with self._written_anew(target) as (source, draft):
            source.execute("VACUUM INTO ?", [str(draft.path)])
            _keep_log(draft)

    @contextmanager
    def _written_anew(self, target: Path) -> Iterator[tuple[sqlite3.Connection, SqliteFile]]:
        """A connection to this map, and the draft of another one."""
        with (
            _new_map(target) as draft,
            self._unchanged(),
            SqliteFile(target, MAP_FILE).errors(),
            closing(self._file.connect(self._options)) as source,
        ):
            yield source, SqliteFile(draft, MAP_FILE)

    @staticmethod
    def publish(draft: Path, path: Path) -> None:
        """Give a map file that nobody has open its name, in the same file system.

        Raises:
            InputError: something is there already, or the folder is not.
            MapError: the name cannot be given.
        """
        if _has_log(draft):
            raise MapError(f"{draft} is open still: {path} would lack what its log holds")
        with naming(path):
            _remove_orphans(path)
            publish(draft, path)

    def size_bytes(self) -> int:
        """The file and its write-ahead log."""
        files = (self.path, _log(self.path))
        return sum(file.stat().st_size for file in files if file.exists())

    def close(self) -> None:
        """Close all connections; the last one to close empties the write-ahead log."""
        self._end_readers()
        if self._writer is not None:
            with self._file.errors():
                self._writer.dispose()

    def _end_readers(self) -> None:
        self._reader.dispose()
        while self._idle:
            self._idle.pop().close()

    def _way_of_reading(self) -> tuple[str, int]:
        """How the file can be opened for reading, wherever it lies; and its format.

        A write-ahead log wants a second file beside it, which cannot be made on read-only media
        or on a full disk. Without a log and without a writer there is nothing to coordinate, and
        SQLite may be told so: history stays readable, and a map can be copied elsewhere.
        """
        if os.access(self.path, os.W_OK) and os.access(self.path.parent, os.W_OK):
            try:
                return "mode=rw", self._format_version("mode=rw")
            except StorageFullError:
                if _has_log(self.path) or current_holder(self.path) is not None:
                    raise
        options = "mode=ro" if _has_log(self.path) else _NOBODY_WRITES
        return options, self._format_version(options)

    def _format_version(self, options: str) -> int:
        with self._file.errors(), closing(self._file.connect(options)) as connection:
            return self._file.identify(connection.execute)

    def _prepare_reader(self, connection: sqlite3.Connection) -> None:
        """What a map of an older format lacks is seen as empty tables of this connection alone."""
        for table in missing_in(self.format_version):
            connection.execute(_definition(table).replace("CREATE TABLE", "CREATE TEMP TABLE", 1))
        connection.execute("PRAGMA query_only=ON")

    def _raise_format(self) -> None:
        """Bring an older map to the newest format: all of it, in one transaction."""
        if self._format_version("mode=rw") < FORMAT_VERSION:
            with self.writing() as connection:
                raise_tables(connection, self.format_version)
                self._file.mark(connection.exec_driver_sql)
        if self.format_version < FORMAT_VERSION:
            self.format_version = FORMAT_VERSION
            self._end_readers()
            self._reader = self._file.engine(self._options, self._prepare_reader)


def map_path(location: Path | str) -> Path:
    """The path of a map file.

    Raises:
        InputError: it is the address of a database. It may hold a password: it is not repeated.
    """
    if isinstance(location, str) and location.startswith("postgresql"):
        raise InputError(
            "this is the address of a map in PostgreSQL, not a map file; such maps are for "
            "engram centre, which comes with the centre"
        )
    return Path(location)


def _definition(table: Table) -> str:
    """The statement that makes a table."""
    return str(CreateTable(table).compile(dialect=sqlite_dialect.dialect())).strip()


def _log(path: Path) -> Path:
    return path.with_name(path.name + "-wal")


def _has_log(path: Path) -> bool:
    return _log(path).exists() and _log(path).stat().st_size > 0


def _state(path: Path) -> tuple[int, int, int] | None:
    """Which file stands under a name, and when it was last written; None where none does."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def _writing_engine(file: SqliteFile, options: str) -> Engine:
    engine = file.engine(options)
    # Take the write lock at once: a transaction that upgrades later can fail half way.
    event.listen(engine, "begin", lambda one: one.exec_driver_sql("BEGIN IMMEDIATE"))
    return engine


def _keep_log(file: SqliteFile) -> None:
    """A write-ahead log from now on: the file remembers it for ever."""
    with closing(file.connect("mode=rw")) as connection:
        connection.execute("PRAGMA journal_mode=WAL")


@contextmanager
def _new_map(path: Path) -> Iterator[Path]:
    """A draft to be filled, which then appears under its name whole or not at all."""
    with new_file(path) as draft:
        yield draft
        _remove_orphans(path)


def _remove_orphans(path: Path) -> None:
    """Logs of a map that was removed after its writer was killed.

    SQLite would take them for those of the map that comes to lie beside them. Whoever finds some
    holds the writer's lock, so that nobody makes that map, and a log of it, meanwhile.

    Raises:
        MapLockedError: somebody else does so now.
    """
    orphans = [path.with_name(path.name + suffix) for suffix in _BESIDE]
    if not any(one.exists() for one in orphans):
        return
    lock = WriterLock(path)
    try:
        if not path.exists():
            for one in orphans:
                one.unlink(missing_ok=True)
    finally:
        lock.release()
