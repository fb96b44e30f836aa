"""A map on disk: opening, reading, writing, and history."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, insert, select

from engram.errors import IncompatibleError, InputError, RevisionError
from engram.files import Holder, WriterLock, map_path
from engram.frontend.frame import DescriptorKind
from engram.geometry.cameras import CameraId, StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.clock import check_zone
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    LONGEST_NAME,
    Amendable,
    Amendment,
    Edge,
    NodeId,
    Placement,
    Session,
    SessionId,
)
from engram.graph.pages import DEFAULT_BUDGET_BYTES, PagedGraph
from engram.graph.paths import Attempts, PathMemory
from engram.graph.placing import PlacingConfig
from engram.keywords import keywords
from engram.maps import marks, reading
from engram.maps.attempts import (
    load_words,
    load_words_between,
    words_row,
    write_words,
)
from engram.maps.checking import check
from engram.maps.content import content_hash, record_hashes, verified_hash
from engram.maps.counting import info, totals_of
from engram.maps.difference import STRETCH_M, MapDifference, difference
from engram.maps.forgetting import (
    Chosen,
    Forgotten,
    NothingToForgetError,
    hide_chosen,
    load_names,
    result_of,
    write_bridges,
)
from engram.maps.frame_reader import DEFAULT_CACHE_BYTES, FrameReader
from engram.maps.hiding import Reverted, compare, hide_revision
from engram.maps.laying_out import new_places
from engram.maps.lookups import Lookups
from engram.maps.map_frame import Layout, MapFrame, all_places, frame_of, graph_of, layout_of
from engram.maps.origins import Origin, origin_of
from engram.maps.pages import MapPages
from engram.maps.place_blocks import Parts, StoredBlocks, block_rows, write_block
from engram.maps.placed import PlacedNodes, SizedNodes, load_placed, load_sized
from engram.maps.records import (
    CheckReport,
    InterruptedSession,
    MapContents,
    MapInfo,
    Revision,
    SessionState,
)
from engram.maps.revisions import (
    brought,
    change_revision,
    collect_abandoned,
    commit_revision,
    interrupted_sessions,
    new_revision,
    session_and_revision,
    settled_nodes,
    stored_session,
)
from engram.maps.rows import START, Row, checked_text, sealed, session_from_row, verified
from engram.maps.schema import revisions
from engram.maps.sqlite import SqliteDatabase, reading_rows
from engram.maps.tags import Tag, TagWriter, load_tags, resolve
from engram.maps.totals import Own, Totals, own_rows
from engram.maps.view import KeyBook, View, head
from engram.maps.writer import Resumable, RevisionWriter

if TYPE_CHECKING:
    from engram.robot.robot import Robot
    from engram.robot.settings import Settings


@contextmanager
def no_collections() -> Iterator[None]:
    """Pauses the garbage collector: records hold no cycles, and each pass would visit all of them.

    A process whose collector is off already keeps it off.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def checked_amendments(
    shown: Session, changes: Mapping[Amendable, str], now_ns: int
) -> dict[Amendable, Amendment]:
    """The amendments that change a session.

    Raises:
        InputError: none does, or a value is not valid.
        ConfigError: the zone is unknown.
    """
    found = {}
    for what, value in changes.items():
        checked_text(value, what)
        if what is Amendable.ZONE:
            check_zone(value)
        if (
            not value
            or (what is Amendable.ROBOT and len(value) > LONGEST_NAME)
            or (what is Amendable.START and not START.fullmatch(value))
        ):
            raise InputError(f"{value!r:.60} is not valid as the {what} of a session")
        amendment = Amendment(shown.id, what, value, now_ns)
        if amendment.applied(shown) != shown:
            found[what] = amendment
    if not found:
        raise InputError(f"session {shown.id} has these values already: nothing to amend")
    return found


_P = ParamSpec("_P")
_Hidden = TypeVar("_Hidden", Reverted, Forgotten)
_T = TypeVar("_T")


