"""Drives that crossed an edge: path memory as a witness of it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.graph.graph import ExperienceGraph
from engram.graph.paths import PathMemory

# Entries of a path that count on each side.
_LOOK = 8


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

    def witnessed(
        self, side_a: Collection[int], side_b: Collection[int], count: int, pause: int
    ) -> int:
        """How well the best drive that crossed from one side to the other was at home on both.

        Args:
            side_a, side_b: nodes near one end of an edge, and near the other.
            count: number of nodes of the graph.
            pause: entries of a path from its last on one side to its first on the other, at most.

        Returns:
            The number of different nodes by which it was localised, or that it saved, just before
            and just after; of the two the smaller. 0 if no drive crossed.
        """
        on = np.zeros((2, count), np.bool_)
        for side, nodes in enumerate((side_a, side_b)):
            on[side, list(nodes)] = True
        on &= ~on.all(axis=0)
        best = 0
        for walk in self.walks:
            here = on[:, walk]
            sides = np.flatnonzero(here.any(axis=0))
            second = here[1, sides]
            changes = np.flatnonzero(second[1:] != second[:-1])
            for at in changes.tolist():
                last, first = int(sides[at]), int(sides[at + 1])
                if first - last > pause:
                    continue
                before = walk[max(last - _LOOK, 0) : last + 1]
                after = walk[first : first + _LOOK + 1]
                side = int(second[at])
                counts = (
                    len(np.unique(before[on[side, before]])),
                    len(np.unique(after[on[1 - side, after]])),
                )
                best = max(best, min(counts))
        return best
