"""What the records of a revision may refer to: sessions, paths, nodes, cameras and front-ends."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from engram.errors import IncompatibleError, InputError
from engram.frontend.frame import DescriptorKind
from engram.geometry.cameras import StereoCamera
from engram.graph.model import NodeId
from engram.maps import reading
from engram.maps.columns import Visible
from engram.maps.records import StoredNode
from engram.maps.row_buffer import RowBuffer
from engram.maps.rows import camera_row
from engram.maps.schema import cameras, frontends, path_entries, paths, sessions
from engram.maps.sqlite import SqliteDatabase
from engram.maps.view import KeyBook, View


class Stretches:
    """A set of whole numbers, stored by stretches of successive ones.

    A day's path has a million entries, whose sequence numbers follow each other.
    """

    def __init__(self, numbers: Iterable[int] = ()) -> None:
        self._firsts: list[int] = []
        self._lasts: list[int] = []
        for number in numbers:
            self.add(number)

    def __contains__(self, number: int) -> bool:
        at = bisect_right(self._firsts, number) - 1
        return at >= 0 and number <= self._lasts[at]

    def add(self, number: int) -> None:
        """Adds a number; no effect if it is there."""
        if number in self:
            return
        after = bisect_right(self._firsts, number)
        joins = after < len(self._firsts) and self._firsts[after] == number + 1
        if after > 0 and self._lasts[after - 1] == number - 1:
            self._lasts[after - 1] = self._lasts.pop(after) if joins else number
            del self._firsts[after : after + joins]
        elif joins:
            self._firsts[after] = number
        else:
            self._firsts.insert(after, number)
            self._lasts.insert(after, number)


class References:
    """The keys of what is visible or was added, for the rows that refer to it.

    Args:
        database, keys: the map's.
        view: the newest revision and the open one.
        rows: takes the rows of new cameras and front-ends.

    Attributes:
        sessions: keys of a session, its camera and its front-end, by the session's UUID.
        paths: key by the path's UUID.
    """

    def __init__(
        self, database: SqliteDatabase, keys: KeyBook, view: View, rows: RowBuffer
    ) -> None:
        self._database = database
        self._keys = keys
        self._view = view
        self._rows = rows
        self._sequences: dict[int, Stretches] = {}
        with database.reading() as connection:
            self._frontends = {
                content: key for key, content in reading.load_frontends(connection).items()
            }
            self._cameras = {
                camera.id: key for key, camera in reading.load_cameras(connection).items()
            }
            (seen,) = Visible.of(connection, view)
            self.sessions: dict[bytes, tuple[int, int, int]] = {
                row["uuid"]: (row["key"], row["camera"], row["frontend"])
                for row in seen.rows(connection, sessions)
            }
            self.paths: dict[bytes, int] = {
                row["uuid"]: row["key"] for row in seen.rows(connection, paths)
            }

    @property
    def descriptor(self) -> DescriptorKind | None:
        """The kind of all descriptors; None before the first session."""
        used = {frontend for _, _, frontend in self.sessions.values()}
        return next((kind for (kind, _), key in self._frontends.items() if key in used), None)

    def camera(self, camera: StereoCamera) -> int:
        """Key of a camera, added if new."""
        if camera.id not in self._cameras:
            key = self._cameras[camera.id] = self._keys.next(cameras)
            self._rows.put(cameras, camera_row(camera, key))
        return self._cameras[camera.id]

    def frontend(self, descriptor: DescriptorKind, frontend: str) -> int:
        """Key of the front-end of this hash, added if new."""
        content = (descriptor, frontend)
        if content not in self._frontends:
            key = self._frontends[content] = self._keys.next(frontends)
            row = {"key": key, "descriptor": str(descriptor), "hash": frontend}
            self._rows.put(frontends, row)
        return self._frontends[content]

    def node(self, node: NodeId, what: str) -> int:
        """Key of a node that a record refers to; `what` names the record.

        Raises:
            InputError: it is not in the map.
        """
        key = self._keys.find_node(node)
        if key is None:
            raise InputError(f"{what}: node {node} is not in the map; add it first")
        return key

    def nodes(self, indices: NDArray[np.integer], node_ids: Sequence[NodeId]) -> NDArray[np.int64]:
        """(R,) keys of the nodes of attempts, given as indices (R,) to `node_ids`.

        Raises:
            InputError: one is not in the map.
        """
        used, inverse = np.unique(indices, return_inverse=True)
        keys = [self.node(node_ids[int(index)], "attempt") for index in used]
        return np.array(keys, np.int64)[inverse]

    def begin_path(self, path_key: int) -> None:
        """Announces a path without entries."""
        self._sequences[path_key] = Stretches()

    def sequences(self, path_key: int) -> Stretches:
        """Sequence numbers of the visible entries of a path; the caller adds new ones."""
        if path_key not in self._sequences:
            query = (
                self._view.select(path_entries)
                .with_only_columns(path_entries.c.sequence)
                .where(path_entries.c.path == path_key)
            )
            with self._database.reading() as connection:
                self._sequences[path_key] = Stretches(connection.execute(query).scalars())
        return self._sequences[path_key]

    def check_node(self, stored: StoredNode) -> None:
        """Refuses a node that does not fit its session.

        Raises:
            InputError: its session has not been added or has another camera, the map has the node
                already, or its distance is not finite.
            IncompatibleError: it comes from another front-end than its session.
        """
        node = stored.node
        if node.session.bytes not in self.sessions:
            raise InputError(f"node {node.id}: its session {node.session} is not in the map")
        _, camera_key, frontend_key = self.sessions[node.session.bytes]
        if self._keys.find_node(node.id) is not None:
            raise InputError(f"node {node.id} is in the map already; a node is saved once")
        if not np.isfinite(node.driven_m):
            raise InputError(f"node {node.id}: driven_m is {node.driven_m}, must be finite")
        if self._cameras.get(node.camera) != camera_key:
            raise InputError(
                f"node {node.id} is of camera {node.camera}, its session {node.session} of "
                "another; a recalibrated robot begins another session"
            )
        if self._frontends.get((stored.descriptor, stored.frontend)) != frontend_key:
            raise IncompatibleError(
                f"node {node.id} comes from front-end {stored.frontend} ({stored.descriptor}), "
                f"its session {node.session} from another; begin another session"
            )
