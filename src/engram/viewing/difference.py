"""Two revisions of a map from above: unchanged, added and removed parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from engram.counts import counted
from engram.maps import Map
from engram.maps.difference import MapDifference
from engram.viewing.from_above import Track, draw_from_above


def draw_difference(map_path: Path, difference: MapDifference, path: Path) -> None:
    """Draws the unchanged, added and removed parts between two revisions, in the map frame.

    Args:
        map_path: the map that was compared.
        difference: of two of its revisions.
        path: image file.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    graph = difference.graph
    points = np.zeros((len(graph), 2))
    for revision in (difference.before, difference.after):  # a node that moved is where it is now
        with Map.open(map_path, at=revision) as opened:
            at = [graph.index(node.id) for node in opened.graph.nodes]
            points[at] = opened.frame.positions[:, :2]
    old = np.zeros(len(graph), bool)
    new = np.zeros(len(graph), bool)
    old[[graph.index(node.id) for node in difference.old.nodes]] = True
    new[[graph.index(node.id) for node in difference.new.nodes]] = True
    tracks = [
        Track(f"{label}: {counted(int(mask.sum()), 'node')}", points[mask], colour)
        for label, mask, colour in (
            ("in both", old & new, "0.6"),
            ("added", new & ~old, "tab:green"),
            ("removed", old & ~new, "tab:red"),
        )
        if mask.any()
    ]
    draw_from_above(tracks, path, f"Revision {difference.before} → {difference.after}")
