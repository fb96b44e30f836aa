"""A drive's memory in a file next to the map, until the map's writer is free.

A robot that only remembers needs the map's writer at the end of its drive, not throughout: others
may map meanwhile. So its path and attempts go to a separate file, which also survives a crash. The
next process that finds the writer free commits them as a session.

The file is a sequence of chunks: length and CRC-32 of the body, each a little-endian uint32, then
the body, compressed MessagePack. The first chunk is the header. A chunk torn by a crash ends the
file.
"""

from __future__ import annotations

import fcntl
import glob
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import IO, Any
from uuid import UUID

import msgspec

from engram.errors import MapCorruptError, MapError, storage_full
from engram.frontend.frame import DescriptorKind, Frame
from engram.geometry.cameras import StereoCamera
from engram.graph.model import (
    Attempt,
    Clock,
    NodeId,
    PathEntry,
    PathEntryKind,
    Removal,
    Session,
    SessionId,
    path_id,
)
from engram.mapper.mapper import Records
from engram.maps.map import Map, open_map
from engram.maps.records import Revision, SessionState
from engram.maps.rows import camera_from_row, camera_row
from engram.maps.writer import RevisionWriter

_CHUNK = struct.Struct("<II")
_VERSION = 1


@dataclass(frozen=True, slots=True)
class SessionHeader:
    """A drive, as the revision that saves it states it.

    Attributes:
        configuration: the resolved settings, plain JSON data.
        message: text for ``log``.
        author: the person or robot; empty for the robot.
    """

    session: Session
    camera: StereoCamera
    descriptor: DescriptorKind
    frontend: str
    configuration: dict[str, Any]
    message: str
    author: str = ""

    def begin(self, opened: Map) -> RevisionWriter:
        """Begins the session in a map that is open for writing."""
        return opened.begin_session(
            self.session,
            self.camera,
            descriptor=self.descriptor,
            frontend=self.frontend,
            author=self.author or self.session.robot,
            configuration=self.configuration,
            message=self.message,
        )

    def begin_or_resume(self, opened: Map) -> RevisionWriter:
        """The same; continues what an interrupted run has stored."""
        if opened.session_state(self.session.id) is SessionState.INTERRUPTED:
            return opened.resume_session(self.session.id)
        return self.begin(opened)


class Spool:
    """Writes one drive's memory; a `Sink` of a session without nodes.

    Args:
        map_path: the map; the file lies next to it.
        most_bytes: largest size; later records are dropped.
    """

    def __init__(self, map_path: Path, header: SessionHeader, most_bytes: int) -> None:
        self.path = map_path.with_name(f"{map_path.name}-memory-{header.session.id}")
        self._map_path = map_path
        self._most_bytes = most_bytes
        self._entries: list[PathEntry] = []
        self._attempts: list[Attempt] = []
        with _as_map_errors(self.path):
            self._file: IO[bytes] = _opened(self.path, os.O_CREAT | os.O_RDWR | os.O_TRUNC)
        self._append(
            {
                "version": _VERSION,
                "session": asdict(header.session),
                "camera": camera_row(header.camera, 0),
                "descriptor": header.descriptor,
                "frontend": header.frontend,
                "configuration": header.configuration,
            }
        )

    @property
    def full(self) -> bool:
        """Whether it has reached its largest size and drops further records."""
        return self._file.tell() >= self._most_bytes

    def hold(self, node: NodeId, frame: Frame) -> None:
        """See `Sink`; there are no nodes."""

    def add(self, records: Records, entry: PathEntry | None) -> None:
        """See `Sink`."""
        if entry is not None:
            self._entries.append(entry)
        self._attempts += records.attempts

    def checkpoint(self) -> None:
        """See `Sink`."""
        if (self._entries or self._attempts) and not self.full:
            entries, attempts = ([astuple(x) for x in y] for y in (self._entries, self._attempts))
            self._append({"entries": entries, "attempts": attempts})
        self._entries, self._attempts = [], []

    def close(self) -> None:
        """Closes the file; from now on it may be committed."""
        self._file.close()

    def commit(self, removals: Sequence[Removal] = ()) -> Revision | None:
        """Commits the memory, and others that wait next to the map; None if it adds nothing.

        Raises:
            MapLockedError: another process writes to the map; the memory waits.
        """
        del removals  # a drive that is only remembered disproves no edge
        return commit_spools(self._map_path).get(self.path)

    def leave(self) -> None:
        """Drops the memory."""
        self.path.unlink(missing_ok=True)

    def _append(self, content: dict[str, Any]) -> None:
        body = zlib.compress(msgspec.msgpack.encode(content))
        with _as_map_errors(self.path):
            self._file.write(_CHUNK.pack(len(body), zlib.crc32(body)) + body)
            self._file.flush()
            os.fsync(self._file.fileno())


