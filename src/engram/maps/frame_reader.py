"""Reads frames of a map's nodes on demand."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import bindparam, select

from engram.errors import InputError, MapCorruptError, MapError
from engram.frontend.blobs import blob_hash, decode_landmarks, decode_thumbnail, is_intact
from engram.frontend.frame import DescriptorKind, Frame, FrameStatus
from engram.geometry.cameras import StereoCamera
from engram.graph.model import Node, NodeId
from engram.maps.columns import Visible
from engram.maps.reading import load_cameras, load_frontends
from engram.maps.records import StoredNode
from engram.maps.rows import Row, verified
from engram.maps.schema import frames, nodes
from engram.maps.sqlite import SqliteDatabase, reading_rows
from engram.maps.view import View

DEFAULT_CACHE_BYTES = 256 * 2**20
# Of a landmark in memory: 2 + 1 + 1 + 3 floats, descriptor, octave.
_BYTES_PER_LANDMARK = 29  # its descriptor not counted
_BYTES_PER_FRAME = 1500
# Stored nodes read at a time: about 2 MB.
_STORED_BATCH = 64


class FrameReader:
    """A thread-safe `LandmarkSource` over a map, with a bounded cache and a read-ahead thread.

    Args:
        database: the map's database.
        view: the visible nodes.
        cache_bytes: largest size of the decoded frames; the least recently used are dropped.
    """

    def __init__(
        self, database: SqliteDatabase, view: View, cache_bytes: int = DEFAULT_CACHE_BYTES
    ) -> None:
        self._database = database
        self._cache_bytes = cache_bytes
        self._cache: OrderedDict[NodeId, Frame] = OrderedDict()
        self._cached_bytes = 0
        self._held: dict[NodeId, Frame] = {}
        self._lock = threading.Lock()
        self._wanted: deque[NodeId] = deque()
        self._wanted_changed = threading.Condition(self._lock)
        self._thread: threading.Thread | None = None
        self._closed = False
        self._hidden: frozenset[Any] = frozenset()
        self.set_view(view)

    def frame(self, node: NodeId) -> Frame:
        """The frame of `node`, without its thumbnail.

        Raises:
            InputError: the map has no such node, or not yet in this revision.
            MapCorruptError: its bytes do not match their hash.
        """
        with self._lock:
            frame = self._held.get(node) or self._cache.get(node)
            if frame is not None:
                if node in self._cache:
                    self._cache.move_to_end(node)
                return frame
        with reading_rows(self._database.name):
            frame = self._read(node)
        self._remember(node, frame)
        return frame

    def thumbnail(self, node: NodeId) -> NDArray[np.uint8] | None:
        """The thumbnail of a node, (h, w) uint8 grey; None if none was saved.

        Raises:
            InputError: the map has no such node.
            MapCorruptError: its bytes are damaged.
        """
        with self._lock:
            held = self._held.get(node)
        if held is not None:
            return held.thumbnail
        key = self._node_row(node)[0]["key"]
        if key in self._without_pictures:
            return None
        with self._database.reading() as connection:
            rows = connection.execute(select(frames).where(frames.c.node == key))
            row = next(verified(frames, rows), None)
        if row is None:
            raise MapCorruptError(f"node {node}: its frame is missing")
        return None if row["thumbnail"] is None else decode_thumbnail(row["thumbnail"])

    def stored(self, wanted: Iterable[Node]) -> Iterator[StoredNode]:
        """Nodes with their encoded landmarks, in the order given, read in small batches.

        The bytes are checked against their hash and not decoded.

        Raises:
            InputError: the map has no such node, or not yet in this revision.
            MapCorruptError: the bytes do not match their hash.
        """
        remaining = iter(wanted)
        while batch := list(islice(remaining, _STORED_BATCH)):
            with self._database.reading() as connection:
                query = _WHOLE_NODES.where(nodes.c.uuid.in_([one.id.bytes for one in batch]))
                found = {row[_NODE_UUID]: row for row in connection.execute(query)}
            for one in batch:
                if one.id.bytes not in found:
                    raise InputError(f"the map has no node {one.id}")
                with reading_rows(self._database.name):
                    stored = self._stored_node(one, found[one.id.bytes])
                yield stored

    def decode(self, stored: StoredNode) -> Frame:
        """The frame of a stored node.

        Raises:
            MapCorruptError: the blob is malformed.
        """
        camera = next((c for c in self._cameras.values() if c.id == stored.node.camera), None)
        if camera is None:
            raise MapCorruptError(f"node {stored.node.id}: its camera is missing")
        try:
            landmarks = decode_landmarks(stored.landmarks, camera, stored.descriptor)
        except MapCorruptError as error:
            raise MapCorruptError(f"node {stored.node.id}: {error}") from error
        return Frame(
            stored.node.stamp_ns,
            camera,
            landmarks,
            stored.descriptor,
            stored.frontend,
            stored.status,
        )

    def prefetch(self, nodes: list[NodeId]) -> None:
        """Reads these nodes ahead; a newer call replaces pending work of an older one."""
        with self._wanted_changed:
            self._wanted = deque(
                node for node in nodes if node not in self._cache and node not in self._held
            )
            if not self._wanted:
                return  # as nearly always: waking the thread would take the lock of Python away
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(
                    target=self._read_ahead, name="engram-read-ahead", daemon=True
                )
                self._thread.start()
            self._wanted_changed.notify()

    def hold(self, node: NodeId, frame: Frame) -> None:
        """Holds the frame of a node that is not yet in the database."""
        with self._lock:
            self._held[node] = frame

    def release(self, stored: list[NodeId]) -> None:
        """Treats these frames as ordinary cache entries, since they are now in the database."""
        for node in stored:
            with self._lock:
                frame = self._held.pop(node, None)
            if frame is not None:
                self._remember(node, frame)

    def show(self, rows: Sequence[Row]) -> None:
        """Makes nodes of these written `hidden` rows readable again."""
        shown = {row["target"] for row in rows if row["record"] == nodes.name}
        self._hidden = self._hidden - shown

    def bound_cache(self, size_bytes: int) -> None:
        """Changes the largest size of the decoded frames."""
        with self._lock:
            self._cache_bytes = size_bytes
            self._drop_oldest()

    def forget(self) -> None:
        """Drops all held and cached frames."""
        with self._lock:
            self._held.clear()
            self._cache.clear()
            self._cached_bytes = 0

    def set_view(self, view: View) -> None:
        """Changes the visible revision."""
        with self._database.reading() as connection:
            (seen,) = Visible.of(connection, view)
            self._revisions = frozenset(seen.places)
            self._hidden = seen.hidden_of(nodes)
            self._without_pictures = seen.hidden_of(frames)
            self._cameras: dict[int, StereoCamera] = load_cameras(connection)
            self._frontends: dict[int, tuple[DescriptorKind, str]] = load_frontends(connection)

    def close(self) -> None:
        """Ends the read-ahead thread."""
        with self._wanted_changed:
            self._closed = True
            self._wanted.clear()
            self._wanted_changed.notify()
        if self._thread is not None:
            self._thread.join()

    def _read(self, node: NodeId) -> Frame:
        row, blob = self._node_row(node)
        camera = self._cameras.get(row["camera"])
        frontend = self._frontends.get(row["frontend"])
        if camera is None or frontend is None or not isinstance(blob, bytes):
            raise MapCorruptError(f"node {node}: its camera, front-end or frame is missing")
        if blob_hash(blob) != row["landmark_hash"]:
            raise MapCorruptError(f"node {node}: its landmarks are not those that were saved")
        try:
            landmarks = decode_landmarks(blob, camera, frontend[0])
            status = FrameStatus(row["status"])
        except (MapCorruptError, ValueError) as error:
            raise MapCorruptError(f"node {node}: {error}") from error
        return Frame(row["stamp_ns"], camera, landmarks, frontend[0], frontend[1], status)

    def _node_row(self, node: NodeId) -> tuple[Row, bytes | None]:
        found = self._database.first(_NODE_WITH_LANDMARKS, {"uuid": node.bytes})
        if found is None:
            raise InputError(f"the map has no node {node}")
        row = next(verified(nodes, [found]))
        if row["revision"] not in self._revisions or row["key"] in self._hidden:
            raise InputError(f"node {node} is not part of the map at this revision")
        return row, found[-1]

    def _stored_node(self, node: Node, found: Sequence[Any]) -> StoredNode:
        row = next(verified(nodes, [found]))
        frame = next(verified(frames, [found[len(nodes.columns) :]]), None)
        if row["revision"] not in self._revisions or row["key"] in self._hidden:
            raise InputError(f"node {node.id} is not part of the map at this revision")
        frontend = self._frontends.get(row["frontend"])
        if frontend is None or frame is None:
            raise MapCorruptError(f"node {node.id}: its front-end or frame is missing")
        blob = frame["landmarks"]
        if blob_hash(blob) != row["landmark_hash"] or not is_intact(blob):
            raise MapCorruptError(f"node {node.id}: its landmarks are not those that were saved")
        return StoredNode(
            node=node,
            descriptor=frontend[0],
            frontend=frontend[1],
            status=FrameStatus(row["status"]),
            landmark_hash=row["landmark_hash"],
            landmarks=blob,
            thumbnail=None if row["key"] in self._without_pictures else frame["thumbnail"],
        )

    def _remember(self, node: NodeId, frame: Frame) -> None:
        with self._lock:
            if node in self._cache:
                return
            self._cache[node] = frame
            self._cached_bytes += _size_bytes(frame)
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        while self._cached_bytes > self._cache_bytes and len(self._cache) > 1:
            _, oldest = self._cache.popitem(last=False)
            self._cached_bytes -= _size_bytes(oldest)

    def _read_ahead(self) -> None:
        while True:
            with self._wanted_changed:
                self._wanted_changed.wait_for(lambda: self._wanted or self._closed)
                if self._closed:
                    return
                node = self._wanted.popleft()
                if node in self._cache or node in self._held:
                    continue
            try:
                self.frame(node)
            except (MapError, InputError):
                continue  # only a hint: a real read of this node raises the same error


_NODE_WITH_LANDMARKS = (
    select(*nodes.columns, frames.c.landmarks)
    .select_from(nodes.outerjoin(frames, frames.c.node == nodes.c.key))
    .where(nodes.c.uuid == bindparam("uuid"))
    .order_by(nodes.c.key)
)

_WHOLE_NODES = (
    select(*nodes.columns, *frames.columns)
    .select_from(nodes.join(frames, frames.c.node == nodes.c.key))
    .order_by(nodes.c.key)
)
_NODE_UUID = nodes.columns.keys().index("uuid")


def _size_bytes(frame: Frame) -> int:
    landmarks = frame.landmarks
    return _BYTES_PER_FRAME + _BYTES_PER_LANDMARK * len(landmarks) + landmarks.descriptors.nbytes
