"""A map as one SQLite file: all that is said to SQLite and to no other database stands here.

Write-ahead log, so that readers and the writer never wait for each other. `synchronous=FULL`: a
checkpoint that has returned survives a power cut, not only a kill; that costs one fsync, on the
saving thread (20 nodes of 25 kB on ext4: 2.1 ms a checkpoint, 1.5 ms with NORMAL). No memory
mapping: a file that is cut while it is mapped would kill the process.
"""

from __future__ import annotations

import errno
import os
import sqlite3
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import (
    Connection,
    Engine,
    Select,
    Table,
    create_engine,
    event,
    insert,
    text,
)
from sqlalchemy.dialects import registry
from sqlalchemy.dialects import sqlite as sqlite_dialect
from sqlalchemy.dialects.sqlite import Insert
from sqlalchemy.dialects.sqlite.pysqlite import SQLiteDialect_pysqlite
from sqlalchemy.exc import DBAPIError
from sqlalchemy.pool import QueuePool
from sqlalchemy.schema import CreateTable
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.util import LRUCache

from engram import __version__
from engram.errors import (
    FormatVersionError,
    InputError,
    MapCorruptError,
    MapError,
    MapLockedError,
    NotAMapError,
    StorageFullError,
)
from engram.maps.database import damage_named
from engram.maps.drafts import draft_folder
from engram.maps.lock import Holder, WriterLock, current_holder
from engram.maps.raising import raise_tables
from engram.maps.rows import sealed
from engram.maps.schema import (
    FORMAT_VERSION,
    map_format,
    metadata,
    missing_in,
)

# "EGRM": tells `file` and other programs that this SQLite file is a map.
APPLICATION_ID = 0x4547524D
_HEADER_BYTES = 100
_MAGIC = b"SQLite format 3\x00"
# Writers hold the file only for a checkpoint; somebody who waits longer than this is stuck.
_BUSY_TIMEOUT_S = 30.0
_CACHE_KIB = 8192
# SQLite then takes no locks, and does not notice what others write.
_NOBODY_WRITES = "mode=ro&immutable=1"
_OLDEST_SQLITE = (3, 37, 0)  # knows STRICT tables


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
        path = path.resolve()  # one lock per map, whatever links lead to it
        self.path = path
        _check_header(path)
        self._uri = _way_of_reading(path)
        self._as_opened = _state(path) if _is_immutable(self._uri) else None
        self.format_version = _format_version(path, self._uri)
        self._reader = self._reading_engine()
        self._writer: Engine | None = None
        self._compiled: dict[Select[Any], tuple[str, tuple[str, ...]]] = {}
        self._idle: deque[sqlite3.Connection] = deque()  # as many as there were threads at once
        with self.reading() as connection:
            _check_tables(connection, path, self.format_version)

    @staticmethod
    def create(path: Path) -> None:
        """Make an empty map. It appears under its name whole or not at all.

        Raises:
            InputError: something is there already, or the folder is not.
            MapError: it cannot be written.
        """
        _check_version()
        with _new_file(path) as draft:
            _write_empty(draft)

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
            _translated(self.name),
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
        with self._unchanged(), _translated(self.name):
            try:
                connection = self._idle.pop()
            except IndexError:
                connection = _connect(self._uri, self._prepare_reader)
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
            self._writer = _engine(_uri(self.path, "mode=rw"), _prepare_writer)
        with damage_named(self.name), _translated(self.name), self._writer.begin() as connection:
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
            index_elements=list(key),
            set_={
                column.name: statement.excluded[column.name]
                for column in table.columns
                if column.name not in key
            },
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
        with _new_file(target) as draft, self._unchanged(), _translated(str(target)):
            source = _connect(self._uri, _prepare)
            copy = _connect(_uri(draft, "mode=rwc"), _prepare_writer)
            try:
                source.backup(copy)
                copy.execute("PRAGMA journal_mode=WAL")
            finally:
                copy.close()
                source.close()

    def compact_to(self, target: Path) -> None:
        """Writes the map anew, without what deleting and growing left; whole or not at all.

        Raises:
            InputError: something is there already, or the folder is not.
            MapError: it cannot be written.
        """
        with _new_file(target) as draft, self._unchanged(), _translated(str(target)):
            source = _connect(self._uri, _prepare)
            try:
                source.execute("VACUUM INTO ?", [str(draft)])
            finally:
                source.close()
            compact = _connect(_uri(draft, "mode=rw"), _prepare_writer)
            try:
                compact.execute("PRAGMA journal_mode=WAL")
            finally:
                compact.close()

    @staticmethod
    def publish(draft: Path, path: Path) -> None:
        """Give a map file that nobody has open its name, in the same file system.

        Raises:
            InputError: something is there already, or the folder is not.
            MapError: the name cannot be given.
        """
        log = draft.with_name(draft.name + "-wal")
        if log.exists() and log.stat().st_size:
            raise MapError(f"{draft} is open still: {path} would lack what its log holds")
        with _naming(path):
            _publish(draft, path)
            _sync_folder(path.parent)

    def size_bytes(self) -> int:
        """The file and its write-ahead log."""
        log = self.path.with_name(self.path.name + "-wal")
        return sum(file.stat().st_size for file in (self.path, log) if file.exists())

    def close(self) -> None:
        """Close all connections; the last one to close empties the write-ahead log."""
        self._end_readers()
        if self._writer is not None:
            with _translated(self.name):
                self._writer.dispose()

    def _end_readers(self) -> None:
        self._reader.dispose()
        while self._idle:
            self._idle.pop().close()

    def _reading_engine(self) -> Engine:
        return _engine(self._uri, self._prepare_reader)

    def _prepare_reader(self, connection: sqlite3.Connection) -> None:
        """What a map of an older format lacks is seen as empty tables of this connection alone."""
        _prepare(connection)
        for table in missing_in(self.format_version):
            connection.execute(_definition(table).replace("CREATE TABLE", "CREATE TEMP TABLE", 1))
        connection.execute("PRAGMA query_only=ON")

    def _raise_format(self) -> None:
        """Bring an older map to the newest format: all of it, in one transaction."""
        if _format_version(self.path, self._uri) < FORMAT_VERSION:
            with self.writing() as connection:
                raise_tables(connection, self.format_version, _free_no_names)
                connection.execute(text(f"PRAGMA user_version={FORMAT_VERSION}"))
        if self.format_version < FORMAT_VERSION:
            self.format_version = FORMAT_VERSION
            self._end_readers()
            self._reader = self._reading_engine()


