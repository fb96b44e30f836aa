"""A map as one SQLite file.

A write-ahead log lets readers and the writer work without waiting for each other. With
`synchronous=FULL` a finished checkpoint survives a power cut; this costs one fsync on the saving
thread (0.6 ms for 20 nodes of 25 kB on ext4). No memory mapping, since truncating a mapped file
would kill the process.
"""

from __future__ import annotations

import os
import sqlite3
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, SelectBase, Table, delete, event, insert
from sqlalchemy.dialects.sqlite import Insert
from sqlalchemy.exc import NoResultFound, OperationalError
from sqlalchemy.sql.compiler import SQLCompiler

from engram import __version__
from engram.errors import (
    EngramError,
    MapCorruptError,
    MapError,
    MapLockedError,
    NotAMapError,
    StorageFullError,
)
from engram.files import Holder, WriterLock, current_holder, naming, new_file, publish
from engram.maps.rows import count_tags, sealed
from engram.maps.schema import FORMAT_VERSION, map_format, metadata
from engram.sqlite import FileKind, SqliteFile, is_full

_STUMBLES = (TypeError, ValueError, LookupError, ArithmeticError, NoResultFound)


@contextmanager
def damage_named(name: str) -> Iterator[None]:
    """Adds the map's name to errors about damaged rows.

    Args:
        name: path of the map.

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
        name: path of the map.

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


def upsert(table: Table, key: tuple[str, ...]) -> Insert:
    """An insert that replaces a row with the same values in the columns `key`.

    The row takes all other values, including its primary key.
    """
    statement = Insert(table)
    rest = {one.name: one for one in statement.excluded if one.name not in key}
    return statement.on_conflict_do_update(index_elements=list(key), set_=rest)


def write_format(connection: Connection) -> None:
    """Writes the rows that every map has: its format, and the tally of its tags."""
    connection.execute(delete(map_format))
    row = {"key": 1, "version": FORMAT_VERSION, "tool_version": __version__}
    connection.execute(insert(map_format), sealed(map_format, row))
    count_tags(connection)


MAP_FILE = FileKind(
    noun="map",
    application_id=0x4547524D,  # "EGRM"
    format_version=FORMAT_VERSION,
    metadata=metadata,
    strange=NotAMapError,
    cure="run engram check, and restore a copy",
    older="engram upgrade converts maps of format 6; map the drives of older ones again",
    newest=(
        frozenset({"forgotten", "receipts"}),
        "drafts of the format are not read any more; map the drives again",
    ),
    busy_s=30.0,  # seconds; writers lock the file only for a checkpoint
)
# SQLite then takes no locks, and does not notice writes of other processes.
_NOBODY_WRITES = "mode=ro&immutable=1"
_BESIDE = ("-wal", "-shm", "-journal")


class SqliteDatabase:
    """One map file. Opening it checks that it is a map of the current format.

    Args:
        path: the file.

    Raises:
        NotAMapError: the file does not exist or is not a map.
        FormatVersionError: written by an Engram that is newer, or much older.
        MapCorruptError: its tables are not those of its format.
        MapError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()  # one lock per map, even through links
        self._file = SqliteFile(self.path, MAP_FILE)
        self._file.check_regular()
        self._options = self._way_of_reading()
        nobody_writes = self._options == _NOBODY_WRITES
        self._as_opened = _state(self.path) if nobody_writes else None
        self._reader = self._file.engine(self._options, _prepare_reader)
        self._writer: Engine | None = None
        self._closed = False
        self._compiled: dict[SelectBase, tuple[str, tuple[str, ...]]] = {}
        self._idle: deque[sqlite3.Connection] = deque()  # one for each concurrent thread
        with self.reading() as connection:
            self._file.check_tables(connection.exec_driver_sql)

    @staticmethod
    def create(path: Path) -> None:
        """Creates an empty map atomically.

        Raises:
            InputError: the file exists already, or its folder does not.
            MapError: it cannot be written.
        """
        with _new_map(path) as draft:
            file = SqliteFile(draft, MAP_FILE)
            engine = _writing_engine(file, "mode=rwc")
            with SqliteFile(path, MAP_FILE).errors():
                with engine.begin() as connection:
                    metadata.create_all(connection)
                    write_format(connection)
                    file.mark(connection.exec_driver_sql)
                engine.dispose()
                keep_log(file)

    @property
    def name(self) -> str:
        """The path."""
        return str(self.path)

    def check_open(self) -> None:
        """Refuses whatever needs the file once it is closed.

        Raises:
            MapError: it is closed.
        """
        if self._closed:
            raise MapError(f"{self.name} is closed: open the map again")

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection for selects."""
        with (
            self._unchanged(),
            reading_rows(self.name),
            self._file.errors(),
            self._reader.connect() as connection,
        ):
            yield connection

    @contextmanager
    def _unchanged(self) -> Iterator[None]:
        """Raises an error if the file was written since it was opened without locks.

        SQLite would then mix old and new pages, which looks like damage or goes unnoticed.
        """
        self.check_open()
        try:
            yield
        except MapError as error:
            self._check_unchanged(error)
            raise
        self._check_unchanged(None)

    def _check_unchanged(self, cause: MapError | None) -> None:
        if self._as_opened is not None and _state(self.path) != self._as_opened:
            raise MapError(
                f"{self.name} was written since it was opened read-only: open it again"
            ) from cause

    def first(self, query: SelectBase, parameters: dict[str, Any]) -> Sequence[Any] | None:
        """The first row of a select; see `rows`."""
        return next(iter(self.rows(query, parameters)), None)

    def rows(self, query: SelectBase, parameters: dict[str, Any]) -> list[tuple[Any, ...]]:
        """The rows of a select, without SQLAlchemy, which takes 100 µs per call."""
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
                _prepare_reader(connection)
            try:
                found = connection.execute(statement, [parameters[name] for name in names])
                return found.fetchall()
            finally:
                self._idle.append(connection)

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """One transaction, durable at the end of the block."""
        self.check_open()
        if self._writer is None:
            self._writer = _writing_engine(self._file, "mode=rw")
        with damage_named(self.name), self._file.errors(), self._writer.begin() as connection:
            yield connection

    def lock_for_writing(self) -> WriterLock:
        """Locks the map for writing."""
        self.check_open()
        if not os.access(self.path, os.W_OK):
            raise MapError(f"{self.path} is read-only; copy it to a writable folder")
        return WriterLock(self.path)

    def writer(self) -> Holder | None:
        """The current writer; None without one."""
        return current_holder(self.path)

    def integrity_problems(self) -> list[str]:
        """Faults that `PRAGMA integrity_check` reports."""
        try:
            with self.reading() as connection:
                found = connection.exec_driver_sql("PRAGMA integrity_check(100)").scalars().all()
        except MapCorruptError as error:
            return [str(error)]
        return [str(fact) for fact in found if fact != "ok"]

    def copy_to(self, target: Path) -> None:
        """Copies the current state of the map atomically, even while another process writes.

        Raises:
            InputError: the file exists already, or its folder does not.
            MapError: it cannot be written.
        """
        with self._written_anew(target) as (source, draft):
            with closing(draft.connect("mode=rwc")) as copy:
                source.backup(copy)
            keep_log(draft)

    def compact_to(self, target: Path) -> None:
        """Rewrites the map atomically, without free pages.

        Raises:
            InputError: the file exists already, or its folder does not.
            MapError: it cannot be written.
        """
        with self._written_anew(target) as (source, draft):
            source.execute("VACUUM INTO ?", [str(draft.path)])
            keep_log(draft)

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
        """Renames a map file that no process has open, within one file system.

        Raises:
            InputError: the file exists already, or its folder does not.
            MapError: the file cannot be renamed.
        """
        if _has_log(draft):
            raise MapError(f"{draft} is still open: {path} would miss the content of its log")
        with naming(path):
            _remove_orphans(path)
            publish(draft, path)

    def size_bytes(self) -> int:
        """The file and its write-ahead log."""
        files = (self.path, _log(self.path))
        return sum(file.stat().st_size for file in files if file.exists())

    def close(self) -> None:
        """Closes all connections; the last one to close empties the write-ahead log."""
        self._closed = True
        self._end_readers()
        if self._writer is not None:
            with self._file.errors():
                self._writer.dispose()

    def _end_readers(self) -> None:
        self._reader.dispose()
        while self._idle:
            self._idle.pop().close()

    def _way_of_reading(self) -> str:
        """How to open the file for reading.

        A write-ahead log needs a second file, which cannot be created on read-only media or a full
        disk. Without a log and a writer, SQLite can open the file as immutable instead.
        """
        if os.access(self.path, os.W_OK) and os.access(self.path.parent, os.W_OK):
            try:
                self._identify("mode=rw")
                return "mode=rw"
            except StorageFullError:
                if _has_log(self.path) or current_holder(self.path) is not None:
                    raise
        options = "mode=ro" if _has_log(self.path) else _NOBODY_WRITES
        self._identify(options)
        return options

    def _identify(self, options: str) -> None:
        with self._file.errors(), closing(self._file.connect(options)) as connection:
            self._file.identify(connection.execute)


def _prepare_reader(connection: sqlite3.Connection) -> None:
    connection.execute("PRAGMA query_only=ON")


def _log(path: Path) -> Path:
    return path.with_name(path.name + "-wal")


def _has_log(path: Path) -> bool:
    """Whether a log lies next to a file, or what undoes an interrupted transaction."""
    logs = _log(path), path.with_name(f"{path.name}-journal")
    return any(log.exists() and log.stat().st_size > 0 for log in logs)


def _state(path: Path) -> tuple[int, int, int] | None:
    """Identity and time of the last write of a file; None if it does not exist."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def _writing_engine(
    file: SqliteFile,
    options: str,
    prepare: Callable[[sqlite3.Connection], object] | None = None,
) -> Engine:
    engine = file.engine(options, prepare)
    # Takes the write lock at once: a transaction that asks for it later can fail half way.
    event.listen(engine, "begin", lambda one: one.exec_driver_sql("BEGIN IMMEDIATE"))
    return engine


