"""The writing part of a map: its lock, and the sessions and revisions that are begun."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from sqlalchemy import Connection, insert

from engram.errors import IncompatibleError, RevisionError
from engram.files import Holder, WriterLock
from engram.frontend.frame import DescriptorKind
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId, Placement, Session, SessionId
from engram.graph.placing import PlacingConfig
from engram.maps import reading
from engram.maps.frame_reader import DEFAULT_CACHE_BYTES
from engram.maps.laying_out import new_places
from engram.maps.map_frame import all_places
from engram.maps.map_reader import MapReader
from engram.maps.records import Revision, SessionState
from engram.maps.revisions import (
    change_revision,
    collect_abandoned,
    new_revision,
    session_and_revision,
    stored_session,
)
from engram.maps.rows import Row, sealed, session_from_row
from engram.maps.schema import revisions
from engram.maps.sqlite import SqliteDatabase
from engram.maps.totals import Own
from engram.maps.view import KeyBook, View, head
from engram.maps.writer import Resumable, RevisionWriter


class MapWriter(MapReader):
    """A map that is locked for writing while a revision is written; a part of `Map`."""

    def __init__(
        self,
        database: SqliteDatabase,
        *,
        at: int | str | None = None,
        writes: bool = False,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
    ) -> None:
        self._lock: WriterLock | None = database.lock_for_writing() if writes else None
        try:
            super().__init__(database, at=at, cache_bytes=cache_bytes)
            self._key_book = KeyBook(database, self._view) if writes else None
        except BaseException:
            self._release()
            raise
        self._writing: RevisionWriter | None = None
        self._laid_out: dict[NodeId, SE3] | None = None  # once the open revision is committed

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Locks the map for writing, on top of its newest revision.

        A map opened with `writes` is locked already.

        Raises:
            MapLockedError: another process writes to it.
            RevisionError: the map was opened at a given revision.
        """
        if self._lock is not None:
            yield
            return
        if self._pinned:
            raise RevisionError(
                f"{self.location} is open at revision {self.revision}; to write to it, open it "
                "without naming a revision"
            )
        self._lock = self._database.lock_for_writing()
        try:
            newest = View(self.resolve(None))
            if newest != self._view:
                self.forget()
            self._key_book = KeyBook(self._database, newest)
            self._see(newest)
            yield
        finally:
            self._key_book = None
            self._release()

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
    ) -> RevisionWriter:
        """Begins to write one drive, in its own revision.

        Args:
            session: the drive; `session_state` shows whether the map has it already.
            camera: the session's camera.
            descriptor: kind of the descriptors of all its frames.
            frontend: hash of the front-end that makes them.
            author: the person or robot.
            configuration: the resolved settings, plain JSON data.
            message: text for `log`.

        Raises:
            RevisionError: the map has this session already, committed or interrupted, or another
                session is being written.
            IncompatibleError: the map's frames have another kind of descriptor.
            InputError: the camera is not the session's, or the configuration is not JSON data.
        """
        self._check_none_open()
        self._check_new(session)
        row = new_revision(self._keys, self._holder, author, message, configuration)
        writer = self._begin(row, Resumable(session))
        try:
            writer.add_session(session, camera, descriptor=descriptor, frontend=frontend)
            writer.checkpoint()
        except BaseException:
            writer.abandon()
            raise
        return writer

    def resume_session(self, session: SessionId) -> RevisionWriter:
        """Continues an interrupted session; `RevisionWriter.stored` is its stored part.

        Raises:
            RevisionError: the map has no interrupted session of this id.
            IncompatibleError: the map has since got another kind of descriptor.
        """
        self._check_none_open()
        row, revision = self._interrupted_rows(session)
        own = View(self._view.at, revision["key"])
        with self._database.writing() as connection:
            change_revision(
                connection,
                revision["key"],
                host=self._holder.host,
                pid=self._holder.pid,
                writer=self._holder.token,
            )
            stored = stored_session(connection, own, row)
            camera = reading.load_cameras(connection)[row["camera"]]
        return self._written(own, Resumable(session_from_row(row, camera.id), stored))

    def seal(self, session: SessionId) -> Revision:
        """Commits the checkpointed part of an interrupted session.

        Raises:
            RevisionError: the map has no interrupted session of this id.
            IncompatibleError: the map has since got another kind of descriptor.
        """
        with self.writing():
            return self.resume_session(session).commit()

    def begin_revision(
        self,
        *,
        author: str,
        message: str,
        configuration: Mapping[str, Any],
        at_ns: int | None = None,
    ) -> RevisionWriter:
        """Begins to write one revision with records of many sessions.

        Args:
            author: the person or robot.
            message: text for `log`.
            configuration: the resolved settings, plain JSON data.
            at_ns: time of the revision, UTC, ns; the revision then names no host, so that the same
                records give the same bytes. None for the current time and host.

        Raises:
            RevisionError: a session or another such revision is being written.
            InputError: the configuration is not JSON data.
        """
        self._check_none_open()
        row = new_revision(self._keys, self._holder, author, message, configuration)
        if at_ns is not None:
            row |= {"opened_ns": at_ns, "host": "", "pid": 0, "writer": ""}
        return self._begin(row, committed_ns=at_ns)

    def close(self) -> None:
        """Closes files and threads, and releases the lock. Whatever needs the file is then refused.

        A session that is still open becomes interrupted.
        """
        try:
            super().close()
        finally:
            self._release()

    @property
    def _holder(self) -> Holder:
        assert self._lock is not None  # keys exist only with the lock
        return self._lock.holder

    @property
    def _keys(self) -> KeyBook:
        self._database.check_open()
        if self._key_book is None:
            raise RevisionError(f"{self.location} is open for reading; open it with writes=True")
        return self._key_book

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _begin(
        self, row: Row, drive: Resumable | None = None, committed_ns: int | None = None
    ) -> RevisionWriter:
        """A new, empty revision."""
        with self._database.writing() as connection:
            collect_abandoned(connection)  # since their UUIDs may be used again
            connection.execute(insert(revisions), [sealed(revisions, row)])
        self._keys.forget_nodes()  # some may be hidden since then
        return self._written(View(self._view.at, row["key"]), drive, committed_ns)

    def _written(
        self, own: View, drive: Resumable | None, committed_ns: int | None = None
    ) -> RevisionWriter:
        """The writer of a revision; until it ends, this map includes its rows."""
        placed = None
        if drive is not None:
            self.forget()  # later reads include the session
            self._keys.forget_nodes()  # so do later searches for its nodes
        else:
            placed = self.__dict__.get("placements")  # the revision is still empty
        self._see(own, placed)
        self._writing = RevisionWriter(
            self._database,
            self._keys,
            self.frames,
            own,
            self._writing_ended,
            drive=drive,
            committed_ns=committed_ns,
            places=self._new_places,
        )
        return self._writing

    def _new_places(
        self, contents: Mapping[str, float], own: Own, config: PlacingConfig
    ) -> list[Placement]:
        """The part of the layout that the open revision has to write; completes the layout."""
        with self._database.reading() as connection:
            found = new_places(connection, self._view, contents, own, config)
        if found is None:
            found = all_places(self, contents, config)
        known = self.__dict__.get("placements")
        if known is None or contents["placements"] or contents["hidden"]:
            self._laid_out = None
        else:
            self._laid_out = known | {one.node: one.map_from_node for one in found}
        return found

    def _writing_ended(self) -> None:
        self._writing, laid_out, self._laid_out = None, self._laid_out, None
        with self._database.reading() as connection:
            newest = head(connection)
        committed = newest > self._view.at
        self._see(View(newest), laid_out if committed else None)

    def _see(self, view: View, placements: dict[NodeId, SE3] | None = None) -> None:
        self._look_from(view, placements)
        self._keys.set_view(view)

    def _check_none_open(self) -> None:
        if (writer := self._writing) is None:
            return
        what = f"session {writer.session.id}" if writer.resumable else "a revision"
        raise RevisionError(f"{what} is being written; commit or abandon it")

    def _check_new(self, session: Session) -> None:
        state = self.session_state(session.id)
        if state is SessionState.COMMITTED:
            raise RevisionError(f"{self.location} holds this drive already: session {session.id}")
        if state is not SessionState.ABSENT:
            raise RevisionError(
                f"{self.location} holds this drive, interrupted: session {session.id}; engram map "
                "resumes it, engram check --seal commits what was saved"
            )

    def _check_descriptor(self, connection: Connection, descriptor: DescriptorKind) -> None:
        present = reading.descriptor_of(connection, self._view)
        if present not in {None, descriptor}:
            raise IncompatibleError(
                f"{self._database.name} holds {present} descriptors, this session {descriptor}; "
                "the two cannot be matched: record the drive again with the same --features, or "
                "make another map"
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
