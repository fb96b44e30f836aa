"""Engram's SQLite files, maps and frame logs: identity, opening, and errors.

Only SQLite opens such a file, even to read its header: closing another handle drops the locks that
this process holds through SQLite. The next process that closes the file would then remove the
write-ahead log while the writer still uses it.
"""

from __future__ import annotations

import os
import re
import sqlite3
import stat
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import quote

from sqlalchemy import Engine, MetaData, create_engine
from sqlalchemy.dialects import registry
from sqlalchemy.dialects.sqlite.pysqlite import SQLiteDialect_pysqlite
from sqlalchemy.exc import DBAPIError
from sqlalchemy.pool import QueuePool
from sqlalchemy.util import LRUCache

from engram import __version__
from engram.errors import (
    EngramError,
    FormatVersionError,
    InputError,
    MapCorruptError,
    MapError,
    MapLockedError,
    StorageFullError,
)
from engram.files import check_parent
from engram.untrusted import open_regular

_OLDEST_SQLITE = (3, 37, 0)  # knows STRICT tables
_CACHE_KIB = 8192
# Bytes of one value or row: a vocabulary is the largest.
_LONGEST_VALUE = 256 * 2**20

_FULL = {
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR_WRITE,
    sqlite3.SQLITE_IOERR_TRUNCATE,
    sqlite3.SQLITE_IOERR_FSYNC,
    sqlite3.SQLITE_IOERR_SHMSIZE,
}

# One statement for all tables: a program opens maps by the thousand.
_COLUMNS = """
    SELECT of_table.name, its.name, its.hidden
    FROM sqlite_schema AS of_table, pragma_table_xinfo(of_table.name, 'main') AS its
    WHERE of_table.type = 'table' ORDER BY its.cid
"""

# Definitions of tables and indices that hold names, types and keys, and nothing to evaluate.
_NAME = r'(?:"\w+"|\w+)'
_NAMES = rf"\( ?{_NAME}(?:, ?{_NAME})* ?\)"
_COLUMN = rf"{_NAME} (?:INTEGER|BIGINT|REAL|TEXT|BLOB)(?: NOT NULL)?"
_PART = rf"\s*(?:{_COLUMN}|PRIMARY KEY {_NAMES}|UNIQUE {_NAMES})\s*"
_PLAIN = re.compile(
    rf"CREATE TABLE {_NAME} \({_PART}(?:,{_PART})*\)\s*STRICT\s*"
    rf"|CREATE INDEX {_NAME} ON {_NAME} {_NAMES}"
)

# Runs one statement on an open connection, of SQLAlchemy or of SQLite.
Execute: TypeAlias = Callable[[str], Any]


@dataclass(frozen=True, slots=True, eq=False)
class FileKind:
    """A kind of file.

    Attributes:
        application_id: number in the file's header that identifies the kind.
        strange: the error for a file that is not of this kind, or cannot be opened.
        cure: advice for a damaged file.
        busy_s: how long to wait for another process to release the file, seconds.
        older: advice for a file of an earlier format.
        newest: tables without which a file is of a draft of the format, and advice for it.
    """

    noun: str
    application_id: int
    format_version: int
    metadata: MetaData
    strange: type[EngramError]
    cure: str
    busy_s: float
    older: str = ""
    newest: tuple[frozenset[str], str] = (frozenset(), "")


