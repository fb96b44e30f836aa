"""A map from above, its nodes coloured by experience, hour of day, revision or robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from engram.counts import counted
from engram.graph.clock import hour_of_day
from engram.graph.model import Clock, Node, Session
from engram.maps import Map
from engram.viewing.from_above import Track, check_picture, draw_from_above

# A legend longer than this hides the map.
_NAMED = 12
_FEW = "0.7"


def _experience(opened: Map, node: Node) -> str:
    session = opened.sessions[node.session]
    if session.clock is Clock.UTC:
        start = datetime.fromtimestamp(session.start_ns / 1e9, UTC)
        return f"{session.robot}, {start:%Y-%m-%d %H:%M}"
    return f"{session.robot}, {str(session.id)[:8]}"


def _hour(opened: Map, node: Node) -> str:
    session: Session = opened.sessions[node.session]
    hour = hour_of_day(session, node.stamp_ns)
    return "hour unknown" if hour is None else f"{int(hour):02d} h"


def _revision(opened: Map, node: Node) -> str:
    return f"revision {opened.origin(str(node.id)).brought:3d}"


def _robot(opened: Map, node: Node) -> str:
    return opened.sessions[node.session].robot


COLOURS: Mapping[str, Callable[[Map, Node], str]] = {
    "experience": _experience,
    "hour": _hour,
    "revision": _revision,
    "robot": _robot,
}


def plot_map(path: Path, out: Path, by: str = "experience", at: int | str | None = None) -> int:
    """Draws a map and its goals from above, in the map frame.

    Relative positions are accurate locally; over long distances they drift with odometry, where no
    anchors hold them. Unconnected components stand side by side.

    Args:
        path: NAME.engram.
        out: image file.
        by: key of `COLOURS`.
        at: number or tag of the revision; None for the newest.

    Returns:
        Number of nodes drawn.

    Raises:
        MapError: the map cannot be read, or has no such revision.
        InputError: the picture cannot be written.
        MissingExtraError: Matplotlib is not installed.
    """
    check_picture(out)
    with Map.open(path, at=at) as opened:
        points = opened.frame.positions[:, :2]
        labels = np.array([COLOURS[by](opened, node) for node in opened.graph.nodes], dtype=str)
        counts = Counter(labels.tolist())
        largest = {label for label, _ in counts.most_common(_NAMED)}
        tracks = [
            Track(f"{label} ({counted(counts[label], 'node')})", points[labels == label])
            for label in sorted(largest)
        ]
        rest = [label for label in counts if label not in largest]
        if rest:
            points_of_rest = points[np.isin(labels, rest)]
            tracks.append(
                Track(
                    f"{len(rest)} more ({counted(len(points_of_rest), 'node')})",
                    points_of_rest,
                    _FEW,
                )
            )
        places = {name: opened.frame.locate(goal) for name, goal in opened.goals.items()}
        marks = {name: (place.x_m, place.y_m) for name, place in sorted(places.items())}
        title = f"{path.name}, revision {opened.revision}, by {by}"
        draw_from_above(tracks, out, title, marks)
        return len(labels)
