"""What an agent remembers: one SQLite file, so that a kill leaves it before or after a step."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from engram.transfers import PartHash

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


class AgentState:
    """Facts, the outbox, parts that both sides have, and parts that have arrived.

    Args:
        path: the file; made where there is none.
    """

    def __init__(self, path: Path) -> None:
        self._connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        self._connection.execute("PRAGMA journal_mode=WAL")
        self._connection.execute("PRAGMA synchronous=FULL")
        self._connection.executescript(_TABLES)

    def close(self) -> None:
        """Closes the file."""
        self._connection.close()

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield self._connection
        except BaseException:
            self._connection.execute("ROLLBACK")
            raise
        self._commit()

    def _commit(self) -> None:
        self._connection.execute("COMMIT")

    def fact(self, name: str, default: Any = None) -> Any:
        """A remembered value; plain data."""
        row = self._connection.execute("SELECT value FROM facts WHERE name = ?", [name]).fetchone()
        return default if row is None else json.loads(row[0])

    def remember(self, **facts: Any) -> None:
        """Remembers values, all or none."""
        with self._writing() as connection:
            rows = [(name, json.dumps(value)) for name, value in facts.items()]
            connection.executemany("INSERT OR REPLACE INTO facts VALUES (?, ?)", rows)

    # -- the outbox

    def queue(self, key: str, manifest: bytes, parts: dict[PartHash, bytes]) -> None:
        """Puts a hand-in into the outbox, with what the centre may lack of it."""
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
                    [(key, one, body) for one, body in parts.items()],
                )

    def outbox(self) -> list[dict[str, Any]]:
        """The hand-ins that are kept, oldest first."""
        names = ("id", "place", "manifest", "state", "bytes", "revision", "error")
        rows = self._connection.execute("SELECT * FROM outbox ORDER BY place").fetchall()
        return [dict(zip(names, row, strict=True)) for row in rows]

    def set_outbox(self, key: str, state: str, revision: int | None, error: str | None) -> None:
        """Notes how far a hand-in is."""
        with self._writing() as connection:
            connection.execute(
                "UPDATE outbox SET state = ?, revision = ?, error = ? WHERE id = ?",
                [state, revision, error, key],
            )

    def forget_outbox(self, key: str) -> None:
        """Drops a hand-in that the centre keeps for good."""
        with self._writing() as connection:
            connection.execute("DELETE FROM waiting WHERE outbox = ?", [key])
            connection.execute("DELETE FROM outbox WHERE id = ?", [key])

    def waiting(self, key: str, part: PartHash) -> bytes | None:
        """A part of a hand-in in the outbox."""
        row = self._connection.execute(
            "SELECT body FROM waiting WHERE outbox = ? AND hash = ?", [key, part]
        ).fetchone()
        return None if row is None else row[0]

    def waiting_hashes(self, key: str) -> list[PartHash]:
        """All parts of a hand-in in the outbox."""
        rows = self._connection.execute("SELECT hash FROM waiting WHERE outbox = ?", [key])
        return [PartHash(row[0]) for row in rows]

    # -- parts

    def share(self, parts: Iterable[PartHash]) -> None:
        """Notes parts that the centre has, from this robot or for it."""
        with self._writing() as connection:
            rows = [(one,) for one in parts]
            connection.executemany("INSERT OR IGNORE INTO shared VALUES (?)", rows)

    def shared(self) -> set[PartHash]:
        """Parts that the centre has."""
        return {PartHash(row[0]) for row in self._connection.execute("SELECT hash FROM shared")}

    def arrive(self, parts: Collection[tuple[PartHash, bytes]]) -> None:
        """Keeps parts of a download that is not complete yet."""
        with self._writing() as connection:
            connection.executemany("INSERT OR IGNORE INTO arrived VALUES (?, ?)", parts)

    def arrived(self, part: PartHash) -> bytes | None:
        """A part that has arrived."""
        row = self._connection.execute("SELECT body FROM arrived WHERE hash = ?", [part]).fetchone()
        return None if row is None else row[0]

    def arrived_hashes(self) -> set[PartHash]:
        """All parts that have arrived."""
        return {PartHash(row[0]) for row in self._connection.execute("SELECT hash FROM arrived")}

    def clear_arrived(self) -> None:
        """Drops them: the download is complete."""
        with self._writing() as connection:
            connection.execute("DELETE FROM arrived")
