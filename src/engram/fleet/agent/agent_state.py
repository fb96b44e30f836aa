"""The limits of an agent, and its state: one SQLite file that survives a kill at any moment."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from sqlalchemy import MetaData

from engram.config import check_bounds
from engram.errors import MapError
from engram.fleet.transfers import PartHash
from engram.sqlite import FileKind, SqliteFile

_FILE = FileKind(
    noun="file of an agent",
    application_id=0,
    format_version=0,
    metadata=MetaData(),
    strange=MapError,
    cure="remove it and enrol the robot again: its map is whole and is handed in again",
    busy_s=30.0,
)

_TABLES = """
CREATE TABLE IF NOT EXISTS facts (name TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS outbox (
    id TEXT PRIMARY KEY, place INTEGER NOT NULL, manifest BLOB NOT NULL, state TEXT NOT NULL,
    bytes INTEGER NOT NULL, revision INTEGER, error TEXT) STRICT;
CREATE TABLE IF NOT EXISTS waiting (
    outbox TEXT NOT NULL, hash BLOB NOT NULL, body BLOB NOT NULL,
    PRIMARY KEY (outbox, hash)) STRICT;
CREATE TABLE IF NOT EXISTS shared (hash BLOB PRIMARY KEY) STRICT;
CREATE TABLE IF NOT EXISTS arrived (hash BLOB PRIMARY KEY, body BLOB NOT NULL) STRICT;
"""


@dataclass(frozen=True, slots=True)
class AgentFacts:
    """What an agent remembers of its robot; None where nothing is recorded yet.

    Attributes:
        url, robot, map, name: the centre, the robot's id there, its map, and its own name.
        runs: version of the map that the robot drives with.
        runs_before: the one before it, which `base` holds.
        wanted: version that the centre wants on the robot.
        durable: revision that a backup of the centre holds.
        staged: version that is ready for the next switch.
        staged_on: revision of the live map from which it was staged.
        fetched: version and options of the download in `next`.
        rejected: version that served badly.
        good: version that served well.
        share, driven_m: share of frames that it localised so far, and distance driven, metres.
        failures: rounds that failed since the last good one.
        trouble: why the last round failed; empty after a good one.
        last_queued: the newest hand-in.
        base: manifest that the centre has, as JSON.
        handin: ids at the centre of the hand-ins in the outbox.
    """

    url: str | None = None
    robot: str | None = None
    map: str | None = None
    name: str | None = None
    runs: str | None = None
    runs_before: str | None = None
    wanted: str | None = None
    durable: int | None = None
    staged: str | None = None
    staged_on: int | None = None
    fetched: tuple[str, dict[str, Any]] | None = None
    rejected: str | None = None
    good: str | None = None
    share: float | None = None
    driven_m: float | None = None
    failures: int | None = None
    trouble: str | None = None
    last_queued: str | None = None
    base: str | None = None
    handin: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class OutboxEntry:
    """A hand-in that the robot keeps."""

    id: str  # of its manifest
    place: int
    manifest: bytes
    state: str
    size_bytes: int
    revision: int | None
    error: str | None


class AgentState:
    """Facts, the outbox, parts that both sides have, and parts that have arrived.

    Args:
        path: the file; created if missing.

    Raises:
        StorageFullError: of this and every method that writes: no space is left.
        MapError: the file cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._errors = SqliteFile(path, _FILE).errors
        with self._errors():
            self._connection = sqlite3.connect(
                path, timeout=_FILE.busy_s, isolation_level=None, check_same_thread=False
            )
            self._connection.execute("PRAGMA journal_mode=WAL")
            self._connection.execute("PRAGMA synchronous=FULL")
            self._connection.executescript(_TABLES)

    def close(self) -> None:
        """Closes the file."""
        self._connection.close()

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        with self._errors():
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._commit()
            except BaseException:
                if self._connection.in_transaction:  # a full disk ends it by itself
                    self._connection.execute("ROLLBACK")
                raise

    def _commit(self) -> None:
        self._connection.execute("COMMIT")

    def _rows(self, query: str, *values: Any) -> list[Any]:
        with self._errors():
            return self._connection.execute(query, values).fetchall()

    @property
    def facts(self) -> AgentFacts:
        """The facts as of now: other processes of the robot change them, too."""
        rows = self._rows("SELECT name, value FROM facts")
        try:
            return msgspec.convert({name: json.loads(value) for name, value in rows}, AgentFacts)
        except ValueError as error:  # msgspec's, too
            raise MapError(f"{self._path} holds an invalid fact ({error}); {_FILE.cure}") from error

    def remember(self, **facts: Any) -> None:
        """Changes facts, by the names of `AgentFacts`: all or none."""
        rows = [(name, json.dumps(value)) for name, value in facts.items()]
        with self._writing() as connection:
            connection.executemany("INSERT OR REPLACE INTO facts VALUES (?, ?)", rows)

    # -- the outbox

    def queue(self, key: str, manifest: bytes, parts: dict[PartHash, bytes]) -> None:
        """Puts a hand-in into the outbox, with the parts that the centre may be missing."""
        with self._writing() as connection:
            (place,) = connection.execute(
                "SELECT coalesce(max(place), 0) + 1 FROM outbox"
            ).fetchone()
            size = len(manifest) + sum(map(len, parts.values()))
            added = connection.execute(
                "INSERT OR IGNORE INTO outbox VALUES (?, ?, ?, 'queued', ?, NULL, NULL)",
                [key, place, manifest, size],
            )
            if added.rowcount:
                connection.executemany(
                    "INSERT INTO waiting VALUES (?, ?, ?)",
                    [(key, part, body) for part, body in parts.items()],
                )

    def outbox(self) -> list[OutboxEntry]:
        """The hand-ins that are kept, oldest first."""
        return [OutboxEntry(*row) for row in self._rows("SELECT * FROM outbox ORDER BY place")]

    def set_outbox(self, key: str, state: str, revision: int | None, error: str | None) -> None:
        """Notes how far a hand-in is."""
        with self._writing() as connection:
            connection.execute(
                "UPDATE outbox SET state = ?, revision = ?, error = ? WHERE id = ?",
                [state, revision, error, key],
            )

    def forget_outbox(self, key: str) -> None:
        """Drops a hand-in that the centre has stored durably."""
        with self._writing() as connection:
            connection.execute("DELETE FROM waiting WHERE outbox = ?", [key])
            connection.execute("DELETE FROM outbox WHERE id = ?", [key])

    def waiting(self, key: str, part: PartHash) -> bytes | None:
        """A part of a hand-in in the outbox."""
        rows = self._rows("SELECT body FROM waiting WHERE outbox = ? AND hash = ?", key, part)
        return rows[0][0] if rows else None

    def waiting_hashes(self, key: str) -> list[PartHash]:
        """All parts of a hand-in in the outbox."""
        rows = self._rows("SELECT hash FROM waiting WHERE outbox = ?", key)
        return [PartHash(row[0]) for row in rows]

    # -- parts

    def share(self, parts: Iterable[PartHash]) -> None:
        """Notes parts that the centre has, from this robot or for it."""
        with self._writing() as connection:
            rows = [(part,) for part in parts]
            connection.executemany("INSERT OR IGNORE INTO shared VALUES (?)", rows)

    def shared(self) -> set[PartHash]:
        """Parts that the centre has."""
        return {PartHash(row[0]) for row in self._rows("SELECT hash FROM shared")}

    def arrive(self, parts: Collection[tuple[PartHash, bytes]]) -> None:
        """Keeps parts of a download that is not complete yet."""
        with self._writing() as connection:
            connection.executemany("INSERT OR IGNORE INTO arrived VALUES (?, ?)", parts)

    def arrived(self, part: PartHash) -> bytes | None:
        """A part that has arrived."""
        rows = self._rows("SELECT body FROM arrived WHERE hash = ?", part)
        return rows[0][0] if rows else None

    def arrived_hashes(self) -> set[PartHash]:
        """All parts that have arrived."""
        return {PartHash(row[0]) for row in self._rows("SELECT hash FROM arrived")}

    def clear_arrived(self) -> None:
        """Drops them: the download is complete."""
        with self._writing() as connection:
            connection.execute("DELETE FROM arrived")


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """Limits of the link and the disk, and what is downloaded.

    Attributes:
        download: options of ``engram download``, by the names of `DownloadOptions`.
    """

    download: dict[str, Any] = field(default_factory=dict)
    bytes_per_s: (
        Annotated[float, Meta(gt=0, description="bandwidth limit; none: no limit")] | None
    ) = None
    outbox_bytes: Annotated[
        int, Meta(ge=0, description="disk for hand-ins that the centre has not stored yet, bytes")
    ] = 10 * 2**30
    first_retry_s: Annotated[float, Meta(gt=0, description="wait after a failure, s")] = 2.0
    longest_retry_s: Annotated[
        float, Meta(gt=0, description="each wait is twice the one before, up to this, s")
    ] = 600.0
    idle_s: Annotated[float, Meta(gt=0, description="pause between rounds without work, s")] = 30.0
    judged_m: Annotated[
        float, Meta(ge=0, description="a new map is judged after driving this far, m")
    ] = 50.0
    least_share: Annotated[
        float,
        Meta(ge=0, le=1, description="share of frames localised below which the last map returns"),
    ] = 0.2

    def __post_init__(self) -> None:
        check_bounds(self)
