"""The SQLite file of a frame log: tables, connections, and what SQLite's errors mean.

All that is particular to SQLite stands here.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    Engine,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
    create_engine,
    exc,
)
from sqlalchemy.pool import QueuePool

from engram.errors import (
    FormatVersionError,
    MapCorruptError,
    MapError,
    MapLockedError,
    SequenceError,
    StorageFullError,
)

FORMAT_VERSION = 1
# "EnFL": SQLite keeps it in the file's header, so that `file` and we know what it is.
_APPLICATION_ID = 0x456E464C

# A second writer gives up after this; a reader never waits for a writer (WAL).
_BUSY_S = 1.0

metadata = MetaData()

_INT64 = BigInteger().with_variant(Integer(), "sqlite")

# One row. `digest` is that of `header`; `complete` is 1 once the whole drive was recorded.
log_table = Table(
    "log",
    metadata,
    Column("key", _INT64, primary_key=True, autoincrement=False),
    Column("header", Text(), nullable=False),
    Column("tool_version", Text(), nullable=False),
    Column("complete", _INT64, nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)

# One row a frame, numbered from 0 without gaps. The blobs carry hashes of their own; `digest` is
# over all other columns and those hashes.
frames_table = Table(
    "frames",
    metadata,
    Column("number", _INT64, primary_key=True, autoincrement=False),
    Column("stamp_ns", _INT64, nullable=False, unique=True),
    Column("status", Text(), nullable=False),
    Column("pair_hash", Text(), nullable=False),
    Column("odometry_status", Text(), nullable=False),
    Column("inliers", _INT64, nullable=False),
    Column("prev_from_curr", LargeBinary()),  # (3, 4) float64, little-endian, row-major
    Column("covariance", LargeBinary()),  # (6, 6) float64 likewise
    Column("digest", LargeBinary(), nullable=False),
    Column("landmarks", LargeBinary(), nullable=False),
    Column("thumbnail", LargeBinary()),  # 16 bytes of SHA-256, then JPEG
    sqlite_strict=True,
)


def writing_engine(path: Path) -> Engine:
    """An engine that makes the file where there is none."""
    return _engine(path, "rwc")


def reading_engine(path: Path) -> Engine:
    """An engine that cannot change the file."""
    return _engine(path, "ro")


def _engine(path: Path, mode: str) -> Engine:
    uri = f"file:{quote(str(path.resolve()))}?mode={mode}"

    def connect() -> sqlite3.Connection:
        # Transactions are begun by hand (isolation level None): the driver would begin them late.
        connection = sqlite3.connect(
            uri, uri=True, timeout=_BUSY_S, isolation_level=None, check_same_thread=False
        )
        # Nothing in a file from elsewhere may call functions with effects.
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA cell_size_check = ON")
        return connection

    return create_engine("sqlite://", creator=connect, poolclass=QueuePool)


def begin_writing(connection: Connection) -> None:
    """Take the file's one write lock; readers go on seeing what was committed last."""
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def prepare(connection: Connection) -> None:
    """Make the tables of a new, empty file; within a write transaction."""
    metadata.create_all(connection)
    connection.exec_driver_sql(f"PRAGMA application_id = {_APPLICATION_ID}")
    connection.exec_driver_sql(f"PRAGMA user_version = {FORMAT_VERSION}")


def is_empty(connection: Connection) -> bool:
    """Whether the file holds nothing at all yet."""
    count = connection.exec_driver_sql("SELECT count(*) FROM sqlite_schema").scalar()
    return count == 0 and _pragma(connection, "application_id") == 0


def log_while_writing(connection: Connection) -> None:
    """Write-ahead log: what is committed survives the process; outside a transaction."""
    connection.exec_driver_sql("PRAGMA journal_mode = WAL")
    connection.exec_driver_sql("PRAGMA synchronous = NORMAL")


def fold_log_in(connection: Connection) -> None:
    """Make the file one file again, readable from read-only media; outside a transaction.

    Where a reader has it open, that is left to the next writer.
    """
    try:
        connection.exec_driver_sql("PRAGMA journal_mode = DELETE")
    except exc.OperationalError as error:
        if not _is(error, "SQLITE_BUSY", "SQLITE_LOCKED"):
            raise


def check_kind(connection: Connection, path: Path) -> None:
    """Refuse what is no frame log, or a newer one.

    Raises:
        SequenceError: another kind of file.
        FormatVersionError: written by a newer Engram.
        MapCorruptError: its tables are not those of a frame log.
    """
    if _pragma(connection, "application_id") != _APPLICATION_ID:
        raise SequenceError(f"{path}: is an SQLite file, but no frame log")
    version = _pragma(connection, "user_version")
    if version > FORMAT_VERSION:
        raise FormatVersionError(
            f"{path}: frame log of format {version}, this Engram reads up to {FORMAT_VERSION}: "
            "upgrade it"
        )
    # Views and triggers in a file from elsewhere could run without end.
    kinds = connection.exec_driver_sql(
        "SELECT type, tbl_name FROM sqlite_schema WHERE type != 'index' ORDER BY tbl_name"
    ).all()
    if [tuple(kind) for kind in kinds] != [("table", name) for name in sorted(metadata.tables)]:
        raise MapCorruptError(f"{path}: holds other tables than a frame log's")


def _pragma(connection: Connection, name: str) -> int:
    return int(connection.exec_driver_sql(f"PRAGMA {name}").scalar_one())


@contextmanager
def plain_errors(path: Path) -> Iterator[None]:
    """SQLite's errors as ours, each with the file's name.

    Raises:
        SequenceError: the file is no SQLite file, or cannot be opened.
        MapCorruptError: it is damaged or cut short.
        MapLockedError: another process writes to it.
        StorageFullError: no space is left.
        MapError: it cannot be written, for example on read-only media.
    """
    try:
        yield
    except UnicodeDecodeError as error:
        # Python's driver cannot even form the message when damage has reached the schema.
        raise MapCorruptError(
            f"{path}: damaged ({error}); restore a copy or extract it anew"
        ) from error
    except exc.DBAPIError as error:
        fact = str(error.orig)
        if _is(error, "SQLITE_NOTADB"):
            raise SequenceError(f"{path}: is no frame log (no SQLite file)") from error
        if _is(error, "SQLITE_CANTOPEN"):
            raise SequenceError(f"{path}: cannot be opened: {fact}") from error
        if _is(error, "SQLITE_BUSY", "SQLITE_LOCKED"):
            raise MapLockedError(
                f"{path}: another process writes to this frame log; wait until it is done"
            ) from error
        if _is(error, "SQLITE_FULL"):
            raise StorageFullError(
                f"{path}: no space is left; frames up to the last checkpoint are safe, free some "
                "space and record again to go on from there"
            ) from error
        if _is(error, "SQLITE_READONLY", "SQLITE_IOERR"):
            raise MapError(f"{path}: cannot be read or written here: {fact}") from error
        raise MapCorruptError(
            f"{path}: damaged or cut short ({fact}); restore a copy or extract it anew"
        ) from error


def _is(error: exc.DBAPIError, *names: str) -> bool:
    found = getattr(error.orig, "sqlite_errorname", "")
    return any(found == name or found.startswith(f"{name}_") for name in names)