def _writes(method: Callable[Concatenate[Map, _P], _T]) -> Callable[Concatenate[Map, _P], _T]:
    """Locks the map for writing while the method runs."""

    @wraps(method)
    def locked(self: Map, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        with self.writing():
            return method(self, *args, **kwargs)

    return locked


@dataclass(frozen=True, slots=True, eq=False)
class _Contents:
    """The records of a map that are read once."""

    graph: ExperienceGraph
    path_memory: PathMemory
    attempts: Attempts
    last_iterations: Mapping[SessionId, int]

    @staticmethod
    def of(contents: MapContents) -> _Contents:
        graph = graph_of(contents.nodes, contents.edges)
        path_memory = PathMemory(graph)
        path_memory.add_all(contents.path_entries)
        return _Contents(
            graph,
            path_memory,
            contents.attempts,
            contents.last_iterations(),
        )


def _kept(load: Callable[[Connection, View], _T]) -> cached_property[_T]:
    """A property that is read on first use, and kept until the map is written to."""

    def read(self: Map) -> _T:
        return self._read(load)

    read.__doc__ = load.__doc__
    return cached_property(read)


class Map:
    """A map on disk as of one revision. A context manager; threads may share it.

    Readers and the writer never wait for each other: readers see the revisions committed when
    they opened the map. Records stay in memory once read. It is locked for writing while a
    revision is written.

    Attributes:
        frames: the frames of its nodes: a `LandmarkSource`.
    """

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

    def __init__(
        self,
        database: SqliteDatabase,
        *,
        at: int | str | None = None,
        writes: bool = False,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
    ) -> None:
        self._database = database
        self._lock: WriterLock | None = database.lock_for_writing() if writes else None
        try:
            with database.reading() as connection:
                self._view = View(resolve(connection, at, database.name))
            self.frames = FrameReader(database, self._view, cache_bytes)
            self._key_book = KeyBook(database, self._view) if writes else None
        except BaseException:
            self._release()
            raise
        self._pinned = at is not None
        self._contents_lock = threading.RLock()
        self._contents: _Contents | None = None
        self._derived: dict[tuple[object, ...], Any] = {}
        self._page_bytes = DEFAULT_BUDGET_BYTES
        self._writing: RevisionWriter | None = None
        self._laid_out: dict[NodeId, SE3] | None = None  # once the open revision is committed

    def close(self) -> None:
        """Closes files and threads, and releases the lock. Whatever needs the file is then refused.

        A session that is still open becomes interrupted.
        """
        try:
            self.frames.close()
            self._database.close()
        finally:
            self._release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @keywords(policy="ranking", map="maps")
    def robot(
        self,
        camera: StereoCamera,
        settings: Settings | None = None,
        *,
        name: str | None = None,
        maps: bool = False,
        remembers: bool = False,
        ranking: str = "recall",
        lanes: int = 2,
        rounds: int = 2,
        relocaliser: str | None = "fabmap",
        threads: int | None = None,
        memory_bytes: int | None = None,
    ) -> Robot:
        """A robot that localises in this map; see `Robot.step`.

        A robot that maps or remembers stores its drive as a session; closing the robot commits it
        as a revision. It sees its own nodes at once; maps opened after the commit show them.

        Args:
            camera: its rectified stereo camera; it may differ from those of the map.
            settings: the configuration; None for the defaults.
            name: name of the robot; required if its drives are stored.
            maps: whether it saves frames that it does not localise, on a separate thread with
                checkpoints. It is the map's only writer until it is closed. After a crash, the
                robot's next such drive first commits the saved part (`Saving.recovered`).
            remembers: whether to store its path and match attempts, by which later drives rank;
                implied by `maps`. They are kept in a file next to the map until the drive ends and
                no other process writes to the map.
            ranking: which nodes to try first: "recall", "path", "distance", …; key of
                `engram.ranking.POLICIES`.
            lanes: attempts in parallel (Np), >= 1.
            rounds: rounds of attempts per frame (Nr), >= 1; up to 32 when lost.
            relocaliser: how a lost robot is found: "fabmap", "signature" (net),
                "exhaustive"; None for none.
            threads: most threads of the robot, the caller's included; None: `lanes` + 2 to 4.
            memory_bytes: most memory of the map's landmarks and graph; None for about 300 MB.

        Raises:
            ConfigError: a keyword or the ranking is unknown, a number is out of range, the name
                is missing or not valid, or the threads are too few.
            InputError: the camera is not a `StereoCamera`.
            MapLockedError: it maps, and another process writes to the map.
            RevisionError: it stores its drive, and the map is open at an older revision.
            MapError: the map is closed.
        """
        from engram.robot.drive_session import RobotSetup
        from engram.robot.settings import RobotOptions, Settings
        from engram.robot.starting import robot_in

        self._database.check_open()
        asked = RobotOptions(
            ranking,
            lanes,
            rounds,
            relocaliser=relocaliser,
            threads=threads,
            memory_bytes=memory_bytes,
        )
        setup = RobotSetup(camera, settings or Settings(), asked, name)
        return robot_in(self, setup, maps=maps, remembers=remembers)

    # -- what it holds

    @property
    def location(self) -> str:
        """Path or address of the map, for messages."""
        return self._database.name

    @property
    def is_pinned(self) -> bool:
        """Whether it was opened at a given revision."""
        return self._pinned

    @property
    def revision(self) -> int:
        """Number of the newest visible revision; 0 for an empty map."""
        return self._view.at

    @property
    def graph(self) -> ExperienceGraph:
        """Its experience graph."""
        return self._read_contents().graph

    def read_graph(self) -> ExperienceGraph:
        """A graph that reads its nodes and edges by pages, as searches come to them.

        Dense indices are in the order of saving, and the same in each such graph of this revision.
        """
        return PagedGraph(self.pages, self._page_bytes)

    def bound_memory(self, size_bytes: int) -> None:
        """Bounds what decoded frames, and each graph read by pages from now on, take together.

        A sixth is for the graph, as by default.
        """
        self._page_bytes = size_bytes // 6
        self.frames.bound_cache(size_bytes - self._page_bytes)

    @property
    def pages(self) -> MapPages:
        """What graphs, paths and lessons are read from by pages."""
        return self.derived(_pages_of, self.revision)

    @property
    def lookups(self) -> Lookups:
        """What it has of given nodes, paths and sessions, without reading it whole."""
        return Lookups(self._database, self._view)

    @property
    def path_memory(self) -> PathMemory:
        """Its paths."""
        return self._read_contents().path_memory

    @property
    def attempts(self) -> Attempts:
        """The remembered attempts as of the reading of the graph.

        Their sessions are positions in `sessions`, their nodes dense indices of `graph`.
        """
        return self._read_contents().attempts

    @property
    def last_iterations(self) -> Mapping[SessionId, int]:
        """Newest iteration in `attempts` by session, for sessions that have any."""
        return self._read_contents().last_iterations

    @cached_property
    def sessions(self) -> dict[SessionId, Session]:
        """The map's sessions by id, in the order in which they were added."""
        return {one.id: one for one in self._read(reading.load_sessions)}

    def named_session(self, prefix: str) -> Session:
        """The one session whose UUID begins with `prefix`.

        Raises:
            InputError: no session or several match.
        """
        known, wanted = self.sessions.values(), prefix.strip().lower()
        found = [one for one in known if wanted and str(one.id).startswith(wanted)]
        if len(found) != 1:
            listed = ", ".join(f"{str(one.id)[:8]} ({one.robot})" for one in found or known)
            raise InputError(f"{len(found)} sessions begin with {prefix!r}; choose from: {listed}")
        return found[0]

    # What is read once; see the functions.
    amendments = _kept(reading.load_amendments)
    removals = _kept(marks.load_removals)
    seen_removals = _kept(marks.seen_removals)
    seen_goals = _kept(marks.seen_goals)
    anchors = _kept(marks.load_anchors)
    goals = _kept(marks.load_goals)
    vocabulary = _kept(reading.load_vocabulary)
    descriptor = _kept(reading.descriptor_of)
    frontends = _kept(reading.frontends_of_sessions)
    omissions = _kept(reading.load_omissions)
    landmark_hashes = _kept(reading.landmark_hashes)
    partial_paths = _kept(reading.partial_paths)
    forgotten = _kept(load_names)

    @cached_property
    def placements(self) -> dict[NodeId, SE3]:
        """The stored ``map_from_node`` of nodes; `frame` also places the others."""
        return self._read(marks.load_placements)

    def read_placements(self) -> dict[NodeId, SE3]:
        """`placements`, with those that an open revision has written by now."""
        return self._read(marks.load_placements)

    @property
    def frame(self) -> MapFrame:
        """The map frame: where its nodes and goals lie, for messages, display and exports."""
        with reading_rows(self.location):
            return self.derived(frame_of, self.revision)

    def placed(self) -> PlacedNodes:
        """All nodes that have a place in the map frame, in columns."""
        return self._read(load_placed)

    def sized(self) -> SizedNodes:
        """All nodes with their sizes, in columns."""
        return self._read(load_sized)

    def layout(self) -> Layout:
        """The places of all nodes in the map frame: all of the map is read for it."""
        with reading_rows(self.location):
            return self.derived(layout_of)

    @cached_property
    def cameras(self) -> dict[CameraId, StereoCamera]:
        """The cameras of its sessions, by id."""
        with self._database.reading() as connection:
            return {one.id: one for one in reading.load_cameras(connection).values()}

    def words(self, vocabulary: bytes, some: Sequence[NodeId]) -> dict[NodeId, NDArray[np.int32]]:
        """The stored words (n,) of some nodes by the vocabulary of this hash, rising.

        Damaged rows are left out: words can be computed again from the landmarks.
        """
        return load_words(self._database, vocabulary, some)

    def words_between(
        self, vocabulary: bytes, first: int, last: int
    ) -> dict[int, NDArray[np.int32]]:
        """The stored words (n,) of nodes by key, as `words`, of hidden nodes, too."""
        with self._database.reading() as connection:
            return load_words_between(connection, vocabulary, first, last)

    def place_blocks(self, vocabulary: bytes, recogniser: str) -> StoredBlocks:
        """The blocks that it stores for a place recogniser.

        Args:
            vocabulary: hash (16 bytes) of the vocabulary.
            recogniser: `StoresBlocks.stored_as`.
        """
        return StoredBlocks(self._database, vocabulary, recogniser)

    @property
    def settled_nodes(self) -> int:
        """Largest key below which no node can go: those of committed revisions, but for gaps."""
        with self._database.reading() as connection:
            return settled_nodes(connection)

    def derived(
        self, make: Callable[Concatenate[Self, _P], _T], *args: _P.args, **kwargs: _P.kwargs
    ) -> _T:
        """A value derived from this map: made once for each set of arguments, then shared.

        Args:
            make: called with the map and the arguments, which are hashable.
        """
        key = (make, *args, *sorted(kwargs.items()))
        with self._contents_lock:
            if key not in self._derived:
                self._derived[key] = make(self, *args, **kwargs)
            found: _T = self._derived[key]
        return found

    def load(self) -> MapContents:
        """All current records, including what this process has checkpointed of an open session.

        Raises:
            MapCorruptError: a row does not match its checksum or points at nothing.
        """
        return self._read(reading.load)

    def node_count(self) -> int:
        """Number of nodes of the map."""
        return self._read(reading.node_count)

    def info(self) -> MapInfo:
        """Counts and sizes of the map."""
        with self._database.reading() as connection:
            return info(
                connection,
                self._view,
                size_bytes=self._database.size_bytes(),
            )

    def session_sizes(self) -> dict[SessionId, tuple[int, int]]:
        """Number of nodes and of path entries of each session."""
        return self._read(reading.session_sizes)

    def statistics(self) -> dict[str, dict[str, Any]]:
        """The newest value of each statistic of the map, by name."""
        return self._read(reading.load_statistics)

    def log(self) -> list[Revision]:
        """The visible committed revisions, oldest first."""
        return self._read(reading.log)

    def newest_revision(self, number: int | None = None) -> Revision | None:
        """The newest visible revision, up to a number; None if there is none."""
        with self._database.reading() as connection:
            up_to = self._view.at if number is None else number
            return reading.newest_revision(connection, self._view, up_to)

    def tags(self) -> dict[str, Tag]:
        """The tags of all revisions, including later ones than this view."""
        with self._database.reading() as connection:
            return load_tags(connection)

    def resolve(self, named: int | str | None) -> int:
        """Number of a revision, given by number, tag or `head`.

        Raises:
            RevisionError: there is none.
        """
        with self._database.reading() as connection:
            return resolve(connection, named, self._database.name)

    def diff(
        self, before: int | str, after: int | str, stretch_m: float = STRETCH_M
    ) -> MapDifference:
        """Compare two revisions.

        Args:
            before, after: their numbers or names.
            stretch_m: length of the stretches by which changes are listed.

        Raises:
            RevisionError: there is no such revision.
            InputError: the length is below 1 m, or not finite.
        """
        numbers = self.resolve(before), self.resolve(after)
        with self._database.reading() as connection:
            return difference(connection, *numbers, stretch_m)

    def origin(self, prefix: str) -> Origin:
        """The origin of a node, even of one that a revert has hidden.

        Args:
            prefix: its UUID, or enough of its beginning.

        Raises:
            InputError: no node or several match.
        """
        with self._database.reading() as connection:
            return origin_of(connection, self._view, prefix)

    def content_hash(self) -> str:
        """32 hexadecimal digits, equal for maps of equal content (method §7.5)."""
        with self._database.reading() as connection:
            return content_hash(connection, self._view.at)

    def verified_hash(self) -> str:
        """`content_hash`, worked out again from all rows.

        Raises:
            MapCorruptError: a stored one is another, or a row is damaged.
        """
        with self._database.reading() as connection:
            return verified_hash(connection, self._view.at)

    def totals(self) -> Totals:
        """What the map holds, in numbers."""
        return self._read(totals_of)

    def record_hashes(self) -> dict[str, str]:
        """Hash of each table's rows without revision metadata, 16 hexadecimal digits."""
        with self._database.reading() as connection:
            return record_hashes(connection, self._view.at)

    def session_state(self, session: SessionId) -> SessionState:
        """The state of a session in the map."""
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
        """Sessions whose writer ended before it committed, oldest first."""
        query = select(revisions).where(revisions.c.status == "open").order_by(revisions.c.key)
        with self._database.reading() as connection:
            opened = list(verified(revisions, connection.execute(query)))
            gone = [row for row in opened if not self._is_alive(row)]
            return [
                one for row in gone for one in interrupted_sessions(connection, row, self._view.at)
            ]

    def check(self) -> CheckReport:
        """Verifies every byte of the file; `check_map` also handles one that does not open."""
        return check(self._database)

    def forget(self) -> None:
        """Clears the cache, so that records are read again."""
        with self._contents_lock:
            self._contents = None
            self._derived.clear()
            for name in _KEPT:
                self.__dict__.pop(name, None)

    # -- writing

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
        ranges = own_rows(revision).ranges
        self._keys.begin_at({name: first for name, (first, _) in ranges.items()})
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
        number = self.resolve(named)
        if number == 0:
            raise RevisionError(f"{self._database.name}: there is no revision 0 to revert")
        said = f"revert revision {number}" + (f": {message}" if message else "")

        def reverted(connection: Connection, own: View, row: Row) -> Reverted:
            hide_revision(connection, self._keys, own, number, row["key"])
            revision = commit_revision(connection, row, *brought(connection, row))
            return compare(connection, number, self.revision, revision)

        about = {"author": author, "message": said, "configuration": {"revert": number}}
        return self._hide(reverted, about, dry_run=dry_run)

    @_writes
    def forget_nodes(
        self,
        chosen: Chosen,
        bridges: Sequence[Edge] = (),
        *,
        author: str,
        message: str,
        configuration: Mapping[str, Any],
        dry_run: bool = False,
    ) -> Forgotten:
        """Forgets nodes, by a revision that hides them; `erase_map` then removes their bytes.

        What is forgotten is not taken in again until that revision is reverted.

        Args:
            chosen: what goes.
            bridges: edges over it between nodes that stay.
            author: the person or robot.
            message: reason.
            configuration: how it was chosen, plain JSON data.
            dry_run: only report the result.

        Raises:
            NothingToForgetError: it holds nothing of what is chosen.
            RevisionError: a session is being written.
            StorageFullError: no space; the map is unchanged.
        """

        def forgotten(connection: Connection, own: View, row: Row) -> Forgotten:
            gone = hide_chosen(connection, self._keys, own, row["key"], chosen)
            if not any(gone.values()):
                raise NothingToForgetError(f"{self.location} holds nothing that is to be forgotten")
            write_bridges(connection, self._keys, row["key"], bridges)
            revision = commit_revision(connection, row, *brought(connection, row))
            return result_of(connection, revision.number, gone, len(bridges))

        about = {"author": author, "message": message, "configuration": configuration}
        return self._hide(forgotten, about, dry_run=dry_run)

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
    def put_place_block(
        self, vocabulary: bytes, recogniser: str, number: int, parts: Parts
    ) -> None:
        """Stores a block of places in one transaction; no revision, as `put_words`.

        Args:
            vocabulary: hash (16 bytes) of the vocabulary.
            recogniser: `StoresBlocks.stored_as`.
            number: of the block, all of whose nodes are `settled_nodes`.
            parts: its content by part, see `engram.maps.place_blocks`.

        Raises:
            StorageFullError: no space; the map is unchanged.
        """
        with self._database.writing() as connection:
            write_block(connection, block_rows(vocabulary, recogniser, number, parts))

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

    # -- inside

    def _hide(
        self,
        write: Callable[[Connection, View, Row], _Hidden],
        about: Mapping[str, Any],
        *,
        dry_run: bool,
    ) -> _Hidden:
        """Commits a revision that hides rows, in one transaction.

        Args:
            write: writes and commits it, given its view and its row; returns what was done.
            about: author, message and configuration.
            dry_run: undo all of it; the result then has no revision.
        """
        self._check_none_open()
        row = new_revision(self._keys, self._holder, **about)
        try:
            with self._database.writing() as connection:
                connection.execute(insert(revisions), [sealed(revisions, row)])
                done = write(connection, View(self._view.at, row["key"]), row)
                if dry_run:
                    raise _DryRunError
        except _DryRunError:
            return replace(done, revision=None)
        self.frames.forget()
        self.forget()
        self._keys.forget_nodes()
        self._see(View(self.resolve(None)))
        return done

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

    def _look_from(self, view: View, placements: dict[NodeId, SE3] | None = None) -> None:
        """Changes the visible revision; the graph and the paths stay as they are.

        Args:
            view: what is visible now.
            placements: those of this revision where they are known already.
        """
        self._view = view
        sessions = self.__dict__.get("sessions") if self._contents else None
        for name in _KEPT:
            self.__dict__.pop(name, None)
        if sessions is not None:  # attempts refer to them by position
            self.__dict__["sessions"] = sessions
        if placements is not None:
            self.__dict__["placements"] = placements
        self.frames.set_view(view)

    def _read(self, load: Callable[[Connection, View], _T]) -> _T:
        with self._database.reading() as connection:
            return load(connection, self._view)

    def _read_contents(self) -> _Contents:
        self._database.check_open()
        with self._contents_lock:
            if self._contents is None:
                with no_collections(), reading_rows(self.location):
                    found = self.load()
                    self._contents = _Contents.of(found)
                # Attempts refer to sessions by position: both must be read together.
                self.__dict__["sessions"] = {one.id: one for one in found.sessions}
            return self._contents

    def _is_alive(self, revision: Row) -> bool:
        holder = self._database.writer()
        return holder is not None and holder.token == revision["writer"]


# Read again after a write.
_KEPT = tuple(name for name, one in vars(Map).items() if isinstance(one, cached_property))


class _DryRunError(Exception):
    """Ends a transaction without committing it."""


def _pages_of(opened: Map, revision: int) -> MapPages:
    del revision  # it tells these pages from those of another one
    return MapPages(opened._database, opened._view)


@keywords()
def open_map(path: Path | str, at: int | str | None = None, create: bool = False) -> Map:
    """Opens a map for localising, writing or reading.

    Until it is written to, the map stays as it is now, whatever others commit: open it again to see
    later revisions. A robot stays with the map that it began in.

    Args:
        path: NAME.engram.
        at: number or name of a revision (7, a tag, "head~2"), to see the map as it was then; None
            for the newest.
        create: create an empty map if the file does not exist and no revision is named.

    Raises:
        NotAMapError: the file does not exist, or is not a map.
        FormatVersionError: a newer Engram wrote it.
        MapCorruptError: it is too damaged to read.
        RevisionError: there is no such revision.
        InputError: a map is to be created, and its folder does not exist.
        ConfigError: a keyword is unknown.
    """
    if create and at is None and not map_path(path).exists():
        Map.create(path).close()
    return Map.open(path, at=at)
