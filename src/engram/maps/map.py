"""A map on disk: opening, reading, adding sessions, and history."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, insert

from engram.errors import IncompatibleError, InputError, RevisionError
from engram.files import Holder, WriterLock
from engram.frontend import DescriptorKind
from engram.geometry import SE3, StereoCamera
from engram.graph.marks import Placement
from engram.graph.model import Amendable, NodeId, Session, SessionId
from engram.graph.placing import PlacingConfig
from engram.maps import reading
from engram.maps.amending import checked_amendments
from engram.maps.frame_reader import DEFAULT_CACHE_BYTES
from engram.maps.hiding import Reverted, compare, hide_revision
from engram.maps.keys import KeyBook
from engram.maps.laying_out import new_places
from engram.maps.map_reader import MapReader
from engram.maps.records import Revision, RevisionStatus, SessionState
from engram.maps.revisions import (
    change_revision,
    collect_abandoned,
    commit_revision,
    new_revision,
    session_and_revision,
    stored_session,
)
from engram.maps.rows import Row, sealed, session_from_row
from engram.maps.schema import revisions
from engram.maps.sqlite import SqliteDatabase, map_path
from engram.maps.tags import Tag, TagWriter
from engram.maps.view import View, head
from engram.maps.words import words_row, write_words
from engram.maps.writer import Resumable, RevisionWriter

if TYPE_CHECKING:
    from engram.robot.robot import Robot
    from engram.robot.settings import Settings

_P = ParamSpec("_P")
_T = TypeVar("_T")


def _writes(method: Callable[Concatenate[Map, _P], _T]) -> Callable[Concatenate[Map, _P], _T]:
    """Locks the map for writing while the method runs."""

    @wraps(method)
    def locked(self: Map, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        with self.writing():
            return method(self, *args, **kwargs)

    return locked


class Map(MapReader):
    """A map on disk as of one revision. A context manager; threads may share it.

    Readers and the writer never wait for each other: readers see the revisions committed when
    they opened the map. Records stay in memory once read. The graph and the paths are read once,
    and grow with what this process writes.

    Attributes:
        frames: the frames of its nodes: a `LandmarkSource`.
    """

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

    @staticmethod
    def create(location: Path | str) -> Map:
        """Creates an empty map and opens it for writing.

        Raises:
            InputError: the file exists already, or its folder does not.
            MapError: it cannot be written.
        """
        SqliteDatabase.create(map_path(location))
        return Map.open(location, writes=True)

    @staticmethod
    def open(
        location: Path | str,
        *,
        at: int | str | None = None,
        writes: bool = False,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
    ) -> Map:
        """Opens an existing map.

        Args:
            location: path of the map file.
            at: number or name of the revision to see (`resolve`); None for the newest, 0 for the
                map before the first.
            writes: lock it for writing until `close`.
            cache_bytes: largest memory of decoded frames.

        Raises:
            NotAMapError: the file does not exist or is not a map.
            FormatVersionError: a newer Engram wrote it.
            MapCorruptError: it is too damaged to read.
            MapLockedError: another process writes to it; names process and host.
            RevisionError: it has no such revision.
        """
        return Map(
            SqliteDatabase(map_path(location)), at=at, writes=writes, cache_bytes=cache_bytes
        )

    def robot(
        self,
        camera: StereoCamera,
        settings: Settings | None = None,
        *,
        name: str | None = None,
        maps: bool = False,
        remembers: bool = False,
        policy: str = "recall",
        lanes: int = 2,
        rounds: int = 2,
        relocaliser: str | None = "fabmap",
        threads: int | None = None,
    ) -> Robot:
        """A robot that localises in this map; see `Robot.step`.

        A robot that maps or remembers stores its drive as a session; closing the robot commits it
        as a revision. It sees its own nodes at once; maps opened after the commit show them.

        Args:
            camera: its rectified stereo camera.
            settings: the configuration; None for the defaults.
            name: name of the robot; required if its drives are stored.
            maps: whether it saves frames that it does not localise, on a separate thread with
                checkpoints. It is the map's only writer until it is closed. After a crash, the
                robot's next such drive first commits the saved part (`Saving.recovered`).
            remembers: whether to store its path and match attempts, by which later drives rank;
                implied by `maps`. They are kept in a file beside the map until the drive ends and
                no other process writes to the map.
            policy: key of `POLICIES`.
            lanes: attempts in parallel (Np).
            rounds: rounds of attempts per frame (Nr).
            relocaliser: key of `RELOCALISERS`, for lost robots; None for none.
            threads: most threads of the robot, the caller's included; None: `lanes` + 2 to 4.

        Raises:
            InputError: an option is unknown or out of range, or the threads are too few.
            MapError: the map is closed.
        """
        from engram.robot.live import Owner
        from engram.robot.settings import RobotOptions, Settings
        from engram.robot.starting import robot_in

        self._database.check_open()
        asked = RobotOptions(policy, lanes, rounds, relocaliser=relocaliser, threads=threads)
        owner = Owner(name, camera, settings or Settings(), asked)
        return robot_in(self, owner, maps=maps, remembers=remembers)

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
            session: the drive; `session_state` tells whether the map has it already.
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

    @_writes
    def seal(self, session: SessionId) -> Revision:
        """Commits the checkpointed part of an interrupted session.

        Raises:
            RevisionError: the map has no interrupted session of this id.
            IncompatibleError: the map has since got another kind of descriptor.
        """
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

    @_writes
    def revert(
        self, named: int | str, *, author: str, message: str = "", dry_run: bool = False
    ) -> Reverted:
        """Reverts a revision, by a new one that hides its rows (`hide_revision`).

        Args:
            named: the revision.
            author: the person or robot.
            message: reason.
            dry_run: only report the result.

        Raises:
            RevisionError: there is no such revision, nothing of it is visible, or a session is
                being written.
            StorageFullError: no space; the map is unchanged.
        """
        self._check_none_open()
        number = self.resolve(named)
        if number == 0:
            raise RevisionError(f"{self._database.name}: there is no revision 0 to revert")
        said = f"revert revision {number}" + (f": {message}" if message else "")
        opened = new_revision(self._keys, self._holder, author, said, {"revert": number})
        try:
            with self._database.writing() as connection:
                connection.execute(insert(revisions), [sealed(revisions, opened)])
                own = View(self._view.at, opened["key"])
                hide_revision(connection, self._keys, own, number, opened["key"])
                done = compare(connection, number, self._view, own)
                if dry_run:
                    raise _DryRunError
                revision = commit_revision(connection, opened["key"], was=RevisionStatus.ABANDONED)
                done = replace(done, revision=revision)
        except _DryRunError:
            return done
        self.frames.forget()
        self.forget()
        self._keys.forget_nodes()
        self._see(View(self.resolve(None)))
        return done

    @_writes
    def put_words(self, vocabulary: bytes, found: Mapping[NodeId, NDArray[np.int32]]) -> None:
        """Stores words of nodes in one transaction; no revision, since they follow from other rows.

        Args:
            vocabulary: hash (16 bytes) of the vocabulary.
            found: the distinct words (n,) of each node, rising.

        Raises:
            InputError: a node is not in the map, or its words do not rise.
            StorageFullError: no space; the map is unchanged.
        """
        rows = []
        for node, shown in found.items():
            key = self._keys.find_node(node)
            if key is None:
                raise InputError(f"words: node {node} is not in the map")
            rows.append(words_row(key, vocabulary, shown))
        with self._database.writing() as connection:
            write_words(connection, rows)

    @_writes
    def put_vocabulary(
        self, body: bytes, *, author: str, message: str, configuration: Mapping[str, Any]
    ) -> Revision:
        """Stores a vocabulary in its own revision; the newest counts.

        Args:
            body: the vocabulary, encoded.
            author: the person or robot.
            message: text for `log`.
            configuration: how it was trained, plain JSON data.

        Raises:
            RevisionError: a session is being written.
            StorageFullError: no space; the map is unchanged.
        """
        with self.begin_revision(
            author=author, message=message, configuration=configuration
        ) as writer:
            writer.put_vocabulary(body)
            revision = writer.commit()
        self._derived.clear()
        return revision

    @_writes
    def amend(
        self,
        session: SessionId,
        changes: Mapping[Amendable, str],
        *,
        author: str,
        message: str = "",
    ) -> Revision:
        """Corrects facts of a session; its record and all ids stay unchanged.

        Args:
            session: the session.
            changes: new values by fact: a robot's name, an IANA zone, or the UTC time of the
                session's first pair, ns.
            author: the person or robot.
            message: reason.

        Raises:
            InputError: the map has no such session, it has these values already, or a value is not
                valid.
            ConfigError: the zone is unknown.
            RevisionError: a session is being written.
            StorageFullError: no space; the map is unchanged.
        """
        if session not in self.sessions:
            raise InputError(f"{self.location} has no session {session}")
        now = checked_amendments(self.sessions[session], changes, time.time_ns())
        with self.begin_revision(
            author=author,
            message=message or f"amend {', '.join(now)} of session {session}",
            configuration={"amend": {"session": str(session), **changes}},
        ) as writer:
            for amendment in now.values():
                writer.add_amendment(amendment)
            revision = writer.commit()
        self.forget()
        return revision

    @_writes
    def tag(
        self,
        name: str,
        named: int | str | None = None,
        *,
        author: str,
        message: str = "",
        move: bool = False,
    ) -> Tag:
        """Tags a revision. History and content hash do not change.

        Args:
            name: a letter, then letters, digits and ``. _ / + -``.
            named: the revision; None for the newest.
            author: the person or robot.
            message: reason.
            move: whether to move a tag that another revision has.

        Raises:
            InputError: the name is not valid.
            RevisionError: there is no such revision, or another one has the name.
        """
        with self._database.writing() as connection:
            tags = TagWriter(connection, self._keys, self.location)
            return tags.set(name, named, author, message, move=move)

    @_writes
    def untag(self, name: str, *, author: str) -> Tag:
        """Removes a tag and returns it.

        Raises:
            RevisionError: there is no such tag.
        """
        with self._database.writing() as connection:
            return TagWriter(connection, self._keys, self.location).remove(name, author)

    @_writes
    def clean(self) -> int:
        """Removes the rows of abandoned revisions; returns their number."""
        self._check_none_open()
        with self._database.writing() as connection:
            return collect_abandoned(connection)

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

    def _new_places(self, contents: Mapping[str, float], config: PlacingConfig) -> list[Placement]:
        """What the open revision has to write of the layout, which is known then."""
        found = new_places(self, contents, config)
        if contents["placements"] or contents["hidden"]:
            self._laid_out = None
        else:
            self._laid_out = self.placements | {one.node: one.map_from_node for one in found}
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


class _DryRunError(Exception):
    """Ends a transaction without committing it."""
