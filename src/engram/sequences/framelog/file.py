"""The SQLite files of frame logs and flight records: their tables and write-ahead log."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from sqlalchemy import BigInteger, Column, Connection, Integer, LargeBinary, MetaData, Table, Text
from sqlalchemy.exc import OperationalError

from engram.errors import SequenceError
from engram.frontend.blobs import content_digest
from engram.sqlite import FileKind, SqliteFile

metadata = MetaData()

_INT64 = BigInteger().with_variant(Integer(), "sqlite")

# One row. `complete` is the number of frames once the whole drive is recorded, before that 0;
# `digest` is `log_digest`.
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


def log_digest(header: str, complete: int) -> bytes:
    """Hash of a log's row: of the header, and of the number of frames once all are recorded."""
    return content_digest(f"{header}{complete or ''}".encode())


# One row a frame, numbered from 0 without gaps. The blobs have their own hashes; `digest` covers
# all other columns and those hashes.
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


FRAME_LOG = FileKind(
    noun="frame log",
    application_id=0x456E464C,  # "EnFL"
    format_version=2,
    metadata=metadata,
    strange=SequenceError,
    cure="restore a copy or record it again",
    busy_s=1.0,  # a second writer gives up after this; a reader never waits for a writer
    older="record the drive again",
)


FLIGHT_SUFFIX = ".flight"
_flight_metadata = MetaData()
for _table in (log_table, frames_table):
    _table.to_metadata(_flight_metadata)

# One row: why and where the record was made, JSON.
report_table = Table(
    "report",
    _flight_metadata,
    Column("key", _INT64, primary_key=True, autoincrement=False),
    Column("content", Text(), nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)
# One row a frame: what the robot concluded, JSON.
decisions_table = Table(
    "decisions",
    _flight_metadata,
    Column("number", _INT64, primary_key=True, autoincrement=False),
    Column("content", Text(), nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)
# One row a frame with images, JPEG; none in a record without images.
images_table = Table(
    "images",
    _flight_metadata,
    Column("number", _INT64, primary_key=True, autoincrement=False),
    Column("left_image", LargeBinary(), nullable=False),
    Column("right_image", LargeBinary(), nullable=False),
    Column("digest", LargeBinary(), nullable=False),
    sqlite_strict=True,
)

# A frame log of a robot's last seconds, with images and decisions beside it.
FLIGHT_RECORD = FileKind(
    noun="flight record",
    application_id=0x456E4652,  # "EnFR"
    format_version=2,
    metadata=_flight_metadata,
    strange=SequenceError,
    cure="restore a copy",
    busy_s=1.0,
    older="it can be read by the Engram that wrote it",
)


def framelog_file(path: Path) -> SqliteFile:
    """The file of a frame log, or a flight record by its suffix; it may not exist yet."""
    return SqliteFile(path, FLIGHT_RECORD if path.suffix == FLIGHT_SUFFIX else FRAME_LOG)


def begin_writing(connection: Connection) -> None:
    """Takes the file's write lock; readers still see the last commit."""
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def log_while_writing(connection: Connection) -> None:
    """Switches to a write-ahead log, so that commits survive the process; outside a transaction."""
    connection.exec_driver_sql("PRAGMA journal_mode = WAL")
    connection.exec_driver_sql("PRAGMA synchronous = NORMAL")


def fold_log_in(connection: Connection) -> None:
    """Merges the write-ahead log into the file, for read-only media; outside a transaction.

    If a reader has the file open, the next writer does it.
    """
    try:
        connection.exec_driver_sql("PRAGMA journal_mode = DELETE")
    except OperationalError as error:
        code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF
        if code not in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
            raise
