"""One session on its way into a map: buffered, checkpointed, then committed in one small step."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table, insert

from engram.errors import IncompatibleError, InputError, RevisionError
from engram.frontend import DescriptorKind, Frame
from engram.frontend.blobs import blob_hash, encode_landmarks, encode_thumbnail
from engram.graph.model import (
    Attempt,
    Edge,
    Node,
    NodeId,
    PathEntry,
    PathId,
    Session,
    path_id,
)
from engram.maps.attempt_rows import attempt_table, repack_attempts, write_attempts
from engram.maps.attempts import AttemptTable, concatenate
from engram.maps.committing import change_revision, commit_revision
from engram.maps.database import Database
from engram.maps.edge_checks import check_edge
from engram.maps.frame_reader import FrameReader
from engram.maps.hiding import check_same_node, hidden_row
from engram.maps.keys import KeyBook
from engram.maps.records import Revision, StoredSession
from engram.maps.rows import (
    Row,
    checked_int,
    checked_text,
    edge_row,
    sealed,
    to_json,
)
from engram.maps.schema import edges, frames, hidden, nodes, path_entries, statistics
from engram.maps.words import words_row, write_words


class SessionWriter:
    """Adds one session to a map. Thread-safe; made by `Map.begin_session` or `resume_session`.

    What is added waits in memory until `checkpoint`, which makes it durable in one transaction;
    readers see it after `commit`. A checkpoint that fails (disk full) leaves the last one intact
    and keeps what waits, so that it can be tried again.

    Attributes:
        session: the drive that is written.
        path: its path.
        stored: what had been checkpointed when this writer was made; empty for a new session.
    """

    def __init__(
        self,
        database: Database,
        keys: KeyBook,
        frame_reader: FrameReader,
        *,
        session: Session,
        revision_key: int,
        session_key: int,
        path_key: int,
        camera_key: int,
        frontend: tuple[int, DescriptorKind, str],
        stored: StoredSession,
        hidden_nodes: Mapping[bytes, Row],
        on_end: Callable[[], None],
    ) -> None:
        self.session = session
        self.path: PathId = path_id(session.id)
        self.stored = stored
        self._database = database
        self._keys = keys
        self._frames = frame_reader
        self._revision_key = revision_key
        self._session_key = session_key
        self._path_key = path_key
        self._camera_key = camera_key
        self._frontend_key, self._descriptor, self._frontend = frontend
        self._next_sequence = stored.next_sequence
        self._hidden_nodes = hidden_nodes
        self._on_end = on_end
        self._ended = False
        self._lock = threading.RLock()
        self._clear()

    def add_node(self, node: Node, frame: Frame) -> None:
        """Save a frame as a node. Its frame can be read at once through the map's `frames`.

        Raises:
            InputError: node and frame do not belong together or to this session, the node is in
                the map already, or the landmarks cannot be stored without loss.
            IncompatibleError: the frame comes from another front-end than the session's.
        """
        self._check_node(node, frame)
        landmarks = encode_landmarks(frame.landmarks, frame.camera)
        thumbnail = None if frame.thumbnail is None else encode_thumbnail(frame.thumbnail)
        with self._lock:
            self._check_open()
            if self._keys.find_node(node.id) is not None:
                raise InputError(f"node {node.id} is in the map already; a node is saved once")
            again = self._hidden_nodes.get(node.id.bytes)
            if again is not None:
                check_same_node(again, node, blob_hash(landmarks))
                self._show_again(node, frame, again["key"])
                return
            key = self._keys.next(nodes)
            row = {
                "key": key,
                "uuid": node.id.bytes,
                "revision": self._revision_key,
                "session": self._session_key,
                "camera": self._camera_key,
                "frontend": self._frontend_key,
                "stamp_ns": checked_int(node.stamp_ns, "stamp_ns"),
                "driven_m": float(node.driven_m),
                "status": str(frame.status),
                "landmark_hash": blob_hash(landmarks),
            }
            frame_row = {
                "node": key,
                "revision": self._revision_key,
                "landmarks": landmarks,
                "thumbnail": thumbnail,
            }
            self._rows[nodes].append(sealed(nodes, row))
            self._rows[frames].append(sealed(frames, frame_row))
            self._expect(node, frame, key)

    def add_words(self, node: NodeId, vocabulary: bytes, found: NDArray[np.int32]) -> None:
        """Keep the words of a node by the vocabulary of this hash (16 bytes).

        Args:
            node: a node of the map.
            vocabulary: the vocabulary's hash.
            found: (n,) the distinct words that the node shows, rising.

        Raises:
            InputError: the node is not in the map, or the words do not rise.
        """
        with self._lock:
            self._check_open()
            key = self._node_key(node, "words")
            self._words[key] = words_row(key, vocabulary, found)

    def add_edge(self, edge: Edge) -> None:
        """Add an edge; it takes the place of an older one with the same (a, b, kind).

        Raises:
            InputError: an end is not in the map, both are the same, or a number is not finite.
        """
        check_edge(edge)
        with self._lock:
            self._check_open()
            a, b = self._node_key(edge.a, "edge"), self._node_key(edge.b, "edge")
            row = edge_row(edge, self._keys.next(edges), self._revision_key, a, b)
            self._edges.pop((a, b, row["kind"]), None)
            self._edges[a, b, row["kind"]] = sealed(edges, row)

    def add_path_entry(self, entry: PathEntry) -> None:
        """Add the next step of the session's path.

        Raises:
            InputError: another session's path, a sequence number that is not above all before, or
                a node that is not in the map.
        """
        with self._lock:
            self._check_open()
            if entry.path != self.path:
                raise InputError(f"path {entry.path} is not {self.path}, the path of this session")
            if entry.sequence < self._next_sequence:
                raise InputError(
                    f"path entry {entry.sequence} comes after {self._next_sequence - 1}; sequence "
                    "numbers must increase"
                )
            row = {
                "key": self._keys.next(path_entries),
                "revision": self._revision_key,
                "path": self._path_key,
                "sequence": checked_int(entry.sequence, "sequence"),
                "node": self._node_key(entry.node, "path entry"),
                "kind": str(entry.kind),
                "stamp_ns": checked_int(entry.stamp_ns, "stamp_ns"),
            }
            self._rows[path_entries].append(sealed(path_entries, row))
            self._next_sequence = entry.sequence + 1

    def add_attempts(self, made: list[Attempt]) -> None:
        """Remember match attempts (SPEC §3.5), rounded to 18 bytes each.

        Offsets and headings keep 11 bits, standard deviations are right to 3 %, ranks end at 255.

        Raises:
            InputError: a node is not in the map.
        """
        with self._lock:
            self._check_open()
            keys = [
                (self._node_key(one.reference, "attempt"), self._node_key(one.node, "attempt"))
                for one in made
            ]
            if made:
                self._attempts.append(attempt_table(made, keys))

    def put_statistics(self, name: str, values: Mapping[str, Any]) -> None:
        """Keep a statistic of the map under a name; the newest counts.

        Raises:
            InputError: the values are no plain JSON data.
        """
        body = to_json(values)
        with self._lock:
            self._check_open()
            row = {
                "key": self._keys.next(statistics),
                "revision": self._revision_key,
                "name": checked_text(name, "name of the statistic"),
                "body": body,
            }
            self._statistics[name] = sealed(statistics, row)

    def checkpoint(self) -> None:
        """Make all that was added durable, in one transaction. Readers see it after `commit`.

        Raises:
            StorageFullError: no space; the last checkpoint is intact, and this may be tried again.
        """
        with self._lock:
            self._check_open()
            if not self._waiting():
                return
            with self._database.writing() as connection:
                self._write(connection)
            self._frames.show(self._rows[hidden])
            self._frames.release(self._saved)
            self._clear()

    def commit(self) -> Revision:
        """Make the session part of the map: a last checkpoint, then the revision's status.

        Raises:
            StorageFullError: as `checkpoint`; the session stays open.
        """
        with self._lock:
            self.checkpoint()
            with self._database.writing() as connection:
                repack_attempts(connection, self._keys, self._revision_key)
                revision = commit_revision(connection, self._revision_key)
            self._end()
            return revision

    def abandon(self) -> None:
        """Give the session up. Its rows stay invisible until `check(clean=True)` collects them."""
        with self._lock:
            self._check_open()
            with self._database.writing() as connection:
                change_revision(connection, self._revision_key, status="abandoned")
            self._clear()
            self._keys.forget_nodes()
            self._frames.forget()
            self._end()

    def _show_again(self, node: Node, frame: Frame, key: int) -> None:
        """A node that a revert has hidden comes back with its old row."""
        self._rows[hidden].append(
            hidden_row(self._keys, self._revision_key, nodes, key, hide=False)
        )
        self._expect(node, frame, key)

    def _expect(self, node: Node, frame: Frame, key: int) -> None:
        """From now on the node is known, and its frame is read from memory."""
        self._keys.learn_node(node.id, key)
        self._frames.hold(node.id, frame)
        self._saved.append(node.id)

    def _end(self) -> None:
        self._ended = True
        self._on_end()

    def _check_open(self) -> None:
        if self._ended:
            raise RevisionError(f"session {self.session.id} is committed or abandoned already")

    def _check_node(self, node: Node, frame: Frame) -> None:
        if node.session != self.session.id:
            raise InputError(f"node {node.id} is of session {node.session}, not {self.session.id}")
        if (node.stamp_ns, node.camera) != (frame.stamp_ns, frame.camera.id):
            raise InputError(
                f"node {node.id} (stamp {node.stamp_ns}, camera {node.camera}) does not fit its "
                f"frame (stamp {frame.stamp_ns}, camera {frame.camera.id})"
            )
        if not np.isfinite(node.driven_m):
            raise InputError(f"node {node.id}: driven_m is {node.driven_m}, must be finite")
        if frame.camera.id != self.session.camera:
            raise InputError(
                f"node {node.id} is of camera {frame.camera.id}, its session of "
                f"{self.session.camera}; a recalibrated robot begins another session"
            )
        if (frame.descriptor, frame.frontend) != (self._descriptor, self._frontend):
            raise IncompatibleError(
                f"node {node.id} comes from front-end {frame.frontend} ({frame.descriptor}), its "
                f"session from {self._frontend} ({self._descriptor}); begin another session"
            )

    def _node_key(self, node: NodeId, what: str) -> int:
        key = self._keys.find_node(node)
        if key is None:
            raise InputError(f"{what}: node {node} is not in the map; add it first")
        return key

    def _waiting(self) -> bool:
        others = (self._edges, self._attempts, self._statistics, self._words)
        return any(self._rows.values()) or any(map(len, others))

    def _clear(self) -> None:
        self._rows: dict[Table, list[Row]] = {
            nodes: [],
            frames: [],
            path_entries: [],
            hidden: [],
        }
        self._edges: dict[tuple[int, int, str], Row] = {}
        self._statistics: dict[str, Row] = {}
        self._words: dict[int, Row] = {}
        self._attempts: list[AttemptTable] = []
        self._saved: list[NodeId] = []

    def _write(self, connection: Connection) -> None:
        for table, rows in self._rows.items():
            if rows:
                connection.execute(insert(table), rows)
        if self._edges:
            key = ("a", "b", "kind", "revision")
            connection.execute(self._database.replace(edges, key), list(self._edges.values()))
        if self._statistics:
            statement = self._database.replace(statistics, ("name", "revision"))
            connection.execute(statement, list(self._statistics.values()))
        write_words(connection, self._database, list(self._words.values()))
        if self._attempts:
            made = concatenate(self._attempts)
            write_attempts(connection, self._keys, self._revision_key, self._session_key, made)