def _definition(table: Table) -> str:
    """The statement that makes a table."""
    return str(CreateTable(table).compile(dialect=sqlite_dialect.dialect())).strip()


def _free_no_names(connection: Connection, renamed: str) -> None:
    """SQLite's constraints have no names that could clash."""


def _uri(path: Path, options: str) -> str:
    return f"file:{quote(str(path.absolute()))}?{options}"


def _reading_uri(path: Path) -> str:
    """How to open a file for reading, wherever it lies.

    A write-ahead log wants a second file beside it, which cannot be made on read-only media.
    Without a log there is nothing to coordinate, and SQLite may be told so.
    """
    if os.access(path, os.W_OK) and os.access(path.absolute().parent, os.W_OK):
        return _uri(path, "mode=rw")
    return _uri(path, "mode=ro" if _has_log(path) else _NOBODY_WRITES)


def _way_of_reading(path: Path) -> str:
    """`_reading_uri`, or, on a full disk, that of a file that nobody writes.

    The file beside the write-ahead log cannot be made there. Without a log and without a writer
    there is nothing to coordinate: history stays readable, and a map can be copied elsewhere.
    """
    uri = _reading_uri(path)
    try:
        _format_version(path, uri)
    except StorageFullError:
        if _has_log(path) or current_holder(path) is not None:
            raise
        return _uri(path, _NOBODY_WRITES)
    return uri


def _is_immutable(uri: str) -> bool:
    return uri.endswith(_NOBODY_WRITES)


def _has_log(path: Path) -> bool:
    log = path.with_name(path.name + "-wal")
    return log.exists() and log.stat().st_size > 0


