"""Edges of a map that was read: a struct of arrays, with records made on request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.graph.model import Edge, EdgeKind, Node

EDGE_KINDS = tuple(EdgeKind)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeTable(Sequence[Edge]):
    """Edges between nodes of a list, each key (a, b, kind) once.

    Attributes:
        nodes: the nodes.
        ends: (E, 2) int32, places of a and b in `nodes`.
        kinds: (E,) uint8, index into `EDGE_KINDS`.
        poses: (E, 12) float64, ``a_from_b``: rotation in row-major order, then translation in m.
        covariances: (E, 6, 6) float64 of ``a_from_b``, left perturbation, m and rad.
    """

    nodes: Sequence[Node]
    ends: NDArray[np.int32]
    kinds: NDArray[np.uint8]
    poses: NDArray[np.float64]
    covariances: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ends)

    @overload
    def __getitem__(self, index: int) -> Edge: ...
    @overload
    def __getitem__(self, index: slice) -> list[Edge]: ...
    def __getitem__(self, index: int | slice) -> Edge | list[Edge]:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        a, b = self.ends[index].tolist()
        pose = self.poses[index]
        return Edge(
            self.nodes[a].id,
            self.nodes[b].id,
            EDGE_KINDS[self.kinds[index]],
            SE3(pose[:9].reshape(3, 3), pose[9:]),
            self.covariances[index],
        )


class EdgeRecords(Sequence[Edge]):
    """The edges of a graph: those of one table, made on first use and kept, and later ones."""

    def __init__(self) -> None:
        self._table: Sequence[Edge] = ()
        self._known: list[Edge | None] = []

    def begin_with(self, table: EdgeTable) -> None:
        """Takes the edges of a table; there are no others yet."""
        assert not self._known
        self._table, self._known = table, [None] * len(table)

    def append(self, edge: Edge) -> None:
        """Adds an edge."""
        self._known.append(edge)

    def extend(self, edges: Sequence[Edge]) -> None:
        """Adds edges."""
        self._known.extend(edges)

    def __len__(self) -> int:
        return len(self._known)

    def __setitem__(self, index: int, edge: Edge) -> None:
        self._known[index] = edge

    @overload
    def __getitem__(self, index: int) -> Edge: ...
    @overload
    def __getitem__(self, index: slice) -> list[Edge]: ...
    def __getitem__(self, index: int | slice) -> Edge | list[Edge]:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        known = self._known[index]
        if known is None:
            known = self._known[index] = self._table[index]
        return known
