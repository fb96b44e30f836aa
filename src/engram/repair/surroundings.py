"""What lies around a node by measured edges, some of them left out."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """A node near another one.

    Attributes:
        node: its dense index.
        way_m: length of the path to it along the edges, metres.
        root_from_node: its pose in the root's camera.
    """

    node: int
    way_m: float
    root_from_node: SE3


class Surroundings:
    """Walks along the measured edges of a graph: those that a camera or odometry measured.

    Args:
        graph: the graph.
        usable: (E,) bool, edges that may be walked along, in the order of `graph.edges`.
    """

    def __init__(self, graph: ExperienceGraph, usable: NDArray[np.bool_]) -> None:
        self._edges = graph.edges
        self._ends = graph.edge_ends[:, ::-1]  # of a and b
        self._usable = usable
        self._at: list[list[int]] = [[] for _ in range(len(graph))]
        for row in np.flatnonzero(usable).tolist():
            for end in self._ends[row].tolist():
                self._at[end].append(row)

    def around(self, root: int, reach_m: float, without: int = -1) -> Iterator[Near]:
        """The nodes within a path length of a root, nearest first; the root itself comes first.

        Args:
            root: dense index.
            reach_m: longest path, metres.
            without: an edge that is not walked along.
        """
        queue: list[tuple[float, int, int]] = [(0.0, root, -1)]
        poses: dict[tuple[int, int], SE3] = {}
        known: dict[int, SE3] = {}
        while queue:
            way_m, node, row = heapq.heappop(queue)
            if node in known:
                continue
            known[node] = SE3.identity() if row < 0 else poses.pop((node, row))
            yield Near(node, way_m, known[node])
            for other in self._at[node]:
                if other == without:
                    continue
                a, b = self._ends[other].tolist()
                there, edge = (b if a == node else a), self._edges[other]
                length_m = way_m + max(edge.a_from_b.distance_m, 0.05)
                if there in known or length_m > reach_m:
                    continue
                step = edge.a_from_b if a == node else edge.a_from_b.inverse()
                poses[there, other] = known[node] @ step
                heapq.heappush(queue, (length_m, there, other))

    def connects(self, a: int, b: int, reach_m: float, without: int) -> bool:
        """Whether a path of at most `reach_m` leads from one node to another without an edge."""
        queue, known = [(0.0, a)], set[int]()
        while queue:
            way_m, node = heapq.heappop(queue)
            if node == b:
                return True
            if node in known:
                continue
            known.add(node)
            for row in self._at[node]:
                ends = self._ends[row]
                there = int(ends[1] if ends[0] == node else ends[0])
                length_m = way_m + max(self._edges[row].a_from_b.distance_m, 0.05)
                if row != without and there not in known and length_m <= reach_m:
                    heapq.heappush(queue, (length_m, there))
        return False


def is_measured(kind: EdgeKind) -> bool:
    """Whether an edge of this kind is a measurement of its own, not composed of others."""
    return kind in {EdgeKind.ODOMETRY, EdgeKind.MATCH, EdgeKind.TIE}
