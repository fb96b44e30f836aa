"""A map on disk: open it, read it, add sessions to it, look at its history."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, insert, select

from engram import __version__
from engram.errors import IncompatibleError, InputError, MapCorruptError, RevisionError
from engram.frontend import DescriptorKind
from engram.frontend.blobs import content_digest
from engram.geometry import StereoCamera
from engram.graph.model import (
    NodeId,
    Omission,
    PathId,
    Session,
    SessionId,
    path_id,
)
from engram.maps import reading
from engram.maps.bulk_writer import BulkWriter
from engram.maps.checking import check
from engram.maps.collecting import collect_abandoned
from engram.maps.committing import change_revision, commit_revision
from engram.maps.content import content_hash, record_hashes
from engram.maps.database import Database, Lock
from engram.maps.frame_reader import DEFAULT_CACHE_BYTES, FrameReader
from engram.maps.hiding import (
    Reverted,
    check_same_session,
    compare,
    hidden_row,
    hidden_rows,
    hide_revision,
)
from engram.maps.keys import KeyBook
from engram.maps.postgresql import PostgresDatabase
from engram.maps.provenance import Origin, origin_of
from engram.maps.records import (
    CheckReport,
    InterruptedSession,
    MapContents,
    MapInfo,
    Problem,
    Revision,
    RevisionStatus,
    SessionState,
    StoredSession,
)
from engram.maps.rows import (
    Row,
    checked_text,
    sealed,
    session_from_row,
    session_row,
    to_json,
    verified,
)
from engram.maps.schema import hidden, nodes, paths, revisions, sessions, vocabularies
from engram.maps.session_states import (
    interrupted_sessions,
    session_and_revision,
    stored_session,
)
from engram.maps.session_writer import SessionWriter
from engram.maps.sqlite import SqliteDatabase
from engram.maps.tags import Tag, checked_tag, load_tags, resolve, write_tag
from engram.maps.view import View, head
from engram.maps.words import load_words, words_row, write_words


def is_address(location: Path | str) -> bool:
    """Whether a map lies in PostgreSQL, not in a file."""
    return isinstance(location, str) and location.startswith("postgresql")


def open_database(location: Path | str) -> Database:
    """The database of an existing map."""
    if is_address(location):
        return PostgresDatabase(str(location))
    return SqliteDatabase(Path(location))


class MapStore:
    """A map, read as of one revision. A context manager; safe to use from several threads.

    Readers never wait for the writer, nor it for them: they see the revisions that were committed
    when they opened the map, whatever is added meanwhile.

    Attributes:
        frames: the frames of its nodes: a `LandmarkSource`.
    """

    def __init__(
        self, database: Database, *, at: int | str | None, cache_bytes: int = DEFAULT_CACHE_BYTES
    ) -> None:
        self._database = database
        with database.reading() as connection:
            self._view = View(resolve(connection, at, database.name))
        self.frames = FrameReader(database, self._view, cache_bytes)

    @staticmethod
    def create(location: Path | str) -> WritableMapStore:
        """Make an empty map and open it for writing.

        Raises:
            InputError: something is there already, or the folder is not.
            MapError: it cannot be written.
        """
        if is_address(location):
            PostgresDatabase.create(str(location))
        else:
            SqliteDatabase.create(Path(location))
        return MapStore.open_for_writing(location)

    @staticmethod
    def open(
        location: Path | str,
        *,
        at: int | str | None = None,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
    ) -> MapStore:
        """Open a map for reading.

        Args:
            location: path of the map file, or address of a map in PostgreSQL.
            at: number or name of the revision to see (`resolve`); None for the newest, 0 for the
                map before the first.
            cache_bytes: how much memory decoded frames may take.

        Raises:
            NotAMapError: nothing is there, or something else.
            FormatVersionError: a newer Engram wrote it.
            MapCorruptError: it is damaged so that it cannot be read.
            RevisionError: it has no such revision.
        """
        return MapStore(open_database(location), at=at, cache_bytes=cache_bytes)

    @staticmethod
    def open_for_writing(
        location: Path | str, *, cache_bytes: int = DEFAULT_CACHE_BYTES
    ) -> WritableMapStore:
        """Open a map for adding to it: its only writer until `close`.

        Raises:
            MapLockedError: another process writes to it; names process and host.
            MapError: as `open`, or the file is read-only.
        """
        return WritableMapStore(open_database(location), cache_bytes=cache_bytes)

    @property
    def location(self) -> str:
        """Where the map lies, for messages."""
        return self._database.name

    @property
    def revision(self) -> int:
        """Number of the newest revision that is seen; 0 for an empty map."""
        return self._view.at

    @property
    def format_version(self) -> int:
        """Of the format in which the map is stored."""
        return self._database.format_version

    def load(self) -> MapContents:
        """Everything but the landmarks: for a writer, what its open session has checkpointed too.

        Raises:
            MapCorruptError: a row does not match its checksum or points at nothing.
        """
        with self._database.reading() as connection:
            return reading.load(connection, self._view)

    def log(self) -> list[Revision]:
        """The committed revisions that are seen, oldest first."""
        with self._database.reading() as connection:
            return reading.log(connection, self._view)

    def tags(self) -> dict[str, Tag]:
        """The names that were given to revisions, also to those not seen from here."""
        with self._database.reading() as connection:
            return load_tags(connection)

    def resolve(self, named: int | str | None) -> int:
        """Number of a revision of the whole map, however it is named.

        Raises:
            RevisionError: there is none.
        """
        with self._database.reading() as connection:
            return resolve(connection, named, self._database.name)

    def descriptor(self) -> DescriptorKind | None:
        """Kind of all descriptors of the map; None before its first session."""
        with self._database.reading() as connection:
            return reading.descriptor_of(connection, self._view)

    def node_count(self) -> int:
        """How many nodes the map has."""
        with self._database.reading() as connection:
            return reading.node_count(connection, self._view)

    def info(self) -> MapInfo:
        """The map in numbers."""
        with self._database.reading() as connection:
            return reading.info(
                connection,
                self._view,
                format_version=self._database.format_version,
                size_bytes=self._database.size_bytes(),
            )

    def statistics(self) -> dict[str, dict[str, Any]]:
        """The newest of every statistic of the map, by name."""
        with self._database.reading() as connection:
            return reading.load_statistics(connection, self._view)

    def vocabulary(self) -> bytes | None:
        """The newest vocabulary of the map as it was put in; None if there is none.

        Raises:
            MapCorruptError: it does not match its hash.
        """
        with self._database.reading() as connection:
            return reading.load_vocabulary(connection, self._view)

    def omissions(self) -> dict[NodeId, Omission]:
        """The nodes that merges did not take, by their ids; equivalents that are hidden left out.

        Raises:
            MapCorruptError: a row does not match its checksum.
        """
        with self._database.reading() as connection:
            return reading.load_omissions(connection, self._view)

    def sessions(self) -> tuple[Session, ...]:
        """The drives that the map knows, by order of their coming.

        Raises:
            MapCorruptError: a row does not match its checksum.
        """
        with self._database.reading() as connection:
            return reading.load_sessions(connection, self._view)

    def frontends(self) -> dict[SessionId, tuple[DescriptorKind, str]]:
        """Descriptor kind and hash of the front-end of each session."""
        with self._database.reading() as connection:
            return reading.frontends_of_sessions(connection, self._view)

    def landmark_hashes(self) -> dict[NodeId, bytes]:
        """The 16 bytes that stand for each node's landmarks.

        Also of nodes that were not taken, as far as it was kept.
        """
        with self._database.reading() as connection:
            return reading.landmark_hashes(connection, self._view)

    def blob_sizes(self) -> dict[NodeId, tuple[int, int]]:
        """Bytes of each node's landmarks and of its thumbnail."""
        with self._database.reading() as connection:
            return reading.blob_sizes(connection, self._view)

    def partial_paths(self) -> frozenset[PathId]:
        """Paths of which some entries stayed elsewhere."""
        with self._database.reading() as connection:
            return reading.partial_paths(connection, self._view)

    def origin(self, prefix: str) -> Origin:
        """Where a node comes from, also one that a revert has hidden.

        Args:
            prefix: its UUID, or enough of its beginning.

        Raises:
            InputError: no node, or several, begin so.
        """
        with self._database.reading() as connection:
            return origin_of(connection, self._view, prefix)

    def words(self, vocabulary: bytes) -> Mapping[NodeId, NDArray[np.int32]]:
        """The words (n,) of nodes by the vocabulary of this hash, rising, as far as they are kept.

        What is damaged is left out: it can be worked out again from the landmarks.
        """
        with self._database.reading() as connection:
            return load_words(connection, vocabulary)

    def session_state(self, session: SessionId) -> SessionState:
        """What the map knows of a session: ask before handing one in."""
        with self._database.reading() as connection:
            found = session_and_revision(connection, session, self._view.at)
        if found is None or found[1]["status"] == "abandoned":
            return SessionState.ABSENT
        _, revision = found
        if revision["status"] == "committed":
            seen = revision["number"] <= self._view.at
            return SessionState.COMMITTED if seen else SessionState.ABSENT
        return SessionState.OPEN if self._is_alive(revision) else SessionState.INTERRUPTED

    def interrupted(self) -> list[InterruptedSession]:
        """Sessions whose writer is gone before it committed, oldest first."""
        query = select(revisions).where(revisions.c.status == "open").order_by(revisions.c.key)
        with self._database.reading() as connection:
            opened = list(verified(revisions, connection.execute(query)))
            gone = [row for row in opened if not self._is_alive(row)]
            return [
                one for row in gone for one in interrupted_sessions(connection, row, self._view.at)
            ]

    def content_hash(self) -> str:
        """32 hexadecimal digits, equal for maps of equal content (SPEC §7.5)."""
        with self._database.reading() as connection:
            return content_hash(connection, self._view.at)

    def record_hashes(self) -> dict[str, str]:
        """16 hexadecimal digits of each table's rows, free of what revisions tell of themselves."""
        with self._database.reading() as connection:
            return record_hashes(connection, self._view.at)

    @staticmethod
    def copy(source: Path, target: Path) -> None:
        """Copies a map file as it is now, also while somebody writes to it.

        Raises:
            InputError: the target exists already, or its folder does not.
            MapError: the source cannot be read, or the target not written.
        """
        database = SqliteDatabase(source)
        try:
            database.copy_to(target)
        finally:
            database.close()

    @staticmethod
    def compact(source: Path, target: Path) -> None:
        """Writes a map file anew, its rows in order and without gaps.

        The same rows written in the same order give the same bytes, with one version of SQLite.

        Raises:
            InputError: the target exists already, or its folder does not.
            MapError: the source cannot be read, or the target not written.
        """
        database = SqliteDatabase(source)
        try:
            database.compact_to(target)
        finally:
            database.close()

    @staticmethod
    def publish(draft: Path, target: Path) -> None:
        """Gives a map file that nobody has open its name, in the same file system: last of all.

        Raises:
            InputError: the target exists already, or its folder does not.
            MapError: the name cannot be given.
        """
        SqliteDatabase.publish(draft, target)

    @staticmethod
    def check(location: Path | str) -> CheckReport:
        """Verify a map file to the last byte, also one that is too damaged to open.

        Raises:
            NotAMapError: nothing is there, or something else.
            FormatVersionError: a newer Engram wrote it.
        """
        try:
            database = open_database(location)
        except MapCorruptError as error:
            return CheckReport((Problem("file", "", str(error)),), 0, 0, (), 0)
        try:
            return check(database)
        finally:
            database.close()

    def close(self) -> None:
        """Give back files and threads. A session that is still open becomes interrupted."""
        self.frames.close()
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_alive(self, revision: Row) -> bool:
        holder = self._database.writer()
        return holder is not None and holder.token == revision["writer"]