def _state(path: Path) -> tuple[int, int, int] | None:
    """Which file stands under a name, and when it was last written; None where none does."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def _connect(uri: str, prepare: Callable[[sqlite3.Connection], None]) -> sqlite3.Connection:
    connection = sqlite3.connect(
        uri,
        uri=True,
        timeout=_BUSY_TIMEOUT_S,
        check_same_thread=False,  # whoever takes a connection has it alone until giving it back
        isolation_level=None,  # transactions begin where SQLAlchemy says so
    )
    try:
        prepare(connection)
    except sqlite3.Error:
        connection.close()
        raise
    return connection


class _MapDialect(SQLiteDialect_pysqlite):
    """SQLite's dialect, equal for all maps: a statement is compiled once, not for every map.

    SQLAlchemy keys compiled statements by the engine's dialect. A process that opens many small
    maps would spend half of its time on compiling the same statements again.
    """

    supports_statement_cache = True

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self)

    def __hash__(self) -> int:
        return hash(type(self))


registry.register("engrammap", __name__, _MapDialect.__name__)
_COMPILED: LRUCache[Any, Any] = LRUCache(500)


def _engine(uri: str, prepare: Callable[[sqlite3.Connection], None]) -> Engine:
    def connect() -> sqlite3.Connection:
        return _connect(uri, prepare)

    engine = create_engine(
        "engrammap://",
        creator=connect,
        poolclass=QueuePool,
        max_overflow=-1,
        execution_options={"compiled_cache": _COMPILED},
    )
    if prepare is _prepare_writer:
        # Take the write lock at once: a transaction that upgrades later can fail half way.
        @event.listens_for(engine, "begin")
        def begin(connection: Connection) -> None:
            connection.exec_driver_sql("BEGIN IMMEDIATE")

    return engine


def _prepare(connection: sqlite3.Connection) -> None:
    connection.execute("PRAGMA trusted_schema=OFF")
    connection.execute("PRAGMA cell_size_check=ON")
    connection.execute(f"PRAGMA cache_size=-{_CACHE_KIB}")


def _prepare_writer(connection: sqlite3.Connection) -> None:
    _prepare(connection)
    connection.execute("PRAGMA synchronous=FULL")


def _check_version() -> None:
    if sqlite3.sqlite_version_info < _OLDEST_SQLITE:
        raise MapError(
            f"this Python comes with SQLite {sqlite3.sqlite_version}; maps need "
            f"{'.'.join(map(str, _OLDEST_SQLITE))} or newer"
        )


def _format_version(path: Path, uri: str) -> int:
    """As SQLite sees it: the write-ahead log may be newer than the file's first page."""
    with _translated(str(path)):
        connection = _connect(uri, _prepare)
        try:
            return int(connection.execute("PRAGMA user_version").fetchone()[0])
        finally:
            connection.close()


def _check_header(path: Path) -> None:
    """What can be said from the first 100 bytes, without letting SQLite near the file."""
    _check_version()
    if not path.exists():
        raise NotAMapError(f"{path}: there is no such file")
    if path.is_dir():
        raise NotAMapError(f"{path} is a folder, not a map file")
    try:
        with path.open("rb") as file:
            header = file.read(_HEADER_BYTES)
    except OSError as error:
        raise MapError(f"{path} cannot be read: {error.strerror}") from error
    if len(header) < _HEADER_BYTES or not header.startswith(_MAGIC):
        size = "an empty file" if not header else "no map file"
        raise NotAMapError(f"{path} is {size}; a map begins with {_MAGIC[:15].decode()!r}")
    if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
        raise NotAMapError(f"{path} is an SQLite file, but no Engram map")
    version = int.from_bytes(header[60:64], "big")
    if version > FORMAT_VERSION:
        raise FormatVersionError(
            f"{path} is a map of format {version}, this Engram ({__version__}) reads up to "
            f"{FORMAT_VERSION}; install a newer one"
        )
    if version < 1:
        raise MapCorruptError(f"{path}: format {version} never existed; restore a copy")


def _check_tables(connection: Connection, path: Path, version: int) -> None:
    """Only our tables with our columns: no view, trigger or computed column of a stranger."""
    found = connection.exec_driver_sql(
        "SELECT type, name, tbl_name FROM sqlite_schema ORDER BY name"
    )
    rows = [tuple(row) for row in found]
    tables = {name for kind, name, _ in rows if kind == "table"}
    strange = [f"{kind} {name}" for kind, name, _ in rows if kind not in {"table", "index"}]
    expected = metadata.tables.keys() - {table.name for table in missing_in(version)}
    missing = sorted(expected - tables)
    strange += sorted(f"table {name}" for name in tables - expected)
    if missing or strange:
        raise MapCorruptError(
            f"{path}: not the tables of format {version}: missing {missing}, strange {strange}"
        )
    for table in metadata.sorted_tables:
        columns = [
            (row[1], row[6])
            for row in connection.exec_driver_sql(f"PRAGMA table_xinfo({table.name})")
        ]
        if columns != [(column.name, 0) for column in table.columns]:
            raise MapCorruptError(f"{path}: table {table.name} has the columns {columns}")


