"""The reading half of a map, as of one revision."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, select

from engram.errors import InputError
from engram.frontend.frame import DescriptorKind
from engram.geometry.cameras import CameraId, StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.basin import BasinCounts
from engram.graph.graph import ExperienceGraph
from engram.graph.model import (
    Amendment,
    Anchor,
    EdgeKind,
    Goal,
    NodeId,
    Omission,
    PathId,
    Removal,
    Session,
    SessionId,
)
from engram.graph.paths import Attempts, PathMemory
from engram.maps import marks, reading
from engram.maps.attempts import load_words
from engram.maps.checking import check
from engram.maps.content import content_hash, record_hashes, verified_hash
from engram.maps.difference import STRETCH_M, MapDifference, difference
from engram.maps.frame_reader import FrameReader
from engram.maps.map_frame import MapFrame, frame_of, graph_of
from engram.maps.origins import Origin, origin_of
from engram.maps.records import (
    CheckReport,
    InterruptedSession,
    MapContents,
    MapInfo,
    Revision,
    SessionState,
)
from engram.maps.revisions import interrupted_sessions, session_and_revision
from engram.maps.rows import Row, verified
from engram.maps.schema import revisions
from engram.maps.sqlite import SqliteDatabase, reading_rows
from engram.maps.tags import Tag, load_tags, resolve
from engram.maps.totals import Totals, info, totals_of
from engram.maps.view import View


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


_P = ParamSpec("_P")
_T = TypeVar("_T")

# Cached properties to clear after a write.
_SMALL = (
    "amendments",
    "removals",
    "seen_removals",
    "goals",
    "seen_goals",
    "anchors",
    "placements",
    "cameras",
    "vocabulary",
    "descriptor",
    "frontends",
    "omissions",
    "landmark_hashes",
    "blob_sizes",
    "partial_paths",
)


@dataclass(frozen=True, slots=True, eq=False)
class _Contents:
    """The records of a map that are read once; the graph and the paths grow with writes."""

    graph: ExperienceGraph
    path_memory: PathMemory
    attempts: Attempts
    basin_counts: BasinCounts
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
            contents.basin_counts(graph.experiences),
            contents.last_iterations(),
        )


class MapReader:
    """A map as of one revision; the reading part of `Map`.

    Records stay in memory once read. The graph and the paths are read once, and grow with what this
    process writes.

    Attributes:
        frames: the frames of its nodes: a `LandmarkSource`.
    """

    def __init__(self, database: SqliteDatabase, *, at: int | str | None, cache_bytes: int) -> None:
        self._database = database
        with database.reading() as connection:
            self._view = View(resolve(connection, at, database.name))
        self._pinned = at is not None
        self.frames = FrameReader(database, self._view, cache_bytes)
        self._contents_lock = threading.RLock()
        self._contents: _Contents | None = None
        self._derived: dict[tuple[object, ...], Any] = {}

    def close(self) -> None:
        """Closes files and threads."""
        self.frames.close()
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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
    def basin_counts(self) -> BasinCounts:
        """Counts of `attempts`, from which match basins are learnt."""
        return self._read_contents().basin_counts

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

    @cached_property
    def amendments(self) -> tuple[Amendment, ...]:
        """Amendments of its sessions, in the order in which they apply."""
        return self._read(reading.load_amendments)

    @cached_property
    def removals(self) -> tuple[Removal, ...]:
        """Edges that no longer count, oldest first."""
        return self._read(marks.load_removals)

    @cached_property
    def seen_removals(self) -> set[tuple[NodeId, NodeId, EdgeKind, int]]:
        """Keys of all removals that ever counted, reverted ones included."""
        return self._read(marks.seen_removals)

    @cached_property
    def placements(self) -> dict[NodeId, SE3]:
        """The stored ``map_from_node`` of nodes; `frame` also places the others."""
        return self.read_placements()

    def read_placements(self) -> dict[NodeId, SE3]:
        """`placements`, with those that an open revision has written by now."""
        return self._read(marks.load_placements)

    @property
    def frame(self) -> MapFrame:
        """The map frame: where its nodes and goals lie, for messages, display and exports."""
        with reading_rows(self.location):
            return self.derived(frame_of, self.revision, len(self.graph))

    def grown_graph(self) -> ExperienceGraph | None:
        """The graph in memory if it has all nodes of the map; None if it would have to be read."""
        known = self._contents
        whole = known is not None and len(known.graph) == self.node_count()
        return known.graph if known is not None and whole else None

    @cached_property
    def seen_goals(self) -> tuple[Goal, ...]:
        """All goals that it ever had, replaced, removed and reverted ones included."""
        return self._read(marks.seen_goals)

    @cached_property
    def anchors(self) -> tuple[Anchor, ...]:
        """Its anchors: those of the last anchoring."""
        return self._read(marks.load_anchors)

    @cached_property
    def goals(self) -> dict[str, Goal]:
        """Its goals by name."""
        return self._read(marks.load_goals)

    @cached_property
    def cameras(self) -> dict[CameraId, StereoCamera]:
        """The cameras of its sessions, by id."""
        with self._database.reading() as connection:
            return {one.id: one for one in reading.load_cameras(connection).values()}

    @cached_property
    def vocabulary(self) -> bytes | None:
        """The newest vocabulary of the map, encoded; None if there is none.

        Raises:
            MapCorruptError: it does not match its hash.
        """
        return self._read(reading.load_vocabulary)

    @cached_property
    def descriptor(self) -> DescriptorKind | None:
        """Kind of all descriptors of the map; None before its first session."""
        return self._read(reading.descriptor_of)

    @cached_property
    def frontends(self) -> dict[SessionId, tuple[DescriptorKind, str]]:
        """Descriptor kind and hash of the front-end of each session."""
        return self._read(reading.frontends_of_sessions)

    @cached_property
    def omissions(self) -> dict[NodeId, Omission]:
        """Nodes that merges omitted, by id, without those whose equivalents are hidden.

        Raises:
            MapCorruptError: a row does not match its checksum.
        """
        return self._read(reading.load_omissions)

    @cached_property
    def landmark_hashes(self) -> dict[NodeId, bytes]:
        """Hash (16 bytes) of each node's landmarks.

        Includes omitted nodes whose hash was stored.
        """
        return self._read(reading.landmark_hashes)

    def known_among(self, some: Sequence[bytes]) -> frozenset[bytes]:
        """The UUIDs whose nodes are held or were omitted, and need not be handed in."""
        with self._database.reading() as connection:
            return reading.known_among(connection, self._view, some)

    @cached_property
    def blob_sizes(self) -> dict[NodeId, tuple[int, int]]:
        """Size in bytes of each node's landmarks and of its thumbnail."""
        return self._read(reading.blob_sizes)

    @cached_property
    def partial_paths(self) -> frozenset[PathId]:
        """Paths some of whose entries are not in this map."""
        return self._read(reading.partial_paths)

    def words(self, vocabulary: bytes) -> Mapping[NodeId, NDArray[np.int32]]:
        """The stored words (n,) of nodes by the vocabulary of this hash, rising.

        Damaged rows are left out: words can be computed again from the landmarks.
        """
        with self._database.reading() as connection:
            return load_words(connection, vocabulary)

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
            old, new = (reading.load(connection, View(number)) for number in numbers)
        return difference(numbers[0], old, numbers[1], new, stretch_m)

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
            for name in (*_SMALL, "sessions"):
                self.__dict__.pop(name, None)

    def _look_from(self, view: View, placements: dict[NodeId, SE3] | None = None) -> None:
        """Changes the visible revision; the graph and the paths stay as they are.

        Args:
            view: what is visible now.
            placements: those of this revision where they are known already.
        """
        self._view = view
        for name in _SMALL if self._contents else (*_SMALL, "sessions"):
            self.__dict__.pop(name, None)
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
