"""Writes one revision of a map: buffers, checkpoints, then commits in one small step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table

from engram.errors import IncompatibleError, InputError, RevisionError
from engram.frontend.blobs import blob_hash, content_digest, encode_landmarks, encode_thumbnail
from engram.frontend.frame import DescriptorKind, Frame
from engram.geometry.cameras import StereoCamera
from engram.graph.model import (
    Amendment,
    Attempt,
    Edge,
    Mark,
    Node,
    NodeId,
    Omission,
    PathEntry,
    PathId,
    Session,
    SessionId,
    path_id,
)
from engram.graph.paths import Attempts
from engram.graph.placing import DEFAULT_CONFIG as PLACING
from engram.graph.placing import PlacingConfig
from engram.maps import reading
from engram.maps.columns import Visible
from engram.maps.forgetting import Chosen, forgotten_of, hide_chosen
from engram.maps.frame_reader import FrameReader
from engram.maps.hiding import check_same_node, check_same_session, hidden_row, hidden_rows
from engram.maps.marks import mark_row
from engram.maps.records import Revision, RevisionStatus, StoredNode, StoredSession
from engram.maps.references import References
from engram.maps.revisions import (
    brought,
    change_revision,
    changes_layout,
    commit_revision,
    open_sessions,
    revision_row,
    with_rows,
)
from engram.maps.row_buffer import RowBuffer
from engram.maps.rows import check_edge, checked_int, session_row, to_json, transform_bytes
from engram.maps.schema import (
    amendments,
    cameras,
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
    sessions,
    statistics,
    vocabularies,
)
from engram.maps.sqlite import SqliteDatabase
from engram.maps.totals import Own, own_rows
from engram.maps.view import KeyBook, View

# Most bytes in memory of a revision that is not resumable.
_BATCH_BYTES = 8 * 2**20
_FORGETS = "SELECT EXISTS (SELECT 1 FROM forgotten)"


@dataclass(frozen=True, slots=True)
class Resumable:
    """The drive of a resumable revision.

    Attributes:
        session: the drive.
        stored: its checkpointed part; None for a new revision.
    """

    session: Session
    stored: StoredSession | None = None


class RevisionWriter:
    """Adds records to a map, in one atomic revision.

    Made by `begin_session`, `resume_session` and `begin_revision` of `Map`. Records are buffered
    until `checkpoint` writes them; readers see them after `commit`. Add sessions before their
    nodes, and nodes before records that refer to them. Adding a record that a revert has hidden
    shows it again.

    The revision of a drive that is being mapped is *resumable*: killed, or left without `commit`,
    it keeps its checkpoints, to be resumed or sealed. Any other (a merge or a download) is then
    lost, and the next writer or ``check --clean`` collects its rows; it checkpoints itself before
    the buffer exceeds 8 MiB.

    One thread at a time may write. The map's `frames` can read a node from any thread as soon as
    it is added.

    Args:
        database, keys, frame_reader: the map's.
        view: the newest revision and this one, which has the state abandoned until a checkpoint.
        on_end: called after commit or abandonment.
        drive: the drive of a resumable revision; None for others.
        committed_ns: time of the commit to store, UTC, ns; None for the actual time.
        places: gives, for the contents and the rows of the revision, the places in the map frame
            that it changes; called before the commit.

    Attributes:
        resumable: whether it is of one drive.
        stored: the checkpointed part of a resumed session; empty for a new revision.
    """

    def __init__(
        self,
        database: SqliteDatabase,
        keys: KeyBook,
        frame_reader: FrameReader,
        view: View,
        on_end: Callable[[], None],
        *,
        drive: Resumable | None = None,
        committed_ns: int | None = None,
        places: Callable[[Mapping[str, float], Own, PlacingConfig], Sequence[Mark]] = (
            lambda *_: ()
        ),
    ) -> None:
        assert view.own is not None
        self.resumable = drive is not None
        self._session = None if drive is None else drive.session
        stored = None if drive is None else drive.stored
        self.stored = stored or StoredSession()
        self._database = database
        self._keys = keys
        self._rows = RowBuffer(keys, view.own)
        self._known = References(database, keys, view, self._rows)
        if drive is not None and stored is not None:
            key, *_ = self._known.sessions[drive.session.id.bytes]
            if stored.attempts:
                self._rows.written_attempts[key] = stored.attempts
                self._rows.scattered.add(key)
        self._frames = frame_reader
        self._view = view
        self._revision_key = view.own
        self._status = RevisionStatus.ABANDONED if stored is None else RevisionStatus.OPEN
        self._on_end = on_end
        self._committed_ns = committed_ns
        self._places = places
        self._ended = False
        self._descriptor = self._known.descriptor
        with database.reading() as connection:
            (seen,) = Visible.of(connection, view)
            self._hidden = {
                table: hidden_rows(connection, seen, table) for table in (sessions, nodes, paths)
            }
            self._interrupted = open_sessions(connection)
            self._forgets = bool(connection.exec_driver_sql(_FORGETS).scalar())
        self._omitted: set[bytes] = set()
        self._amended: set[Amendment] | None = None  # read on first use
        self._shows_again = False
        self._held: list[NodeId] = []

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
        """Adds a drive with its path; one that the map has already changes nothing.

        Args:
            session: the drive.
            camera: the session's camera.
            descriptor: kind of its descriptors.
            frontend: hash of its front-end.
            partial: whether some of its path's entries are not in this map.

        Returns:
            Whether it was new.

        Raises:
            IncompatibleError: the map's frames have another kind of descriptor.
            InputError: the camera is not the session's.
            RevisionError: the map holds an interrupted run of the session.
        """
        self._check_open()
        if session.camera != camera.id:
            raise InputError(f"session {session.id} has camera {session.camera}, not {camera.id}")
        if session.id.bytes in self._known.sessions:
            return False
        if session.id.bytes in self._interrupted:
            raise RevisionError(
                f"session {session.id} was interrupted in this map; resume it or seal what is "
                "there first"
            )
        self._check_not_forgotten(session.id, "session")
        if self._descriptor not in {None, descriptor}:
            raise IncompatibleError(
                f"{self._database.name} holds {self._descriptor} descriptors, session "
                f"{session.id} {descriptor}; the two cannot be matched: record the drive again "
                "with the same --features, or make another map"
            )
        self._descriptor = descriptor
        camera_key = self._known.camera(camera)
        frontend_key = self._known.frontend(descriptor, frontend)
        again = self._hidden[sessions].get(session.id.bytes)
        if again is not None:
            check_same_session(again, session, camera_key, frontend_key)
        key = self._shown_again(sessions, session.id.bytes)
        if key is None:
            key = self._keys.next(sessions)
            self._rows.put(
                sessions, session_row(session, key, self._revision_key, camera_key, frontend_key)
            )
        self._known.sessions[session.id.bytes] = (key, camera_key, frontend_key)
        self._add_path(path_id(session.id), key, partial)
        self._checkpoint_if_due()
        return True

    def add_node(self, node: Node, frame: Frame) -> None:
        """Saves a frame as a node.

        Raises:
            InputError: node and frame do not belong together, the landmarks cannot be stored
                without loss, or as `copy_node`.
            IncompatibleError: the frame comes from another front-end than the session's.
        """
        if (node.stamp_ns, node.camera) != (frame.stamp_ns, frame.camera.id):
            raise InputError(
                f"node {node.id} (stamp {node.stamp_ns}, camera {node.camera}) does not fit its "
                f"frame (stamp {frame.stamp_ns}, camera {frame.camera.id})"
            )
        landmarks = encode_landmarks(frame.landmarks, frame.camera)
        stored = StoredNode(
            node=node,
            descriptor=frame.descriptor,
            frontend=frame.frontend,
            status=frame.status,
            landmark_hash=blob_hash(landmarks),
            landmarks=landmarks,
            thumbnail=None if frame.thumbnail is None else encode_thumbnail(frame.thumbnail),
        )
        self.copy_node(stored, frame)

    def copy_node(self, stored: StoredNode, frame: Frame | None = None) -> None:
        """Adds a node of another map, with its landmarks copied byte for byte.

        Args:
            stored: from another map's `frames.stored`.
            frame: its decoded frame, if at hand: read from memory until the node is written.

        Raises:
            InputError: its session has not been added or has another camera, the map has the node
                already or had it with other landmarks, or one of its numbers is not valid.
            IncompatibleError: it comes from another front-end than its session.
        """
        self._check_open()
        node = stored.node
        self._known.check_node(stored)
        self._check_not_forgotten(node.id, "node")
        again = self._hidden[nodes].get(node.id.bytes)
        if again is not None:
            check_same_node(again, node, stored.landmark_hash)
        key = self._shown_again(nodes, node.id.bytes)
        if key is None:
            key = self._insert_node(stored)
        self._keys.learn_node(node.id, key)
        if frame is not None:
            self._frames.hold(node.id, frame)
            self._held.append(node.id)
        self._checkpoint_if_due()

    def add_words(self, node: NodeId, vocabulary: bytes, found: NDArray[np.int32]) -> None:
        """Stores the words of a node by the vocabulary of this hash (16 bytes).

        Args:
            node: a node of the map.
            vocabulary: the vocabulary's hash.
            found: (n,) the distinct words that the node shows, rising.

        Raises:
            InputError: the node is not in the map, or the words do not rise.
        """
        self._check_open()
        self._rows.put_words(self._known.node(node, "words"), vocabulary, found)
        self._checkpoint_if_due()

    def add_edge(self, edge: Edge) -> None:
        """Adds an edge, replacing an older one with the same (a, b, kind).

        Raises:
            InputError: an end is not in the map, both are the same, or a number is not finite.
        """
        self._check_open()
        check_edge(edge)
        a, b = self._known.node(edge.a, "edge"), self._known.node(edge.b, "edge")
        self._rows.put_edge(edge, a, b)
        self._checkpoint_if_due()

    def add_path_entry(self, entry: PathEntry) -> None:
        """Adds an entry of any session's path, in any order.

        Raises:
            InputError: the path or the node is not in the map, or the path has an entry of this
                sequence number.
        """
        self._check_open()
        path_key = self._known.paths.get(entry.path.bytes)
        if path_key is None:
            raise InputError(f"path {entry.path} is not in the map; add its session first")
        node_key = self._known.node(entry.node, "path entry")
        taken = self._known.sequences(path_key)
        if entry.sequence in taken:
            raise InputError(f"path {entry.path} has an entry {entry.sequence} already")
        self._rows.new(
            path_entries,
            path=path_key,
            sequence=checked_int(entry.sequence, "sequence"),
            node=node_key,
            kind=str(entry.kind),
            stamp_ns=checked_int(entry.stamp_ns, "stamp_ns"),
        )
        taken.add(entry.sequence)
        self._checkpoint_if_due()

    def add_attempts(self, made: Sequence[Attempt]) -> None:
        """Stores match attempts (method §3.5) of the drive being mapped, rounded to 20 bytes each.

        Offsets and headings keep 11 bits, standard deviations are exact to 3 %, ranks end at 255.

        Raises:
            InputError: a node is not in the map.
        """
        self._check_open()
        self.copy_attempts(self.session.id, *Attempts.of(made))

    def copy_attempts(self, session: SessionId, made: Attempts, node_ids: Sequence[NodeId]) -> None:
        """Stores attempts of one session of another map, in the order of their iterations.

        Args:
            session: their session.
            made: the attempts; their column `session` is ignored.
            node_ids: the nodes to which their `reference` and `node` are indices.

        Raises:
            InputError: the session or a node is not in the map.
        """
        self._check_open()
        if session.bytes not in self._known.sessions:
            raise InputError(f"attempts of session {session}, which is not in the map")
        if not len(made):
            return
        reference, node = (self._known.nodes(one, node_ids) for one in (made.reference, made.node))
        key, *_ = self._known.sessions[session.bytes]
        self._rows.put_attempts(key, replace(made, reference=reference, node=node))
        self._checkpoint_if_due()

    def add_omission(self, omission: Omission) -> None:
        """Stores an omitted node and its equivalent.

        Raises:
            InputError: the equivalent is not in the map, or the omission is stored already.
        """
        self._check_open()
        node_key = self._known.node(omission.node, "omission")
        if omission.omitted.bytes in self._omitted:
            raise InputError(f"node {omission.omitted} is omitted twice")
        uuid, node_from_omitted = (
            omission.omitted.bytes,
            transform_bytes(omission.node_from_omitted),
        )
        self._omitted.add(uuid)
        self._rows.new(omissions, uuid=uuid, node=node_key, node_from_omitted=node_from_omitted)
        if omission.landmark_hash is not None:
            self._rows.new(omitted_landmarks, uuid=uuid, landmark_hash=omission.landmark_hash)
        self._checkpoint_if_due()

    def add_amendment(self, amendment: Amendment) -> bool:
        """Adds a correction of a session; one that the map has already changes nothing.

        Returns:
            Whether it was new.

        Raises:
            InputError: the map has no such session.
        """
        self._check_open()
        found = self._known.sessions.get(amendment.session.bytes)
        if found is None:
            raise InputError(f"amendment: session {amendment.session} is not in the map")
        if self._amended is None:
            with self._database.reading() as connection:
                self._amended = set(reading.load_amendments(connection, self._view))
        if amendment in self._amended:
            return False
        self._amended.add(amendment)
        self._rows.new(
            amendments,
            session=found[0],
            what=str(amendment.what),
            value=amendment.value,
            amended_ns=amendment.amended_ns,
        )
        return True

    def add_mark(self, mark: Mark) -> None:
        """Stores a removal, placement, anchor or goal.

        Raises:
            InputError: a node is not in the map, or a value cannot be stored.
        """
        self._check_open()
        table, values = mark_row(mark, lambda node: self._known.node(node, type(mark).__name__))
        self._rows.new(table, **values)
        self._checkpoint_if_due()

    def remove_goal(self, name: str) -> None:
        """Hides the goals of a name that are visible."""
        self._check_open()
        with self._database.reading() as connection:
            found = [row for row in self._view.rows(connection, goals) if row["name"] == name]
        for row in found:
            self._hide(goals, row["key"], hide=True)

    def put_statistic(self, name: str, body: Mapping[str, Any]) -> None:
        """Stores plain JSON data under a name; the newest counts."""
        self._check_open()
        self._rows.new(statistics, name=name, body=to_json(body))

    def put_vocabulary(self, body: bytes) -> None:
        """Stores an encoded vocabulary; the newest counts."""
        self._check_open()
        self._rows.new(vocabularies, len(body), hash=content_digest(body), body=body)
        self._checkpoint_if_due()

    def forget(self, chosen: Chosen, bridges: Sequence[Edge]) -> None:
        """Forgets nodes, after all else; see `Map.forget_nodes`."""
        for bridge in bridges:
            self.add_edge(bridge)
        self.checkpoint()
        with self._database.writing() as connection:
            hide_chosen(connection, self._keys, self._view, self._revision_key, chosen)

    def add_forgotten(self, names: Mapping[Table, Sequence[bytes]]) -> None:
        """Names sessions and nodes, by UUID, that may not be taken in; see `Map.forgotten`."""
        self._check_open()
        for table, uuids in names.items():
            for uuid in uuids:
                self._rows.new(forgotten, record=str(table.name), uuid=uuid)
                self._checkpoint_if_due()

    @property
    def session(self) -> Session:
        """The drive of a resumable revision."""
        assert self._session is not None
        return self._session

    @property
    def shows_again(self) -> bool:
        """Whether this revision shows rows again that a revert had hidden."""
        return self._shows_again

    # -- how it ends

    def checkpoint(self) -> None:
        """Writes the buffer in one durable transaction. Readers see it after `commit`.

        Raises:
            StorageFullError: no space; the last checkpoint is intact, and the call may be repeated.
        """
        self._check_open()
        opens = self.resumable and self._status is RevisionStatus.ABANDONED
        with self._database.writing() as connection:
            self._rows.write(connection)
            if opens:
                change_revision(connection, self._revision_key, was=self._status, status="open")
        if opens:
            self._status = RevisionStatus.OPEN
        written = self._rows.rows
        if written[cameras] or written[frontends]:
            self._frames.set_view(self._view)
        self._frames.show(written[hidden])
        self._frames.release(self._held)
        self._clear()

    def commit(self, placing: PlacingConfig = PLACING) -> Revision:
        """Commits the revision: a last checkpoint, then its status.

        Args:
            placing: how the nodes that are new to the map frame are laid out in it.

        Raises:
            StorageFullError: as `checkpoint`.
        """
        self.checkpoint()
        with self._database.writing() as connection:
            row = revision_row(connection, self._revision_key, self._status)
            self._rows.repack_attempts(connection, own_rows(row))
            contents, own = brought(connection, row)
            if changes_layout(contents):
                self._write_places(connection, self._places(contents, own, placing))
                contents, own = with_rows(contents, own, placements, self._rows.rows[placements])
            revision = commit_revision(connection, row, contents, own, self._committed_ns)
        self._clear()
        self._end()
        return revision

    def _write_places(self, connection: Connection, found: Sequence[Mark]) -> None:
        """Writes where nodes lie; if the transaction fails, the next checkpoint writes them."""
        for one in found:
            table, values = mark_row(one, lambda node: self._known.node(node, "place"))
            self._rows.new(table, **values)
        self._rows.write(connection)

    def leave(self) -> None:
        """Leaves a drive for `check --seal`: it counts as interrupted on purpose."""
        with self._database.writing() as connection:
            change_revision(connection, self._revision_key, pid=0)

    def abandon(self) -> None:
        """Abandons the revision: the map is unchanged. No effect after its end."""
        if self._ended:
            return
        if self._status is RevisionStatus.OPEN:
            with self._database.writing() as connection:
                change_revision(connection, self._revision_key, status="abandoned")
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
        if self._status is not RevisionStatus.OPEN:
            self.abandon()

    # -- inside

    def _end(self) -> None:
        self._ended = True
        self._on_end()

    def _check_open(self) -> None:
        if self._ended:
            raise RevisionError("this revision is committed or abandoned already")

    def _clear(self) -> None:
        self._rows.clear()
        self._held.clear()

    def _checkpoint_if_due(self) -> None:
        # A resumed session must not begin in the middle of a frame's records.
        if not self.resumable and self._rows.size_bytes > _BATCH_BYTES:
            self.checkpoint()

    def _check_not_forgotten(self, one: SessionId | NodeId, what: str) -> None:
        if not self._forgets:
            return
        with self._database.reading() as connection:
            if forgotten_of(connection, self._view, [one.bytes]):
                raise InputError(
                    f"{what} {one} was forgotten in {self._database.name} and is not added "
                    "again; engram log shows why"
                )

    def _add_path(self, path: PathId, session_key: int, partial: bool) -> None:
        key = self._shown_again(paths, path.bytes)
        if key is None:
            key = self._rows.new(paths, uuid=path.bytes, session=session_key, partial=int(partial))
            self._known.begin_path(key)
        self._known.paths[path.bytes] = key

    def _insert_node(self, stored: StoredNode) -> int:
        node = stored.node
        session_key, camera_key, frontend_key = self._known.sessions[node.session.bytes]
        key = self._rows.new(
            nodes,
            uuid=node.id.bytes,
            session=session_key,
            camera=camera_key,
            frontend=frontend_key,
            stamp_ns=checked_int(node.stamp_ns, "stamp_ns"),
            driven_m=float(node.driven_m),
            status=str(stored.status),
            landmark_hash=stored.landmark_hash,
        )
        blobs = {"landmarks": stored.landmarks, "thumbnail": stored.thumbnail}
        size_bytes = len(stored.landmarks) + len(stored.thumbnail or b"")
        self._rows.put(frames, {"node": key, "revision": self._revision_key, **blobs}, size_bytes)
        return key

    def _shown_again(self, table: Table, uuid: bytes) -> int | None:
        """Key of a hidden row that this revision shows again; None without one."""
        again = self._hidden[table].pop(uuid, None)
        if again is None:
            return None
        self._shows_again = True
        self._hide(table, again["key"], hide=False)
        return int(again["key"])

    def _hide(self, table: Table, key: int, *, hide: bool) -> None:
        self._rows.put(hidden, hidden_row(self._keys, self._revision_key, table, key, hide=hide))
