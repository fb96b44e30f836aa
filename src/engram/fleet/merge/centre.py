"""The centre's map while something is merged into it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from engram.frontend import Frame
from engram.geometry import SE3
from engram.graph.model import NodeId, Omission, PathEntry, PathEntryKind, PathId
from engram.localiser import Position, Relocaliser
from engram.maps import MapStore
from engram.robot import OpenMap

# Entries that a merge adds itself stand behind all that robots wrote (docs/format.md).
FIRST_REPLAYED = 2**32
# How well a node omitted long ago lies to its equivalent: its match's covariance was not kept.
# Set wide of what matches reach: 93 % within 0.25 m, median 2 cm (docs/performance.md).
_OMITTED_SIGMA_M = 0.2
_OMITTED_SIGMA_RAD = float(np.deg2rad(1.0))


class Centre:
    """What the centre knows, and what this merge adds to it.

    Attributes:
        store: the map.
        opened: its graph and path memory; they grow.
    """

    def __init__(self, store: MapStore) -> None:
        self.store = store
        self.opened = OpenMap(store)
        self.graph = self.opened.graph
        spread = [_OMITTED_SIGMA_M**2] * 3 + [_OMITTED_SIGMA_RAD**2] * 3
        self._omitted = {
            omission.omitted: Position(omission.node, omission.node_from_omitted, np.diag(spread))
            for omission in store.omissions().values()
        }
        self._paths: dict[PathId, _KnownPath] = {}

    @cached_property
    def landmark_hashes(self) -> dict[NodeId, bytes]:
        """What `MapStore.landmark_hashes` gave when it was first asked for in the merge."""
        return self.store.landmark_hashes()

    def has_omitted(self, node: NodeId) -> bool:
        """Whether the node was handed in once and not taken."""
        return node in self._omitted and node not in self.graph

    def knows(self, node: NodeId) -> bool:
        """Whether the node needs no more looking at."""
        return node in self.graph or node in self._omitted

    def equivalent(self, node: NodeId) -> Position | None:
        """Where the node's camera is in the centre: in itself or in its equivalent."""
        if node in self.graph:
            return Position.at(node)
        return self._omitted.get(node)

    def omit(self, node: NodeId, position: Position, landmark_hash: bytes | None) -> Omission:
        """Remember a node as one that is not taken."""
        self._omitted[node] = position
        return Omission(node, position.node, position.node_from_live, landmark_hash)

    def new_entry(self, entry: PathEntry) -> PathEntry | None:
        """A path entry handed in, as it joins the centre's path of the same drive.

        Paths are united by (path, sequence) (SPEC §7 MERGE 4). Entries that merges made have no
        number of the robot's: they are the same when node and stamp are, and get the next number.

        Returns:
            The entry, pointing to the equivalent of its node; None if the path has it, or the node
            is not known.
        """
        position = self.equivalent(entry.node)
        if position is None:
            return None
        path = self._path(entry.path)
        sequence = entry.sequence
        if entry.kind is PathEntryKind.REPLAYED:
            if (position.node, entry.stamp_ns) in path.replayed:
                return None
            sequence = path.next_replayed
        elif sequence in path.sequences:
            return None
        return PathEntry(entry.path, sequence, position.node, entry.kind, entry.stamp_ns)

    def add_entry(self, entry: PathEntry) -> None:
        """An entry of `new_entry` joins the path memory."""
        self._path(entry.path).add(entry)
        self.opened.path_memory.add(entry)

    def _path(self, path: PathId) -> _KnownPath:
        if path not in self._paths:
            self._paths[path] = known = _KnownPath()
            for entry in self.opened.path_memory.entries(path):
                known.add(entry)
        return self._paths[path]


class _KnownPath:
    """What a path of the centre holds."""

    def __init__(self) -> None:
        self.sequences: set[int] = set()
        self.replayed: set[tuple[NodeId, int]] = set()
        self.next_replayed = FIRST_REPLAYED

    def add(self, entry: PathEntry) -> None:
        self.sequences.add(entry.sequence)
        if entry.kind is PathEntryKind.REPLAYED:
            self.replayed.add((entry.node, entry.stamp_ns))
            self.next_replayed = max(self.next_replayed, entry.sequence + 1)


class LazyRelocaliser:
    """A relocaliser that is made when it is first asked: learning all nodes takes a while."""

    new_place: float | None = None

    def __init__(self, name: str, make: Callable[[], Relocaliser]) -> None:
        self.name = name
        self._make = make
        self._made: Relocaliser | None = None

    def propose(self, live: Frame, count: int, allowed: Callable[[int], bool]) -> list[int]:
        """See `Relocaliser`."""
        if self._made is None:
            self._made = self._make()
        proposed = self._made.propose(live, count, allowed)
        self.new_place = self._made.new_place
        return proposed

    def carry_on(self, motion: SE3 | None) -> None:
        """See `Relocaliser`; one that was never asked believes nothing yet."""
        if self._made is not None:
            self._made.carry_on(motion)

    def failed(self, nodes: Sequence[int]) -> None:
        """See `Relocaliser`."""
        if self._made is not None:
            self._made.failed(nodes)

    def forget(self) -> None:
        """See `Relocaliser`."""
        if self._made is not None:
            self._made.forget()
