"""Goals of a map: named poses, stored relative to nodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import InputError
from engram.maps import Map


def add_goal(
    path: Path, name: str, x_m: float, y_m: float, yaw_rad: float, *, author: str
) -> dict[str, Any]:
    """Stores a pose of the map frame as a goal, in a revision of its own.

    Raises:
        InputError: the name is empty, a number is not finite, or the map has no nodes.
        MapError: the map cannot be written.
    """
    if not name.strip():
        raise InputError("a goal needs a name")
    with Map.open(path, writes=True) as store:
        goal = store.frame.goal(x_m, y_m, yaw_rad, name)
        about = {"goal": {"name": name, "x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad}}
        with store.begin_revision(
            author=author, message=f"goal {name}", configuration=about
        ) as writer:
            writer.add_mark(goal)
            revision = writer.commit().number
        away_m = float(np.linalg.norm(goal.node_from_goal.translation))
        where = store.frame.locate(goal).to_dict()
    return {
        "name": name, "node": str(goal.node), "from_node_m": round(away_m, 3), **where,
        "revision": revision,
    }  # fmt: skip


def list_goals(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The goals of a map by name, and where they lie now.

    Raises:
        MapError: the map cannot be read, or has no such revision.
    """
    with Map.open(path, at=at) as store:
        frame = store.frame
        return [
            {
                "name": name,
                "node": str(goal.node),
                "from_node_m": round(goal.node_from_goal.distance_m, 3),
                **frame.locate(goal).to_dict(),
            }
            for name, goal in sorted(store.goals.items())
        ]