class _DryRunError(Exception):
    """Ends a transaction of which nothing shall stay."""


class WritableMapStore(MapStore):
    """A map and the right to be its only writer, until `close`."""

    def __init__(self, database: Database, *, cache_bytes: int = DEFAULT_CACHE_BYTES) -> None:
        self._lock: Lock = database.lock_for_writing()
        try:
            super().__init__(database, at=None, cache_bytes=cache_bytes)
            self._keys = KeyBook(database, self._view)
        except BaseException:
            self._lock.release()
            raise
        self._open_session: SessionWriter | None = None
        self._bulk: BulkWriter | None = None
        self._holder = self._lock.holder

    @staticmethod
    def opened_or_created(location: Path) -> WritableMapStore:
        """A map file open for writing, made if there is none."""
        if location.exists():
            return MapStore.open_for_writing(location)
        return MapStore.create(location)

    def begin_session(
        self,
        session: Session,
        camera: StereoCamera,
        *,
        descriptor: DescriptorKind,
        frontend: str,
        author: str,
        configuration: Mapping[str, Any],
        message: str = "",
    ) -> SessionWriter:
        """Begin to write one drive, in a revision of its own.

        Args:
            session: the drive; its id tells whether the map has it already (`session_state`).
            camera: the session's camera.
            descriptor: kind of the descriptors of all its frames.
            frontend: hash of the front-end that makes them.
            author: who, or which robot.
            configuration: the resolved settings, plain JSON data.
            message: what `log` shows.

        Raises:
            RevisionError: the map has this session already, committed or interrupted, or another
                session is being written.
            IncompatibleError: the map's frames have another kind of descriptor.
            InputError: the camera is not the session's, or the configuration is no JSON data.
        """
        self._check_none_open()
        if session.camera != camera.id:
            raise InputError(f"session {session.id} has camera {session.camera}, not {camera.id}")
        self._check_new(session)
        opened = self._revision_row(author, message, to_json(configuration))
        with self._database.writing() as connection:
            collect_abandoned(connection)  # whose UUIDs may come again
            self._check_descriptor(connection, descriptor)
            connection.execute(insert(revisions), [sealed(revisions, opened)])
            camera_key = self._keys.ensure_camera(connection, camera)
            frontend_key = self._keys.ensure_frontend(connection, descriptor, frontend)
            self._insert_session(connection, session, opened["key"], camera_key, frontend_key)
        return self._writer(session.id, StoredSession())

    def resume_session(self, session: SessionId) -> SessionWriter:
        """Go on with an interrupted session; `SessionWriter.stored` says where.

        Raises:
            RevisionError: the map has no interrupted session of this id.
            IncompatibleError: meanwhile another kind of descriptor came into the map.
        """
        self._check_none_open()
        row, revision = self._interrupted_rows(session)
        with self._database.writing() as connection:
            change_revision(
                connection,
                revision["key"],
                host=self._holder.host,
                pid=self._holder.pid,
                writer=self._holder.token,
            )
            stored = stored_session(connection, View(self._view.at, revision["key"]), row)
        return self._writer(session, stored)

    def seal(self, session: SessionId) -> Revision:
        """Commit what an interrupted session had checkpointed.

        Raises:
            RevisionError: the map has no interrupted session of this id.
            IncompatibleError: meanwhile another kind of descriptor came into the map.
        """
        return self.resume_session(session).commit()

    def begin_revision(
        self,
        *,
        author: str,
        message: str,
        configuration: Mapping[str, Any],
        at_ns: int | None = None,
    ) -> BulkWriter:
        """Begin to write one revision that brings records of many sessions at once.

        Args:
            author: who, or which robot.
            message: what `log` shows.
            configuration: the resolved settings, plain JSON data.
            at_ns: a time that stands for when it was written, UTC; the revision then names no host
                either, so that the same records give the same bytes. None for now and here.

        Raises:
            RevisionError: a session or another such revision is being written.
            InputError: the configuration is no JSON data.
        """
        self._check_none_open()
        row = self._revision_row(author, message, to_json(configuration))
        if at_ns is not None:
            row |= {"opened_ns": at_ns, "host": "", "pid": 0, "writer": ""}
        row["status"] = str(RevisionStatus.ABANDONED)
        with self._database.writing() as connection:
            collect_abandoned(connection)  # whose UUIDs may come again
            connection.execute(insert(revisions), [sealed(revisions, row)])
        own = View(self._view.at, row["key"])
        self._keys.forget_nodes()  # some may have been hidden since they were learnt
        self._see(own)
        self._bulk = BulkWriter(
            self._database,
            self._keys,
            self.frames,
            revision_key=row["key"],
            view=own,
            on_cameras=lambda: self.frames.set_view(own),
            on_end=self._writing_ended,
            committed_ns=at_ns,
        )
        return self._bulk

    def revert(
        self, named: int | str, *, author: str, message: str = "", dry_run: bool = False
    ) -> Reverted:
        """Take a revision back, by a new revision that hides what it brought (`hide_revision`).

        Args:
            named: the revision.
            author: who.
            message: why.
            dry_run: only say what would come of it.

        Raises:
            RevisionError: there is no such revision, nothing of it is left to take back, or a
                session is being written.
            StorageFullError: no space; the map is as it was.
        """
        self._check_none_open()
        number = self.resolve(named)
        if number == 0:
            raise RevisionError(f"{self._database.name}: there is no revision 0 to take back")
        said = f"revert revision {number}" + (f": {message}" if message else "")
        opened = self._revision_row(author, said, to_json({"revert": number}))
        try:
            with self._database.writing() as connection:
                connection.execute(insert(revisions), [sealed(revisions, opened)])
                own = View(self._view.at, opened["key"])
                hide_revision(connection, self._keys, own, number, opened["key"])
                done = compare(connection, number, self._view, own)
                if dry_run:
                    raise _DryRunError
                done = replace(done, revision=commit_revision(connection, opened["key"]))
        except _DryRunError:
            return done
        self.frames.forget()
        self._keys.forget_nodes()
        self._see(View(self.resolve(None)))
        return done

    def put_words(self, vocabulary: bytes, found: Mapping[NodeId, NDArray[np.int32]]) -> None:
        """Keep words of nodes, in one transaction: no revision, since they follow from other rows.

        Args:
            vocabulary: hash (16 bytes) of the vocabulary.
            found: the distinct words (n,) of each node, rising.

        Raises:
            InputError: a node is not in the map, or its words do not rise.
            StorageFullError: no space; the map is as it was.
        """
        rows = []
        for node, shown in found.items():
            key = self._keys.find_node(node)
            if key is None:
                raise InputError(f"words: node {node} is not in the map")
            rows.append(words_row(key, vocabulary, shown))
        with self._database.writing() as connection:
            write_words(connection, self._database, rows)

    def put_vocabulary(
        self, body: bytes, *, author: str, message: str, configuration: Mapping[str, Any]
    ) -> Revision:
        """Keep a vocabulary in the map, in a revision of its own; the newest counts.

        Args:
            body: the vocabulary, encoded.
            author: who, or which robot.
            message: what `log` shows.
            configuration: how it was trained, plain JSON data.

        Raises:
            RevisionError: a session is being written.
            StorageFullError: no space; the map is as it was.
        """
        self._check_none_open()
        opened = self._revision_row(author, message, to_json(configuration))
        row: Row = {
            "key": self._keys.next(vocabularies),
            "revision": opened["key"],
            "hash": content_digest(body),
            "body": body,
        }
        with self._database.writing() as connection:
            connection.execute(insert(revisions), [sealed(revisions, opened)])
            connection.execute(insert(vocabularies), [sealed(vocabularies, row)])
            revision = commit_revision(connection, opened["key"])
        self._see(View(revision.number))
        return revision

    def tag(
        self,
        name: str,
        named: int | str | None = None,
        *,
        author: str,
        message: str = "",
        move: bool = False,
    ) -> Tag:
        """Give a revision a name. History and content hash stay as they are.

        Args:
            name: a letter, then letters, digits and ``. _ / + -``.
            named: the revision; None for the newest.
            author: who.
            message: why.
            move: whether a name that another revision has may be taken from it.

        Raises:
            InputError: the name cannot be one.
            RevisionError: there is no such revision, or another one has the name.
        """
        checked_tag(name)
        with self._database.writing() as connection:
            number = resolve(connection, named, self._database.name)
            if number == 0:
                newest = resolve(connection, None, self._database.name)
                raise RevisionError(
                    f"{self._database.name} has revisions 1 to {newest}; 0 is before the first and "
                    "cannot be tagged"
                    if newest
                    else f"{self._database.name} has no revision yet to tag"
                )
            known = load_tags(connection).get(name)
            if known is not None and known.number != number and not move:
                raise RevisionError(
                    f"revision {known.number} of {self._database.name} is tagged {name!r} already; "
                    "choose another name, or move the tag"
                )
            if known is None or known.number != number:
                write_tag(connection, self._keys, name, number, author, message)
            return load_tags(connection)[name]

    def untag(self, name: str, *, author: str) -> Tag:
        """Take a name away; returns what it was.

        Raises:
            RevisionError: there is no such tag.
        """
        with self._database.writing() as connection:
            known = load_tags(connection)
            if name not in known:
                told = ", ".join(known) or "none"
                raise RevisionError(f"{self._database.name} has no tag {name!r}; its tags: {told}")
            write_tag(connection, self._keys, name, None, author, "")
        return known[name]

    def clean(self) -> int:
        """Remove the rows of abandoned revisions; returns how many there were."""
        self._check_none_open()
        with self._database.writing() as connection:
            return collect_abandoned(connection)

    def close(self) -> None:
        """Give back files, threads and the right to write."""
        try:
            super().close()
        finally:
            self._lock.release()

    def _revision_row(self, author: str, message: str, configuration: str) -> Row:
        return {
            "key": self._keys.next(revisions),
            "number": None,
            "status": "open",
            "parent": None,
            "author": checked_text(author, "author"),
            "message": checked_text(message, "message"),
            "tool_version": __version__,
            "configuration": configuration,
            "contents": "{}",
            "opened_ns": time.time_ns(),
            "committed_ns": None,
            "host": self._holder.host,
            "pid": self._holder.pid,
            "writer": self._holder.token,
        }

    def _insert_session(
        self, connection: Connection, session: Session, revision: int, camera: int, frontend: int
    ) -> None:
        """The session and its path: new rows, or those that a revert has hidden."""
        again = hidden_rows(connection, self._view, sessions).get(session.id.bytes)
        if again is not None:
            check_same_session(again, session, camera, frontend)
        key = self._keys.next(sessions) if again is None else again["key"]
        path_again = hidden_rows(connection, self._view, paths).get(path_id(session.id).bytes)
        row = session_row(session, key, revision, camera, frontend)
        path: Row = {
            "key": self._keys.next(paths),
            "uuid": path_id(session.id).bytes,
            "revision": revision,
            "session": key,
            "partial": 0,
        }
        for table, new, old in ((sessions, row, again), (paths, path, path_again)):
            if old is None:
                connection.execute(insert(table), [sealed(table, new)])
            else:
                shown = hidden_row(self._keys, revision, table, old["key"], hide=False)
                connection.execute(insert(hidden), [shown])

    def _writer(self, session: SessionId, stored: StoredSession) -> SessionWriter:
        with self._database.reading() as connection:
            found = session_and_revision(connection, session, self._view.at)
            assert found is not None
            row, revision = found
            camera = reading.load_cameras(connection)[row["camera"]]
            path_query = select(paths.c.key).where(paths.c.uuid == path_id(session).bytes)
            path_key = connection.execute(path_query.order_by(paths.c.key)).scalar_one()
            frontend = reading.load_frontends(connection)[row["frontend"]]
            own = View(self._view.at, revision["key"])
            hidden_nodes = hidden_rows(connection, own, nodes)
        self._see(own)
        self._open_session = SessionWriter(
            self._database,
            self._keys,
            self.frames,
            session=session_from_row(row, camera.id),
            revision_key=revision["key"],
            session_key=row["key"],
            path_key=path_key,
            camera_key=row["camera"],
            frontend=(row["frontend"], *frontend),
            stored=stored,
            hidden_nodes=hidden_nodes,
            on_end=self._writing_ended,
        )
        return self._open_session

    def _writing_ended(self) -> None:
        self._open_session = self._bulk = None
        with self._database.reading() as connection:
            newest = head(connection)
        self._see(View(newest))

    def _see(self, view: View) -> None:
        self._view = view
        self._keys.set_view(view)
        self.frames.set_view(view)

    def _check_none_open(self) -> None:
        if self._open_session is not None:
            raise RevisionError(
                f"session {self._open_session.session.id} is being written; commit or abandon it"
            )
        if self._bulk is not None:
            raise RevisionError("a revision is being written; commit or abandon it")

    def _check_new(self, session: Session) -> None:
        state = self.session_state(session.id)
        if state is SessionState.COMMITTED:
            raise RevisionError(f"{self._database.name} has session {session.id} already")
        if state is not SessionState.ABSENT:
            raise RevisionError(
                f"session {session.id} was interrupted; resume it or seal what is there"
            )

    def _check_descriptor(self, connection: Connection, descriptor: DescriptorKind) -> None:
        present = reading.descriptor_of(connection, self._view)
        if present not in {None, descriptor}:
            raise IncompatibleError(
                f"{self._database.name} holds {present} descriptors, this session {descriptor}; "
                "the two cannot be matched: extract the session again, or make another map"
            )

    def _interrupted_rows(self, session: SessionId) -> tuple[Row, Row]:
        with self._database.reading() as connection:
            found = session_and_revision(connection, session, self._view.at)
            if found is None or found[1]["status"] != "open":
                raise RevisionError(
                    f"{self._database.name} has no interrupted session {session}; "
                    f"it is {self.session_state(session)}"
                )
            self._check_descriptor(
                connection, reading.load_frontends(connection)[found[0]["frontend"]][0]
            )
        return found