class SqliteFile:
    """A file of a kind."""

    def __init__(self, path: Path, kind: FileKind) -> None:
        self.path = path
        self.kind = kind

    def check_regular(self, *, may_be_new: bool = False) -> None:
        """Refuses files on which SQLite would block, or that it would take for an empty one."""
        noun, strange = self.kind.noun, self.kind.strange
        try:
            status = self.path.stat()
        except (FileNotFoundError, NotADirectoryError) as error:
            if may_be_new:
                self._check_place()
                return
            raise strange(f"{self.path}: there is no such file") from error
        except OSError as error:
            raise MapError(f"{self.path} cannot be read: {error.strerror}") from error
        if stat.S_ISDIR(status.st_mode):
            raise strange(f"{self.path} is a folder, not a {noun}")
        if not stat.S_ISREG(status.st_mode):
            raise strange(f"{self.path} is a pipe, a socket or a device, not a {noun}")
        if not os.access(self.path, os.R_OK):
            raise MapError(f"{self.path} cannot be read: permission denied")
        if not status.st_size and not may_be_new:
            raise strange(f"{self.path} is an empty file, not a {noun}")

    def _check_place(self) -> None:
        check_parent(self.path)
        if not os.access(self.path.parent, os.W_OK):
            raise MapError(f"{self.path} cannot be created: permission denied")

    def identify(self, execute: Execute) -> None:
        """Refuses files of another kind or format.

        Read through SQLite, since the log may be newer than the first page.
        """
        kind = self.kind
        if self._pragma(execute, "application_id") != kind.application_id:
            raise kind.strange(f"{self.path} is an SQLite file, but not a {kind.noun}")
        version = self._pragma(execute, "user_version")
        if version > kind.format_version:
            raise FormatVersionError(
                f"{self.path} is a {kind.noun} of format {version}, this Engram ({__version__}) "
                f"reads up to {kind.format_version}: upgrade Engram"
            )
        if version < 1:
            raise MapCorruptError(f"{self.path}: format {version} does not exist; {kind.cure}")
        if version < kind.format_version:
            raise FormatVersionError(
                f"{self.path} is a {kind.noun} of format {version}, this Engram ({__version__}) "
                f"reads only format {kind.format_version}: {kind.older}"
            )

    def is_new(self, execute: Execute) -> bool:
        """Whether the file is still empty."""
        (count,) = execute("SELECT count(*) FROM sqlite_schema").fetchone()
        return not count and self._pragma(execute, "application_id") == 0

    def mark(self, execute: Execute) -> None:
        """Writes the kind and the format into the header."""
        execute(f"PRAGMA application_id={self.kind.application_id}")
        execute(f"PRAGMA user_version={self.kind.format_version}")

    def check_tables(self, execute: Execute) -> None:
        """Refuses files with other tables or columns, or with anything that SQLite would evaluate.

        Definitions are compared as text, before any table is touched: defaults, checks, generated
        columns, partial indices, views, triggers and virtual tables of a stranger never run.

        Args:
            execute: `execute` of an open connection.
        """
        for name, definition in execute("SELECT name, sql FROM sqlite_schema").fetchall():
            if definition is not None and not _PLAIN.fullmatch(str(definition)):
                raise MapCorruptError(
                    f"{self.path}: {str(name)!r:.60} is not a plain table or index; "
                    f"{self.kind.cure}"
                )
        found = execute("SELECT type, name FROM sqlite_schema WHERE type != 'index'").fetchall()
        present = {(str(kind), str(name)) for kind, name in found}
        wanted = {("table", name) for name in self.kind.metadata.tables}
        newest, advice = self.kind.newest
        if newest and wanted - present == {("table", name) for name in newest}:
            raise FormatVersionError(
                f"{self.path} is a {self.kind.noun} of a draft of format "
                f"{self.kind.format_version}: {advice}"
            )
        if present != wanted:
            raise MapCorruptError(
                f"{self.path}: does not have the tables of its format: missing "
                f"{sorted(wanted - present)}, unexpected {sorted(present - wanted)}"
            )
        columns: dict[str, list[tuple[str, int]]] = {}
        for table, column, hidden in execute(_COLUMNS).fetchall():
            columns.setdefault(table, []).append((column, hidden))
        for name, table in self.kind.metadata.tables.items():
            if columns[name] != [(column.name, 0) for column in table.columns]:
                raise MapCorruptError(f"{self.path}: table {name} has the columns {columns[name]}")

    def connect(self, options: str) -> sqlite3.Connection:
        """A connection; transactions begin explicitly.

        Args:
            options: of SQLite's URI: ``mode=ro``, ``mode=rw`` or ``mode=rwc``.
        """
        if sqlite3.sqlite_version_info < _OLDEST_SQLITE:
            raise MapError(
                f"this Python comes with SQLite {sqlite3.sqlite_version}; a {self.kind.noun} needs "
                f"{'.'.join(map(str, _OLDEST_SQLITE))} or newer"
            )
        place = str(self.path.absolute())
        try:
            address = f"file:{quote(place)}?{options}"
        except UnicodeEncodeError as error:
            raise MapError(f"{place}: the path is not UTF-8; rename file or folder") from error
        if names_another_file(self.path):
            raise MapCorruptError(
                f"{self.path}-journal names another file, as no journal of Engram's does; move it "
                "away"
            )
        connection = sqlite3.connect(
            address,
            uri=True,
            timeout=self.kind.busy_s,
            check_same_thread=False,  # only one thread at a time uses a connection
            isolation_level=None,
        )
        try:
            _prepare(connection)
        except sqlite3.Error as error:
            connection.close()
            code = getattr(error, "sqlite_errorcode", 0)
            if code != sqlite3.SQLITE_READONLY_ROLLBACK or not self._roll_back():
                raise
            return self.connect(options)
        return connection

    def _roll_back(self) -> bool:
        """Undoes what a killed process or a power cut left of a transaction next to the file.

        Readers cannot: they have it open for reading only. False where this process may not write.
        """
        if not (os.access(self.path, os.W_OK) and os.access(self.path.parent, os.W_OK)):
            return False
        with closing(self.connect("mode=rw")) as connection:
            connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
        return True

    def engine(
        self, options: str, prepare: Callable[[sqlite3.Connection], object] | None = None
    ) -> Engine:
        """A pool of such connections, each prepared before it is used."""

        def connect() -> sqlite3.Connection:
            connection = self.connect(options)
            try:
                if prepare is not None:
                    prepare(connection)
            except sqlite3.Error:
                connection.close()
                raise
            return connection

        return create_engine(
            "engramfile://",
            creator=connect,
            poolclass=QueuePool,
            max_overflow=-1,
            execution_options={"compiled_cache": _COMPILED},
        )

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Converts SQLite's errors into Engram's, with the file's name.

        Raises:
            EngramError: the kind's `strange`: not an SQLite file, or it cannot be opened.
            MapCorruptError: it is damaged or cut short.
            MapLockedError: another process writes to it.
            StorageFullError: no space is left.
            MapError: anything else, as on read-only media.
        """
        try:
            yield
        except (DBAPIError, sqlite3.Error) as error:
            cause = error.orig if isinstance(error, DBAPIError) else error
            raise self._translate(cause) from error
        except UnicodeDecodeError as error:  # sqlite3 does not guard column names
            raise MapCorruptError(f"{self.path} is damaged ({error}); {self.kind.cure}") from error

    def _translate(self, cause: BaseException | None) -> EngramError:
        code = getattr(cause, "sqlite_errorcode", 0)
        primary, noun = code & 0xFF, self.kind.noun
        error: type[EngramError] = MapError
        fact = f"cannot be read or written: {cause}"
        if is_full(cause):
            error = StorageFullError
            fact = (
                f"cannot grow ({cause}); free some space or raise the limit and try again: "
                "everything up to the last checkpoint is safe"
            )
        elif primary == sqlite3.SQLITE_NOTADB:
            error = self.kind.strange
            fact = f"is not a {noun}: it is not an SQLite file, or its beginning is damaged"
        elif code == sqlite3.SQLITE_READONLY_ROLLBACK:
            fact = (
                f"holds an interrupted transaction, which {self.path.name}-journal undoes: copy "
                "both to a writable folder"
            )
        elif primary == sqlite3.SQLITE_CANTOPEN:
            error = self.kind.strange
            fact = (
                f"cannot be opened ({cause}); if it lies on read-only media with a file "
                f"{self.path.name}-wal next to it, copy both to a writable folder"
            )
        elif primary in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
            error = MapLockedError
            fact = f"is a {noun} that another process writes to ({cause}); wait until it is done"
        elif primary == sqlite3.SQLITE_CORRUPT or "decode" in str(cause):
            error, fact = MapCorruptError, f"is damaged ({cause}); {self.kind.cure}"
        return error(f"{self.path} {fact}")

    @staticmethod
    def _pragma(execute: Execute, name: str) -> int:
        return int(execute(f"PRAGMA {name}").fetchone()[0])


def names_another_file(path: Path) -> bool:
    """Whether a journal next to a file names a super-journal: SQLite deletes it after a rollback.

    A stranger's could name any file. Source: SQLite, "Database File Format", §3.
    """
    journal = path.with_name(f"{path.name}-journal")
    if not journal.exists():
        return False
    with os.fdopen(open_regular(journal, InputError), "rb") as file:
        file.seek(-min(file.seek(0, os.SEEK_END), len(_SUPER)), os.SEEK_END)
        return bool(file.read() == _SUPER)


def is_full(cause: object) -> bool:
    """Whether an error of SQLite means that no space is left."""
    return getattr(cause, "sqlite_errorcode", 0) in _FULL


# The last bytes of a journal with a super-journal.
_SUPER = bytes.fromhex("d9d505f920a163d7")


class _FileDialect(SQLiteDialect_pysqlite):
    """One SQLite dialect for all files, so that each statement is compiled once.

    SQLAlchemy caches compiled statements by dialect. With one dialect per file, a process that
    opens many small maps would spend half of its time compiling.
    """

    supports_statement_cache = True

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self)

    def __hash__(self) -> int:
        return hash(type(self))


registry.register("engramfile", __name__, _FileDialect.__name__)
_COMPILED: LRUCache[Any, Any] = LRUCache(500)


def _prepare(connection: sqlite3.Connection) -> None:
    connection.execute("PRAGMA trusted_schema=OFF")  # call no functions of the file
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_VALUE)
    connection.setlimit(sqlite3.SQLITE_LIMIT_EXPR_DEPTH, 100)
    connection.execute("PRAGMA cell_size_check=ON")
    connection.execute("PRAGMA synchronous=FULL")
    connection.execute(f"PRAGMA cache_size=-{_CACHE_KIB}")
