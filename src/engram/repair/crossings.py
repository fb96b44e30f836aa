"""Drives that crossed an edge: path memory as a witness of it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.graph.graph import ExperienceGraph
from engram.graph.paths import PathMemory


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """The walks of all drives through experience space.

    Attributes:
        walks: for each path its nodes in order, (n,) int64, dense indices.
    """

    walks: tuple[NDArray[np.int64], ...]

    @staticmethod
    def of(graph: ExperienceGraph, paths: PathMemory) -> Crossings:
        """The walks of a map."""
        return Crossings(
            tuple(
                np.array([graph.index(entry.node) for entry in paths.entries(path)], np.int64)
                for path in paths.paths
            )
        )

    def witnessed(self, side_a: Collection[int], side_b: Collection[int], count: int) -> int:
        """How well the best drive that crossed from one side to the other was at home on both.

        Args:
            side_a, side_b: nodes near one end of an edge, and near the other.
            count: number of nodes of the graph.

        Returns:
            The number of different nodes by which it was localised before and after, of the two
            the smaller; 0 if no drive crossed.
        """
        on = np.zeros((2, count), np.bool_)
        for side, nodes in enumerate((side_a, side_b)):
            on[side, list(nodes)] = True
        on &= ~on.all(axis=0)
        best = 0
        for walk in self.walks:
            here = on[:, walk]
            for first, then in ((here[0], here[1]), (here[1], here[0])):
                for at in np.flatnonzero(first[:-1] & then[1:]).tolist():
                    before = _run(walk, first, range(at, -1, -1))
                    after = _run(walk, then, range(at + 1, len(walk)))
                    best = max(best, min(before, after))
        return best


def _run(walk: NDArray[np.int64], on: NDArray[np.bool_], places: range) -> int:
    """Different nodes of a walk from a place on, as long as it stays on one side."""
    nodes = set()
    for at in places:
        if not on[at]:
            break
        nodes.add(int(walk[at]))
    return len(nodes)
