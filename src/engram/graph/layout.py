"""Planar layout of a map for pictures: accurate locally, with drift along chains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.graph.components import grouped
from engram.graph.graph import ExperienceGraph

_APART_M = 20.0


def lay_out(graph: ExperienceGraph) -> NDArray[np.float64]:
    """(N, 2) float64, metres: position of each node from above, x right and z forward.

    Each component is placed along the least uncertain chains from its first node. Components stand
    side by side, as their relative pose is unknown.
    """
    placed = np.zeros((len(graph), 2))
    right_m = 0.0
    for nodes in grouped(graph.components()):
        tree = graph.chains_from(int(nodes[0]))
        rows = [tree.row_of[int(node)] for node in nodes]
        points = tree.root_from_node[rows][:, [9, 11]]
        points[:, 0] += right_m - points[:, 0].min()
        right_m = float(points[:, 0].max()) + _APART_M
        placed[nodes] = points
    return placed
