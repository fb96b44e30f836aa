"""Records of a map in addition to those of `engram.graph`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from engram.frontend.frame import DescriptorKind, FrameStatus
from engram.geometry.cameras import CameraId, StereoCamera
from engram.graph.model import Edge, Node, PathEntry, Session, SessionId
from engram.graph.paths import Attempts


class RevisionStatus(StrEnum):
    """The state of a revision."""

    OPEN = "open"
    COMMITTED = "committed"
    ABANDONED = "abandoned"


class SessionState(StrEnum):
    """The state of a session in a map."""

    ABSENT = "absent"
    OPEN = "open"
    INTERRUPTED = "interrupted"
    COMMITTED = "committed"


@dataclass(frozen=True, slots=True)
class Revision:
    """One committed step of a map's history.

    Attributes:
        number: as in `--at`; 1 is the first.
        parent: number of the revision before; None for the first.
        author: the person or robot.
        message: reason; "" without one.
        tool_version: version of Engram that wrote it.
        configuration: the resolved settings.
        opened_ns, committed_ns: times, UTC, ns.
        host: name of the writing computer.
        contents: number of rows that it added to each table, and `mapped_m`, the metres of its
            odometry edges.
    """

    number: int
    parent: int | None
    author: str
    message: str
    tool_version: str
    configuration: Mapping[str, Any]
    opened_ns: int
    committed_ns: int
    host: str
    contents: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class InterruptedSession:
    """A session whose writer ended before it committed: resume it or seal it.

    Attributes:
        session: the drive.
        author, host, pid, opened_ns: the writer, its computer and its start (UTC, ns); `pid` is 0
            if it left the session on purpose.
        nodes: number of checkpointed nodes.
        last_stamp_ns: stamp of the newest of them; None without nodes.
        live: whether a live robot mapped it, whose frames do not come again.
    """

    session: Session
    author: str
    host: str
    pid: int
    opened_ns: int
    nodes: int
    last_stamp_ns: int | None
    live: bool = False


@dataclass(frozen=True, slots=True)
class StoredSession:
    """The stored part of an open session, from which a resumed mapper continues.

    Attributes:
        nodes: its nodes in order of saving.
        last_entry: the newest entry of its path; None if it has none.
        next_sequence: sequence number of its next path entry.
        next_iteration: one past the newest iteration of its attempts.
        attempts: number of its attempts.
    """

    nodes: tuple[Node, ...] = ()
    last_entry: PathEntry | None = None
    next_sequence: int = 0
    next_iteration: int = 0
    attempts: int = 0

    @property
    def last_stamp_ns(self) -> int | None:
        """Newest stamp among nodes and path entries; None if there are none."""
        stamps_ns = [node.stamp_ns for node in self.nodes[-1:]]
        if self.last_entry is not None:
            stamps_ns.append(self.last_entry.stamp_ns)
        return max(stamps_ns, default=None)


@dataclass(frozen=True, slots=True, eq=False)
class StoredNode:
    """A node with its encoded landmarks, for copying.

    Attributes:
        node: the record.
        descriptor: kind of its descriptors.
        frontend: hash of the front-end that made its frame.
        status: status of its frame.
        landmark_hash: hash (16 bytes) of its landmarks.
        landmarks: the encoded landmarks.
        thumbnail: JPEG; None if none was saved.
    """

    node: Node
    descriptor: DescriptorKind
    frontend: str
    status: FrameStatus
    landmark_hash: bytes
    landmarks: bytes
    thumbnail: bytes | None


@dataclass(frozen=True, slots=True, eq=False)
class MapContents:
    """All records of a map except landmarks, in order of writing.

    Attributes:
        cameras: cameras of the sessions and nodes, by id.
        sessions, nodes: each once.
        edges: for each (a, b, kind) the newest only.
        path_entries: ordered by path, then sequence.
        attempts: all remembered attempts between visible nodes.
    """

    cameras: Mapping[CameraId, StereoCamera]
    sessions: tuple[Session, ...]
    nodes: tuple[Node, ...]
    edges: Sequence[Edge]
    path_entries: tuple[PathEntry, ...]
    attempts: Attempts

    def last_iterations(self) -> dict[SessionId, int]:
        """Newest remembered iteration by session, for sessions that have any."""
        made = self.attempts
        newest = np.flatnonzero(np.diff(made.session, append=-1))  # attempts are sorted by session
        return {
            self.sessions[place].id: iteration
            for place, iteration in zip(
                made.session[newest].tolist(), made.iteration[newest].tolist(), strict=True
            )
        }


@dataclass(frozen=True, slots=True)
class MapInfo:
    """Counts and sizes of a map.

    Attributes:
        revision: number of the newest visible revision; 0 for an empty map.
        descriptor: kind of all descriptors; None before the first session.
        cameras, sessions, nodes, edges, path_entries, attempts: number of visible ones.
        edges_of_kind: edges by kind.
        mapped_m: length of its odometry edges, metres.
        size_bytes: size of the file with its write-ahead log, or of the tables.
    """

    revision: int
    descriptor: DescriptorKind | None
    cameras: int
    sessions: int
    nodes: int
    edges: int
    edges_of_kind: Mapping[str, int]
    path_entries: int
    attempts: int
    mapped_m: float
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem that `check` found.

    Attributes:
        table: name of the table; "file" for the whole file.
        record: UUID, number or key of the row; "" for the whole table.
        fact: the fault.
    """

    table: str
    record: str
    fact: str

    def __str__(self) -> str:
        return (
            f"{self.table} {self.record}: {self.fact}"
            if self.record
            else f"{self.table}: {self.fact}"
        )


@dataclass(frozen=True, slots=True)
class CheckReport:
    """The result of `check`.

    Attributes:
        problems: empty for a sound map.
        rows, blobs: number verified.
        interrupted: sessions to be resumed or sealed; not a problem.
        abandoned_rows: rows of abandoned revisions still in the file, until `Map.clean`; not
            a problem.
        notes: what may be damage, or what a power cut leaves of a commit that had not finished.
    """

    problems: tuple[Problem, ...]
    rows: int
    blobs: int
    interrupted: tuple[SessionId, ...]
    abandoned_rows: int
    notes: tuple[str, ...] = ()

    @property
    def sound(self) -> bool:
        """Whether the map has no problems."""
        return not self.problems
