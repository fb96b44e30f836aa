"""A plan view of the fleet map, before and after a merge."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from engram.counts import counted
from engram.maps import Map, open_map
from engram.viewing import Track, draw_panels


def picture_before_and_after(centre: Path, before: int, path: Path) -> None:
    """Draws the nodes of the fleet map by robot, as of a revision and now.

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
            words = f"{counted(len(opened.graph), 'node')}, revision {opened.revision}"
            panels.append((f"{'before' if at is not None else 'after'}: {words}", _tracks(opened)))
    draw_panels(panels, path)


def _tracks(opened: Map) -> list[Track]:
    """One per robot."""
    places_m = opened.frame.positions[:, :2]
    robots = np.array([opened.sessions[node.session].robot for node in opened.graph.nodes], object)
    return [
        Track(f"{robot} ({int((robots == robot).sum())})", places_m[robots == robot])
        for robot in sorted(set(robots.tolist()))
    ]