@contextmanager
def _new_file(path: Path) -> Iterator[Path]:
    """A draft to be filled, which then appears under its name whole or not at all."""
    with _naming(path), draft_folder(path) as folder:
        draft = folder / path.name
        yield draft
        _publish(draft, path)
        _sync_folder(path.parent)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Around making a new file: what may stand in its way, as our errors."""
    if path.exists() or path.is_symlink():
        raise InputError(f"{path} exists already; open it, or choose another name")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent} is no folder; make it first")
    try:
        yield
    except FileExistsError as error:
        raise InputError(f"{path} exists already; open it, or choose another name") from error
    except OSError as error:
        raise MapError(f"{path} cannot be created: {error.strerror}") from error


def _write_empty(path: Path) -> None:
    engine = _engine(_uri(path, "mode=rwc"), _prepare_writer)
    try:
        with _translated(str(path)):
            with engine.begin() as connection:
                metadata.create_all(connection)
                row = {"key": 1, "version": FORMAT_VERSION, "tool_version": __version__}
                connection.execute(insert(map_format), sealed(map_format, row))
                connection.exec_driver_sql(f"PRAGMA application_id={APPLICATION_ID}")
                connection.exec_driver_sql(f"PRAGMA user_version={FORMAT_VERSION}")
            _enter_wal(engine)
    finally:
        engine.dispose()


def _publish(draft: Path, path: Path) -> None:
    """Give the draft its name, never replacing a map that came meanwhile as a rename would."""
    _remove_orphans(path)
    try:
        os.link(draft, path)
    except OSError as error:
        if error.errno not in {errno.EPERM, errno.ENOTSUP, errno.ENOSYS}:
            raise
        # No hard links here (FAT): take the name first, then fill it.
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        draft.replace(path)


def _enter_wal(engine: Engine) -> None:
    """The file remembers this for ever; it cannot be said inside a transaction."""
    raw = engine.raw_connection()
    try:
        raw.cursor().execute("PRAGMA journal_mode=WAL")
    finally:
        raw.close()


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


_BESIDE = ("-wal", "-shm", "-journal")


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


_CORRUPT = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
_FULL = {
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR_WRITE,
    sqlite3.SQLITE_IOERR_TRUNCATE,
    sqlite3.SQLITE_IOERR_FSYNC,
    sqlite3.SQLITE_IOERR_SHMSIZE,
}


@contextmanager
def _translated(name: str) -> Iterator[None]:
    """SQLite's errors as ours."""
    try:
        yield
    except (DBAPIError, sqlite3.Error) as error:
        cause = error.orig if isinstance(error, DBAPIError) else error
        raise _translate(cause, name) from error
    except UnicodeDecodeError as error:  # sqlite3 reads names of columns without a net
        raise MapCorruptError(f"{name} is damaged ({error}); restore a copy") from error


def _translate(cause: BaseException | None, name: str) -> MapError:
    code = getattr(cause, "sqlite_errorcode", 0)
    if code in _FULL:
        return StorageFullError(
            f"{name} cannot grow ({cause}); free some space or raise the limit and try again: "
            "everything up to the last checkpoint is safe"
        )
    if code & 0xFF in _CORRUPT or "decode" in str(cause):
        return MapCorruptError(f"{name} is damaged ({cause}); run engram check, and restore a copy")
    if code & 0xFF in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
        return MapLockedError(
            f"{name} is held by another program for more than {_BUSY_TIMEOUT_S:.0f} s ({cause})"
        )
    if code & 0xFF == sqlite3.SQLITE_CANTOPEN:
        return MapError(
            f"{name} cannot be opened ({cause}); if it lies on read-only media with a file "
            f"{Path(name).name}-wal beside it, copy both where they may be written"
        )
    return MapError(f"{name}: {cause}")
