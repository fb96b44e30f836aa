"""A session's walk through experience space (SPEC §3.3)."""

from __future__ import annotations

from engram.graph.model import NodeId, PathEntry, PathEntryKind, PathId


class Walk:
    """Collects the entries of one session's path: one whenever its node changes."""

    def __init__(self, path: PathId, first_sequence: int = 0, node: NodeId | None = None) -> None:
        self.path = path
        self._sequence = first_sequence
        self._node = node
        self._new: list[PathEntry] = []

    def visit(self, node: NodeId, kind: PathEntryKind, stamp_ns: int) -> None:
        """Adds an entry if the node is another one than before."""
        if node == self._node:
            return
        self._new.append(PathEntry(self.path, self._sequence, node, kind, stamp_ns))
        self._node = node
        self._sequence += 1

    def take_new(self) -> list[PathEntry]:
        """The entries added since the last call."""
        taken, self._new = self._new, []
        return taken
