"""Two revisions of a map from above: unchanged, added and removed parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from engram.graph.layout import lay_out
from engram.maps.difference import MapDifference
from engram.viewing.from_above import Track, draw_from_above


def draw_difference(difference: MapDifference, path: Path) -> None:
    """Draws the unchanged, added and removed parts between two revisions.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    graph = difference.graph
    points = lay_out(graph)
    old = np.zeros(len(graph), bool)
    new = np.zeros(len(graph), bool)
    old[[graph.index(node.id) for node in difference.old.nodes]] = True
    new[[graph.index(node.id) for node in difference.new.nodes]] = True
    tracks = [
        Track(f"{label}: {int(mask.sum())} nodes", points[mask], colour)
        for label, mask, colour in (
            ("in both", old & new, "0.6"),
            ("added", new & ~old, "tab:green"),
            ("removed", old & ~new, "tab:red"),
        )
        if mask.any()
    ]
    draw_from_above(tracks, path, f"Revision {difference.before} → {difference.after}")
