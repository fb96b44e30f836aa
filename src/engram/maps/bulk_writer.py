"""One revision that brings records of many sessions at once: what a merge or a download writes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table, insert

from engram.errors import IncompatibleError, InputError, RevisionError
from engram.frontend import DescriptorKind, Frame
from engram.frontend.blobs import content_digest
from engram.geometry import StereoCamera
from engram.graph.attempts import Attempts
from engram.graph.model import (
    Edge,
    NodeId,
    Omission,
    PathEntry,
    PathId,
    Session,
    SessionId,
    path_id,
)
from engram.maps import reading
from engram.maps.attempt_rows import write_attempts
from engram.maps.attempts import COLUMNS, AttemptTable
from engram.maps.committing import commit_revision, revision_contents
from engram.maps.database import Database
from engram.maps.edge_checks import check_edge
from engram.maps.frame_reader import FrameReader
from engram.maps.hiding import check_same_node, check_same_session, hidden_row, hidden_rows
from engram.maps.keys import KeyBook
from engram.maps.records import Revision, RevisionStatus, StoredNode
from engram.maps.rows import (
    Row,
    checked_int,
    checked_text,
    edge_row,
    sealed,
    session_row,
    to_json,
    transform_bytes,
)
from engram.maps.schema import (
    edges,
    frames,
    hidden,
    nodes,
    omissions,
    omitted_landmarks,
    path_entries,
    paths,
    sessions,
    statistics,
    vocabularies,
)
from engram.maps.session_states import open_sessions
from engram.maps.view import View

# What waits in memory before it is written in one transaction.
_BATCH_BYTES = 8 * 2**20
# Beside the blob: a row as Python objects.
_ROW_BYTES = 600


class BulkWriter:
    """Adds records of any sessions to a map, in one revision that appears whole or not at all.

    Made by `Map.begin_revision`. Use it as a context manager: leaving it without
    `commit` abandons it. Rows are written in bounded batches, so memory does not grow with the
    revision. They lie in a revision that is born *abandoned* and becomes committed in one small
    transaction: killed at any moment before, the map is as it was, no session is left to resume
    or seal, and the rows are collected by the next writer or by ``check --clean``.

    Sessions come before their nodes, nodes before what refers to them (edges, path entries,
    attempts, omissions). What the map has hidden, since it was reverted, is shown again when it is
    handed in again. Not thread-safe; the map's `frames` can read a node as soon as it was added.
    """

    def __init__(
        self,
        database: Database,
        keys: KeyBook,
        frame_reader: FrameReader,
        *,
        revision_key: int,
        view: View,
        on_cameras: Callable[[], None],
        on_end: Callable[[], None],
        committed_ns: int | None = None,
    ) -> None:
        self._database = database
        self._keys = keys
        self._frames = frame_reader
        self._revision_key = revision_key
        self._view = view
        self._on_cameras = on_cameras
        self._on_end = on_end
        self._committed_ns = committed_ns
        self._ended = False
        with database.reading() as connection:
            self._descriptor = reading.descriptor_of(connection, view)
            self._frontend_keys = {
                content: key for key, content in reading.load_frontends(connection).items()
            }
            self._camera_keys = {
                camera.id: key for key, camera in reading.load_cameras(connection).items()
            }
            self._session_keys = _keys_of(connection, view, sessions)
            self._path_keys = _keys_of(connection, view, paths)
            self._hidden = {
                table: hidden_rows(connection, view, table) for table in (sessions, nodes, paths)
            }
            self._interrupted = open_sessions(connection)
        self._sequences: dict[int, set[int]] = {}
        self._omitted: set[bytes] = set()
        self._shows_again = False
        self._clear()

    # -- what may be added

    def add_session(
        self,
        session: Session,
        camera: StereoCamera,
        *,
        descriptor: DescriptorKind,
        frontend: str,
        partial: bool = False,
    ) -> bool:
        """Add a drive with its path; one that the map has already changes nothing.

        Args:
            session: the drive.
            camera: the session's camera.
            descriptor: kind of its descriptors.
            frontend: hash of its front-end.
            partial: whether some of its path's entries stay elsewhere.

        Returns:
            Whether it was new.

        Raises:
            IncompatibleError: the map's frames have another kind of descriptor.
            InputError: the camera is not the session's.
            RevisionError: the map holds what an interrupted run of the session had saved.
        """
        self._check_open()
        if session.camera != camera.id:
            raise InputError(f"session {session.id} has camera {session.camera}, not {camera.id}")
        if session.id.bytes in self._session_keys:
            return False
        if session.id.bytes in self._interrupted:
            raise RevisionError(
                f"session {session.id} was interrupted in this map; resume it or seal what is "
                "there first"
            )
        if self._descriptor not in {None, descriptor}:
            raise IncompatibleError(
                f"the map holds {self._descriptor} descriptors, session {session.id} {descriptor}; "
                "the two cannot be matched"
            )
        self._descriptor = descriptor
        camera_key, frontend_key = self._ensure(camera, descriptor, frontend)
        again = self._hidden[sessions].get(session.id.bytes)
        if again is not None:
            check_same_session(again, session, camera_key, frontend_key)
        key = self._shown_again(sessions, session.id.bytes)
        if key is None:
            key = self._keys.next(sessions)
            row = session_row(session, key, self._revision_key, camera_key, frontend_key)
            self._put(sessions, row)
        self._session_keys[session.id.bytes] = key
        self._add_path(path_id(session.id), key, partial)
        return True

    def add_node(self, stored: StoredNode, frame: Frame | None = None) -> None:
        """Add a node, its landmarks copied byte for byte.

        Args:
            stored: from another map's `frames.stored`.
            frame: its frame, if it was decoded anyway: read from memory until it is written.

        Raises:
            InputError: its session has not been added, the map has the node already, or had it
                with other landmarks.
        """
        self._check_open()
        node = stored.node
        session_key = self._session_keys.get(node.session.bytes)
        if session_key is None:
            raise InputError(f"node {node.id}: its session {node.session} is not in the map")
        if self._keys.find_node(node.id) is not None:
            raise InputError(f"node {node.id} is in the map already; a node is saved once")
        again = self._hidden[nodes].get(node.id.bytes)
        if again is not None:
            check_same_node(again, node, stored.landmark_hash)
        key = self._shown_again(nodes, node.id.bytes)
        if key is None:
            key = self._insert_node(stored, session_key)
        self._keys.learn_node(node.id, key)
        if frame is not None:
            self._frames.hold(node.id, frame)
            self._held.append(node.id)

    def add_edge(self, edge: Edge) -> None:
        """Add an edge; it takes the place of an older one with the same (a, b, kind).

        Raises:
            InputError: an end is not in the map, both are the same, or a number is not finite.
        """
        self._check_open()
        check_edge(edge)
        a, b = self._node_key(edge.a, "edge"), self._node_key(edge.b, "edge")
        row = edge_row(edge, self._keys.next(edges), self._revision_key, a, b)
        self._edges.pop((a, b, row["kind"]), None)
        self._edges[a, b, row["kind"]] = sealed(edges, row)
        self._grow(_ROW_BYTES)

    def add_path_entry(self, entry: PathEntry) -> None:
        """Add a step of any session's path, in any order.

        Raises:
            InputError: the path or the node is not in the map, or the path has an entry of this
                sequence number.
        """
        self._check_open()
        path_key = self._path_keys.get(entry.path.bytes)
        if path_key is None:
            raise InputError(f"path {entry.path} is not in the map; add its session first")
        node_key = self._node_key(entry.node, "path entry")
        taken = self._sequences_of(path_key)
        if entry.sequence in taken:
            raise InputError(f"path {entry.path} has an entry {entry.sequence} already")
        taken.add(entry.sequence)
        row = {
            "key": self._keys.next(path_entries),
            "revision": self._revision_key,
            "path": path_key,
            "sequence": checked_int(entry.sequence, "sequence"),
            "node": node_key,
            "kind": str(entry.kind),
            "stamp_ns": checked_int(entry.stamp_ns, "stamp_ns"),
        }
        self._put(path_entries, row)

    def add_attempts(self, session: SessionId, made: Attempts, node_ids: Sequence[NodeId]) -> None:
        """Remember attempts of one session, in the order of their iterations.

        Args:
            session: whose they are.
            made: the attempts; their column `session` is of no account.
            node_ids: what their `reference` and `node` are indices into.

        Raises:
            InputError: the session or a node is not in the map.
        """
        self._check_open()
        session_key = self._session_keys.get(session.bytes)
        if session_key is None:
            raise InputError(f"attempts of session {session}, which is not in the map")
        if not len(made):
            return
        columns: dict[str, NDArray[np.generic]] = {
            name: np.asarray(
                self._node_keys(getattr(made, name), node_ids)
                if name in {"reference", "node"}
                else getattr(made, name),
                kind,
            )
            for name, kind in COLUMNS
        }
        self._attempts.append((session_key, AttemptTable(columns, made.policy, made.policies)))
        self._grow(64 * len(made))

    def add_omission(self, omission: Omission) -> None:
        """Remember that a node was not taken, and for which.

        Raises:
            InputError: the equivalent is not in the map, or the omitted node is remembered already.
        """
        self._check_open()
        node_key = self._node_key(omission.node, "omission")
        if omission.omitted.bytes in self._omitted:
            raise InputError(f"node {omission.omitted} is omitted twice")
        self._omitted.add(omission.omitted.bytes)
        row = {
            "key": self._keys.next(omissions),
            "uuid": omission.omitted.bytes,
            "revision": self._revision_key,
            "node": node_key,
            "node_from_omitted": transform_bytes(omission.node_from_omitted),
        }
        self._put(omissions, row)
        if omission.landmark_hash is not None:
            row = {
                "key": self._keys.next(omitted_landmarks),
                "uuid": omission.omitted.bytes,
                "revision": self._revision_key,
                "landmark_hash": omission.landmark_hash,
            }
            self._put(omitted_landmarks, row)

    def put_statistics(self, name: str, values: Mapping[str, Any]) -> None:
        """Keep a statistic of the map under a name; the newest counts. Once for each name.

        Raises:
            InputError: the values are no plain JSON data.
        """
        self._check_open()
        row = {
            "key": self._keys.next(statistics),
            "revision": self._revision_key,
            "name": checked_text(name, "name of the statistic"),
            "body": to_json(values),
        }
        self._put(statistics, row)

    def put_vocabulary(self, body: bytes) -> None:
        """Keep a vocabulary, encoded; the newest counts."""
        self._check_open()
        row = {
            "key": self._keys.next(vocabularies),
            "revision": self._revision_key,
            "hash": content_digest(body),
            "body": body,
        }
        self._put(vocabularies, row, len(body))

    @property
    def shows_again(self) -> bool:
        """Whether anything that a revert had hidden is seen again by this revision."""
        return self._shows_again

    # -- how it ends

    def flush(self) -> None:
        """Write what waits; nobody else sees it before `commit`. Called by itself when it is due.

        Raises:
            StorageFullError: no space; this may be tried again, or the revision abandoned.
        """
        self._check_open()
        with self._database.writing() as connection:
            self._write(connection)
        self._frames.show(self._rows[hidden])
        self._frames.release(self._held)
        self._clear()

    def commit(self) -> Revision:
        """Make all of it part of the map.

        Raises:
            StorageFullError: as `flush`.
        """
        self.flush()
        with self._database.reading() as connection:
            contents = revision_contents(connection, self._revision_key)
        with self._database.writing() as connection:
            revision = commit_revision(
                connection,
                self._revision_key,
                was=RevisionStatus.ABANDONED,
                contents=contents,
                committed_ns=self._committed_ns,
            )
        self._end()
        return revision

    def abandon(self) -> None:
        """Give the revision up: the map is as it was. Without effect once it is over."""
        if self._ended:
            return
        self._clear()
        self._keys.forget_nodes()
        self._frames.forget()
        self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.abandon()

    # -- inside

    def _end(self) -> None:
        self._ended = True
        self._on_end()

    def _check_open(self) -> None:
        if self._ended:
            raise RevisionError("this revision is committed or abandoned already")

    def _clear(self) -> None:
        # In the order in which rows refer to each other, so that a reader between two batches of
        # an abandoned revision never meets a reference to what is not there.
        self._rows: dict[Table, list[Row]] = {
            table: []
            for table in (
                sessions,
                nodes,
                frames,
                paths,
                path_entries,
                omissions,
                omitted_landmarks,
                statistics,
                vocabularies,
                hidden,
            )
        }
        self._edges: dict[tuple[int, int, str], Row] = {}
        self._attempts: list[tuple[int, AttemptTable]] = []
        self._held: list[NodeId] = []
        self._waiting_bytes = 0

    def _put(self, table: Table, row: Row, size_bytes: int = 0) -> None:
        self._rows[table].append(sealed(table, row))
        self._grow(_ROW_BYTES + size_bytes)

    def _grow(self, size_bytes: int) -> None:
        self._waiting_bytes += size_bytes
        if self._waiting_bytes > _BATCH_BYTES:
            self.flush()

    def _write(self, connection: Connection) -> None:
        for table, rows in self._rows.items():
            if rows:
                connection.execute(insert(table), rows)
        if self._edges:
            key = ("a", "b", "kind", "revision")
            connection.execute(self._database.replace(edges, key), list(self._edges.values()))
        for session_key, made in self._attempts:
            write_attempts(connection, self._keys, self._revision_key, session_key, made)

    def _ensure(
        self, camera: StereoCamera, descriptor: DescriptorKind, frontend: str
    ) -> tuple[int, int]:
        """Keys of camera and front-end, which are no part of any revision."""
        content = (descriptor, frontend)
        if camera.id not in self._camera_keys or content not in self._frontend_keys:
            with self._database.writing() as connection:
                self._camera_keys[camera.id] = self._keys.ensure_camera(connection, camera)
                self._frontend_keys[content] = self._keys.ensure_frontend(connection, *content)
            self._on_cameras()
        return self._camera_keys[camera.id], self._frontend_keys[content]

    def _add_path(self, path: PathId, session_key: int, partial: bool) -> None:
        key = self._shown_again(paths, path.bytes)
        if key is None:
            key = self._keys.next(paths)
            row = {
                "key": key,
                "uuid": path.bytes,
                "revision": self._revision_key,
                "session": session_key,
                "partial": int(partial),
            }
            self._put(paths, row)
        self._path_keys[path.bytes] = key

    def _insert_node(self, stored: StoredNode, session_key: int) -> int:
        node = stored.node
        content = (stored.descriptor, stored.frontend)
        if node.camera not in self._camera_keys or content not in self._frontend_keys:
            raise InputError(f"node {node.id} is of another camera or front-end than its session")
        key = self._keys.next(nodes)
        row = {
            "key": key,
            "uuid": node.id.bytes,
            "revision": self._revision_key,
            "session": session_key,
            "camera": self._camera_keys[node.camera],
            "frontend": self._frontend_keys[content],
            "stamp_ns": checked_int(node.stamp_ns, "stamp_ns"),
            "driven_m": float(node.driven_m),
            "status": str(stored.status),
            "landmark_hash": stored.landmark_hash,
        }
        frame_row = {
            "node": key,
            "revision": self._revision_key,
            "landmarks": stored.landmarks,
            "thumbnail": stored.thumbnail,
        }
        self._rows[nodes].append(sealed(nodes, row))
        self._put(frames, frame_row, len(stored.landmarks) + len(stored.thumbnail or b""))
        return key

    def _node_key(self, node: NodeId, what: str) -> int:
        key = self._keys.find_node(node)
        if key is None:
            raise InputError(f"{what}: node {node} is not in the map; add it first")
        return key

    def _node_keys(
        self, indices: NDArray[np.int32], node_ids: Sequence[NodeId]
    ) -> NDArray[np.int64]:
        used, inverse = np.unique(indices, return_inverse=True)
        keys = [self._node_key(node_ids[int(index)], "attempt") for index in used]
        return np.array(keys, np.int64)[inverse]

    def _sequences_of(self, path_key: int) -> set[int]:
        """Sequence numbers of the entries of a path that are seen."""
        if path_key not in self._sequences:
            query = (
                self._view.select(path_entries)
                .with_only_columns(path_entries.c.sequence)
                .where(path_entries.c.path == path_key)
            )
            with self._database.reading() as connection:
                self._sequences[path_key] = set(connection.execute(query).scalars())
        return self._sequences[path_key]

    def _shown_again(self, table: Table, uuid: bytes) -> int | None:
        """Key of a row that was hidden and is shown from this revision on; None without one."""
        again = self._hidden[table].pop(uuid, None)
        if again is None:
            return None
        self._show(table, again["key"])
        return int(again["key"])

    def _show(self, table: Table, key: int) -> None:
        self._shows_again = True
        row = hidden_row(self._keys, self._revision_key, table, key, hide=False)
        self._put(hidden, row)


def _keys_of(connection: Connection, view: View, table: Table) -> dict[bytes, int]:
    """Keys of the rows that are seen, by UUID."""
    query = view.select(table).with_only_columns(table.c.uuid, table.c.key)
    return {row[0]: row[1] for row in connection.execute(query)}