# How long to wait for a process that is just closing the map.
_PATIENCE_MS = 1000


@contextmanager
def alone(path: Path) -> Iterator[Engine]:
    """The only connection to a map: no process has it open, or can open it meanwhile.

    What is deleted is overwritten with zeros.

    Raises:
        MapLockedError: another process has it open, or this one.
    """
    file = SqliteFile(path, MAP_FILE)
    engine = _writing_engine(file, "mode=rw", _prepare_alone)
    with damage_named(str(path)), file.errors():
        try:
            with engine.connect():
                pass
        except (OperationalError, sqlite3.OperationalError) as error:
            if is_full(getattr(error, "orig", error)):
                raise
            raise MapLockedError(f"{path} is open elsewhere; close it there first") from error
        try:
            yield engine
        finally:
            engine.dispose()


def _prepare_alone(connection: sqlite3.Connection) -> None:
    connection.execute(f"PRAGMA busy_timeout={_PATIENCE_MS}")
    connection.execute("PRAGMA locking_mode=EXCLUSIVE")
    connection.execute("PRAGMA secure_delete=ON")
    connection.execute("BEGIN EXCLUSIVE")  # takes the lock, which the next line keeps
    connection.execute("COMMIT")


def compact(engine: Engine) -> None:
    """Rewrites a map that is `alone`, without free pages, and empties its log."""
    with closing(engine.raw_connection()) as connection:
        connection.execute("VACUUM")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def keep_log(file: SqliteFile) -> None:
    """Switches the file to a write-ahead log permanently."""
    with closing(file.connect("mode=rw")) as connection:
        connection.execute("PRAGMA journal_mode=WAL")


@contextmanager
def _new_map(path: Path) -> Iterator[Path]:
    """A draft file that is renamed to its final name when complete."""
    with new_file(path) as draft:
        yield draft
        _remove_orphans(path)


def _remove_orphans(path: Path) -> None:
    """Removes logs of a map that was deleted after its writer was killed.

    SQLite would apply them to a new map of that name. The writer's lock is held meanwhile, so that
    no other process creates that map.

    Raises:
        MapLockedError: another process does so now.
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
