"""SQLite files of ROS 2 bags (`.db3`), row by row.

Source: rosbag2_storage_sqlite3: tables `topics` (id, name, type, serialization_format, …) and
`messages` (id, topic_id, timestamp, data).
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from engram.sequences.bags.compression import ZSTD_MAGIC, unpacked
from engram.sequences.bags.records import (
    MAX_BYTES,
    DamageError,
    Record,
    Report,
    Topic,
    message_type,
    topic_of,
)
from engram.untrusted import open_regular

_MAGIC = b"SQLite format 3\x00"
# Rows passed over at a damaged page, doubled until a sound one follows.
_LEAP, _LEAPS = 1, 24


class DatabaseBag:
    """A `BagFile` of ROS 2 in SQLite."""

    is_ros1 = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self._copy: TemporaryDirectory[str] | None = None

    def topics(self, lost: Report) -> dict[str, Topic]:
        """The topics; see `BagFile`."""
        with closing(self._open()) as database:
            try:
                named = self._named(database)
            except sqlite3.Error as error:
                raise DamageError(f"{self.path}: its topics cannot be read: {error}") from error
            try:
                counts = dict(
                    database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id")
                )
            except sqlite3.Error:
                lost(f"{self.path}: is damaged or cut short")
                return {topic.name: topic for topic in named.values()}
        return {
            topic.name: Topic(topic.name, topic.type, counts.get(number, 0))
            for number, topic in named.items()
        }

    def records(self, topics: Collection[str] | None, lost: Report) -> Iterator[Record]:
        """The messages in the order of recording; see `BagFile`."""
        with closing(self._open()) as database:
            try:
                named = self._named(database)
            except sqlite3.Error as error:
                lost(f"{self.path}: its topics cannot be read: {error}")
                return
            wanted = {
                number: topic.name
                for number, topic in named.items()
                if topics is None or topic.name in topics
            }
            yield from self._rows(database, wanted, lost)

    def _open(self) -> sqlite3.Connection:
        with os.fdopen(open_regular(self.path), "rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise DamageError(f"{self.path}: is not an SQLite file")
        try:
            if not _has_log(self.path):
                return _connected(self.path, "mode=ro&immutable=1")
            # What a killed recorder did not move into the file lies beside it. SQLite reads both
            # only where it can write an index beside them: not on a disk that is read-only.
            database = _connected(self._copied() if self._copy else self.path, "mode=ro")
            try:
                database.execute("SELECT count(*) FROM sqlite_master")
            except sqlite3.OperationalError:
                database.close()
                database = _connected(self._copied(), "mode=ro")
        except sqlite3.Error as error:
            raise DamageError(f"{self.path}: cannot be opened: {error}") from error
        return database

    def _copied(self) -> Path:
        """A copy of the file and its log in a folder that can be written to; made once."""
        if self._copy is not None:
            return Path(self._copy.name) / self.path.name
        log = _log_of(self.path)
        try:
            folder = TemporaryDirectory(prefix="engram-bag-")
            copy = Path(folder.name) / self.path.name
            for source, target in ((self.path, copy), (log, _log_of(copy))):
                with os.fdopen(open_regular(source), "rb") as read, target.open("xb") as written:
                    shutil.copyfileobj(read, written)
        except OSError as error:
            raise DamageError(
                f"{self.path}: its last messages lie in {log.name}, and there is no room for a "
                f"copy of both: {error.strerror}; copy them to a folder that can be written to"
            ) from error
        self._copy = folder
        return copy

    def _named(self, database: sqlite3.Connection) -> dict[int, Topic]:
        tables = {
            name
            for (name,) in database.execute(
                "SELECT name FROM sqlite_master WHERE type = 'table' "
                "AND name IN ('topics', 'messages')"
            )
        }
        if tables != {"topics", "messages"}:
            raise DamageError(f"{self.path}: is an SQLite file, but not a ROS 2 bag")
        rows = list(database.execute("SELECT id, name, type, serialization_format FROM topics"))
        formats = {str(row[3]) for row in rows}
        if formats and "cdr" not in formats:
            raise DamageError(
                f"{self.path}: messages are serialised as {', '.join(sorted(formats))}; only cdr "
                "is read"
            )
        return {
            int(number): topic_of(str(name), message_type(str(kind)), str(form), "cdr")
            for number, name, kind, form in rows
        }

    def _rows(
        self, database: sqlite3.Connection, wanted: dict[int, str], lost: Report
    ) -> Iterator[Record]:
        """Reads by row id; at a damaged page passes over rows until one can be read."""
        marks = ",".join("?" * len(wanted))
        query = (
            "SELECT id, topic_id, timestamp, data FROM messages "
            f"WHERE id > ? AND topic_id IN ({marks}) ORDER BY id"
        )
        last, leap, leaps = -1, _LEAP, 0
        while leaps < _LEAPS:
            try:
                for row, topic, stamp_ns, data in database.execute(query, (last, *wanted)):
                    last, leap = row, _LEAP
                    record = self._record(row, wanted[topic], stamp_ns, data, lost)
                    if record is not None:
                        yield record
                return
            except sqlite3.Error as error:
                if leap == _LEAP:
                    lost(f"{self.path}: rows after {last} are lost: {error}")
                last, leap, leaps = last + leap, leap * 4, leaps + 1

    def _record(
        self, row: int, topic: str, stamp_ns: object, data: object, lost: Report
    ) -> Record | None:
        if not isinstance(stamp_ns, int) or not isinstance(data, bytes):
            lost(f"{self.path}: row {row} holds no message")
            return None
        if data.startswith(ZSTD_MAGIC):
            try:
                data = unpacked(data, "zstd")
            except DamageError as error:
                lost(f"{self.path}: row {row} is lost: {error}")
                return None
        return Record(topic, stamp_ns, data)


def _log_of(path: Path) -> Path:
    """The write-ahead log of a database."""
    return path.with_name(path.name + "-wal")


def _has_log(path: Path) -> bool:
    log = _log_of(path)
    return log.exists() and log.stat().st_size > 0


def _connected(path: Path, mode: str) -> sqlite3.Connection:
    database = sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BYTES)
    database.execute("PRAGMA trusted_schema = OFF")
    # The file is open for reading only; this lets SQLite read one that was cut short.
    database.execute("PRAGMA writable_schema = ON")
    return database
