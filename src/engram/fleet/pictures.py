"""A centre from above, before and after a merge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.drive import OpenMap, open_map
from engram.viewing import Track, draw_panels

# Space between components, which have no place relative to each other.
_BETWEEN_M = 20.0


def picture_before_and_after(centre: Path, before: int, path: Path) -> None:
    """Draws the nodes of a centre by robot, as of a revision and now.

    Args:
        centre: the map.
        before: number of the revision to compare with.
        path: image file.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    panels = []
    for at in (before, None):
        with open_map(centre, at) as opened:
            words = f"{len(opened.graph)} nodes, revision {opened.store.revision}"
            panels.append((f"{'before' if at is not None else 'after'}: {words}", _tracks(opened)))
    draw_panels(panels, path)


def _tracks(opened: OpenMap) -> list[Track]:
    """One per robot."""
    places_m = placed_nodes(opened)
    robots = np.array([opened.sessions[node.session].robot for node in opened.graph.nodes], object)
    return [
        Track(f"{robot} ({int((robots == robot).sum())})", places_m[robots == robot])
        for robot in sorted(set(robots.tolist()))
    ]


def placed_nodes(opened: OpenMap) -> NDArray[np.float64]:
    """(N, 2) float64: x and z of each node, component beside component, metres.

    Chained along the least uncertain edges from one node of each component: right nearby, bent in
    the large, since a map has no global frame.
    """
    graph = opened.graph
    places_m = np.zeros((len(graph), 2))
    labels = graph.components()
    right_m = 0.0
    for label in range(int(labels.max(initial=-1)) + 1):
        nodes = np.flatnonzero(labels == label)
        tree = graph.chains_from(int(nodes[0]))
        rows = [tree.row_of[int(node)] for node in nodes]
        component_m = tree.root_from_node[rows][:, [9, 11]]
        component_m[:, 0] += right_m - component_m[:, 0].min()
        places_m[nodes] = component_m
        right_m = float(component_m[:, 0].max()) + _BETWEEN_M
    return places_m