def commit_spools(map_path: Path) -> dict[Path, Revision]:
    """Commits the memories next to a map, each as a session without nodes; returns the revisions.

    Memories of running drives are left alone. Entries and attempts of nodes that the map no longer
    shows are left out.

    Raises:
        MapLockedError: another process writes to the map; the memories wait.
    """
    spools = sorted(map_path.parent.glob(f"{glob.escape(map_path.name)}-memory-*"))
    if not spools:
        return {}
    committed = {}
    with open_map(map_path) as opened, opened.writing():
        for path in spools:
            with suppress(BlockingIOError, FileNotFoundError), _opened(path, os.O_RDONLY) as file:
                revision = _commit(opened, _chunks(file, path), path)
                path.unlink()
                if revision is not None:
                    committed[path] = revision
    return committed


def _commit(opened: Map, chunks: Iterator[dict[str, Any]], path: Path) -> Revision | None:
    """The revision; None if the memory is empty or already in the map."""
    stored = next(chunks, None)
    if stored is None:
        return None  # killed before the header was written
    if stored["version"] != _VERSION:
        raise MapError(f"{path} was written by a newer Engram; upgrade to commit it")
    graph, session = opened.graph, _session(stored["session"])
    entries, attempts = list[PathEntry](), list[Attempt]()
    for chunk in chunks:
        visits = (_entry(session, row) for row in chunk["entries"])
        entries += [entry for entry in visits if entry.node in graph]
        made = (_attempt(row) for row in chunk["attempts"])
        attempts += [one for one in made if one.reference in graph and one.node in graph]
    known = opened.session_state(session.id) is SessionState.COMMITTED
    if known or not (entries or attempts):
        return None
    header = SessionHeader(
        session,
        camera_from_row(stored["camera"]),
        DescriptorKind(stored["descriptor"]),
        stored["frontend"],
        stored["configuration"],
        f"memory of {session.robot}",
    )
    writer = header.begin_or_resume(opened)
    for entry in entries:
        if entry.sequence >= writer.stored.next_sequence:
            writer.add_path_entry(entry)
    first = writer.stored.next_iteration
    writer.add_attempts([attempt for attempt in attempts if attempt.iteration >= first])
    return writer.commit()


def _entry(session: Session, row: list[Any]) -> PathEntry:
    _, sequence, node, kind, stamp_ns = row
    kind = PathEntryKind(kind)
    return PathEntry(path_id(session.id), sequence, NodeId(UUID(node)), kind, stamp_ns)


def _attempt(row: list[Any]) -> Attempt:
    iteration, reference, node, *rest = row
    return Attempt(iteration, NodeId(UUID(reference)), NodeId(UUID(node)), *rest)


def _session(values: dict[str, Any]) -> Session:
    fields = {**values, "id": SessionId(UUID(values["id"])), "clock": Clock(values["clock"])}
    return Session(**fields)


def _chunks(file: IO[bytes], path: Path) -> Iterator[dict[str, Any]]:
    """The intact chunks of a memory."""
    while len(head := file.read(_CHUNK.size)) == _CHUNK.size:
        length, checksum = _CHUNK.unpack(head)
        body = file.read(length)
        if len(body) < length or zlib.crc32(body) != checksum:
            return
        try:
            yield msgspec.msgpack.decode(zlib.decompress(body))
        except (msgspec.DecodeError, zlib.error) as error:
            raise MapCorruptError(f"{path} is not a memory of a drive: {error}") from error


def _opened(path: Path, flags: int) -> IO[bytes]:
    """A regular file, locked for this process.

    Raises:
        BlockingIOError: another process holds it.
    """
    file = os.fdopen(os.open(path, flags | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666),
                     "rb" if flags == os.O_RDONLY else "r+b")  # fmt: skip
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise
    return file


@contextmanager
def _as_map_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        full = storage_full(error, path)
        raise full or MapError(f"{path} cannot be written: {error.strerror}") from error
