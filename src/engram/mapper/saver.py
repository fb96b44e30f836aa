"""Saving on its own thread, so that it never delays the next frame ([L15] Fig. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from queue import Full, Queue
from threading import Thread
from typing import Protocol

from engram.errors import MapError
from engram.frontend import Frame
from engram.graph.model import Attempt, Edge, Node, PathEntry
from engram.maps import RevisionWriter
from engram.maps.frame_reader import FrameReader
from engram.places.words import NodeWords

# Most frames that wait to be written, about 40 MB; beyond it a slow disk slows the drive.
_QUEUE_LENGTH = 1000


class PathWriter(Protocol):
    """Where a session's path and attempts go: a map, or a spool."""

    def add_path_entry(self, entry: PathEntry) -> None:
        """Adds a step of the session's path."""
        ...

    def add_attempts(self, made: list[Attempt]) -> None:
        """Adds remembered attempts."""
        ...

    def checkpoint(self) -> None:
        """Makes everything added so far durable."""
        ...


@dataclass(frozen=True, slots=True)
class Records:
    """What one live frame adds to the map."""

    node: Node | None = None
    frame: Frame | None = None
    edges: Sequence[Edge] = ()
    path_entries: Sequence[PathEntry] = ()
    attempts: list[Attempt] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.node or self.edges or self.path_entries or self.attempts)


@dataclass(slots=True)
class _Stop:
    """The last thing in the queue."""


@dataclass(frozen=True, slots=True)
class NodeSaver:
    """Saves nodes and edges.

    Attributes:
        writer: writes them.
        frames: keeps frames readable until they are written.
        words: finds the words stored with saved nodes; None stores none.
    """

    writer: RevisionWriter
    frames: FrameReader
    words: NodeWords | None = None

    def hold(self, records: Records) -> None:
        """Keeps the frame of a node readable from now on."""
        if records.node is not None and records.frame is not None:
            self.frames.hold(records.node.id, records.frame)

    def write(self, records: Records) -> None:
        """Writes a node with its frame and words, and edges."""
        if records.node is not None and records.frame is not None:
            self.writer.add_node(records.node, records.frame)
            if self.words is not None:
                found = self.words.of_frame(records.frame)
                self.writer.add_words(records.node.id, self.words.hash, found)
        for edge in records.edges:
            self.writer.add_edge(edge)


@dataclass(slots=True)
class Saver:
    """Writes records in order, and checkpoints at intervals.

    The next call of `put` or `finish` raises an error of the writer. Later records are dropped: a
    shorter session is better than one with holes.

    Attributes:
        writer: where path entries and attempts go.
        nodes: where nodes and edges go; None for a memory, which has none.
        checkpoint_every: live frames between two checkpoints; a crash loses at most these.
        waits: whether a full queue blocks the caller; else it raises.
    """

    writer: PathWriter
    nodes: NodeSaver | None = None
    checkpoint_every: int = 20
    waits: bool = True
    _queue: Queue[Records | _Stop] = field(default_factory=lambda: Queue(_QUEUE_LENGTH))
    _error: BaseException | None = None
    _thread: Thread | None = None

    def __post_init__(self) -> None:
        self._thread = Thread(target=self._run, name="engram-saver", daemon=True)
        self._thread.start()

    def put(self, records: Records) -> None:
        """Queues what one frame adds to the map.

        The frame of a node is readable from then on, even if it is never written.

        Raises:
            MapError: an earlier write failed, or too many wait to be written.
        """
        self.hold(records)
        self._raise_error()
        try:
            self._queue.put(records, block=self.waits)
        except Full:
            raise MapError(
                f"{_QUEUE_LENGTH} frames wait to be saved: the disk is too slow for this drive"
            ) from None

    def hold(self, records: Records) -> None:
        """Keeps the frame of a node readable until it is put and written."""
        if self.nodes is not None:
            self.nodes.hold(records)

    def finish(self) -> None:
        """Writes the rest, checkpoints and ends the thread.

        Raises:
            MapError: a write failed.
        """
        if self._thread is not None:
            self._queue.put(_Stop())
            self._thread.join()
            self._thread = None
        self._raise_error()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        since_checkpoint = 0
        while True:
            records = self._queue.get()
            stopping = isinstance(records, _Stop)
            if self._error is None:
                try:
                    if isinstance(records, Records):
                        self._write(records)
                        since_checkpoint += 1
                    if stopping or since_checkpoint >= self.checkpoint_every:
                        self.writer.checkpoint()
                        since_checkpoint = 0
                except BaseException as error:  # raised again in the caller's thread
                    self._error = error
            if stopping:
                return

    def _write(self, records: Records) -> None:
        if self.nodes is not None:
            self.nodes.write(records)
        for entry in records.path_entries:
            self.writer.add_path_entry(entry)
        if records.attempts:
            self.writer.add_attempts(records.attempts)
