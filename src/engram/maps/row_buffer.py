"""Buffers rows of one revision in memory, to write them together."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table, delete, insert, select

from engram.graph.model import Edge
from engram.graph.paths import Attempts
from engram.maps.attempts import pack, unpack_drive, words_row, write_words
from engram.maps.rows import Row, edge_row, sealed, verified
from engram.maps.schema import (
    amendments,
    anchors,
    attempts,
    cameras,
    edges,
    forgotten,
    frames,
    frontends,
    goals,
    hidden,
    nodes,
    omissions,
    omitted_landmarks,
    path_entries,
    paths,
    placements,
    removals,
    sessions,
    statistics,
    vocabularies,
)
from engram.maps.sqlite import upsert
from engram.maps.totals import Own
from engram.maps.view import KeyBook

# Bytes of a row as Python objects, without its blobs.
_ROW_BYTES = 600
_ATTEMPT_BYTES = 64
# In the order of references, so that every batch of an abandoned revision refers only to rows
# that are written.
_TABLES = (
    cameras,
    frontends,
    sessions,
    nodes,
    frames,
    paths,
    path_entries,
    omissions,
    omitted_landmarks,
    statistics,
    vocabularies,
    amendments,
    removals,
    placements,
    anchors,
    goals,
    forgotten,
    hidden,
)


class RowBuffer:
    """Unwritten rows of a revision.

    Args:
        keys: gives the keys of the rows.
        revision_key: of the revision.

    Attributes:
        rows: by table, in order of writing, but for edges, words and attempts.
        written_attempts: number of attempts that the revision has already, by key of the session.
        scattered: keys of the sessions whose attempts several checkpoints wrote.
        size_bytes: approximate size of the buffer in memory.
    """

    def __init__(self, keys: KeyBook, revision_key: int) -> None:
        self._keys = keys
        self._revision_key = revision_key
        self._attempts: dict[int, list[Attempts]] = defaultdict(list)
        self.written_attempts: dict[int, int] = defaultdict(int)
        self.scattered: set[int] = set()
        self.clear()

    def clear(self) -> None:
        """Discards all rows, since they are written or unwanted."""
        self.rows: dict[Table, list[Row]] = {table: [] for table in _TABLES}
        self._edges: dict[tuple[int, int, str], Row] = {}
        self._words: dict[int, Row] = {}
        for session, tables in self._attempts.items():
            if self.written_attempts[session]:
                self.scattered.add(session)
            self.written_attempts[session] += sum(map(len, tables))
        self._attempts.clear()
        self.size_bytes = 0

    def new(self, table: Table, size_bytes: int = 0, **values: Any) -> int:
        """Adds a row of the revision; returns its key.

        Args:
            table: its table.
            size_bytes: size of its blobs.
            values: its columns except key, revision and checksum.
        """
        key = self._keys.next(table)
        self.put(table, {"key": key, "revision": self._revision_key, **values}, size_bytes)
        return key

    def put(self, table: Table, row: Row, size_bytes: int = 0) -> None:
        """Adds a row that is complete but for its checksum."""
        self.rows[table].append(sealed(table, row))
        self.size_bytes += _ROW_BYTES + size_bytes

    def put_edge(self, edge: Edge, a: int, b: int) -> None:
        """Adds an edge between nodes of these keys, replacing a buffered one of the same kind."""
        row = edge_row(edge, self._keys.next(edges), self._revision_key, a, b)
        self._edges.pop((a, b, row["kind"]), None)
        self._edges[a, b, row["kind"]] = sealed(edges, row)
        self.size_bytes += _ROW_BYTES

    def put_words(self, node: int, vocabulary: bytes, found: NDArray[np.int32]) -> None:
        """Adds the words (n,) of the node of this key, replacing buffered ones."""
        self._words[node] = words_row(node, vocabulary, found)
        self.size_bytes += _ROW_BYTES

    def put_attempts(self, session: int, made: Attempts) -> None:
        """Adds attempts of the session of this key."""
        self._attempts[session].append(made)
        self.size_bytes += _ATTEMPT_BYTES * len(made)

    def write(self, connection: Connection) -> None:
        """Writes all rows without discarding them, since the transaction may still fail."""
        for table, rows in self.rows.items():
            if rows:
                connection.execute(insert(table), rows)
        if self._edges:
            key = ("a", "b", "kind", "revision")
            connection.execute(upsert(edges, key), list(self._edges.values()))
        write_words(connection, list(self._words.values()))
        for session, tables in self._attempts.items():
            first = self.written_attempts[session]
            self._write_attempts(connection, session, Attempts.joined(tables), first)

    def repack_attempts(self, connection: Connection, own: Own) -> None:
        """Packs attempts of all checkpoints together, so that the file does not depend on them."""
        if not self.scattered:
            return
        written = own.rows(attempts) & attempts.c.session.in_(self.scattered)
        found = connection.execute(select(attempts).where(written).order_by(attempts.c.key))
        bodies: dict[int, list[Row]] = defaultdict(list)
        for row in verified(attempts, found):
            bodies[row["session"]].append(row)
        connection.execute(delete(attempts).where(written))
        for session, rows in bodies.items():
            self._write_attempts(connection, session, unpack_drive(rows), 0)

    def _write_attempts(
        self, connection: Connection, session: int, made: Attempts, first: int
    ) -> None:
        rows = []
        for packed in pack(made, first):
            row = {"key": self._keys.next(attempts), "revision": self._revision_key}
            rows.append(sealed(attempts, {**row, "session": session, **packed}))
        connection.execute(insert(attempts), rows)
