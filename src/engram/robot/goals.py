"""Goals of a map: named poses, stored relative to nodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from engram.errors import InputError
from engram.graph.marks import Goal
from engram.maps import Map
from engram.maps.map_reader import MapReader

# A goal that comes back as near to one that was removed is that goal.
_SAME_M, _SAME_RAD = 0.2, 0.1


def add_goal(
    path: Path, name: str, x_m: float, y_m: float, yaw_rad: float, *, author: str
) -> dict[str, Any]:
    """Stores a pose of the map frame as a goal, in a revision of its own.

    Returns:
        The goal as `list_goals` describes it; `replaced`, the earlier goal of its name or None; and
        the number of the `revision`.

    Raises:
        InputError: the name is empty, a number is not finite, or the map has no nodes.
        MapError: the map cannot be written.
    """
    if not name.strip():
        raise InputError("a goal needs a name")
    with Map.open(path, writes=True) as store:
        before, goal = store.goals.get(name), store.frame.goal(x_m, y_m, yaw_rad, name)
        about = {"goal": {"name": name, "x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad}}
        with store.begin_revision(
            author=author, message=f"goal {name}", configuration=about
        ) as writer:
            writer.add_mark(goal)
            revision = writer.commit().number
        replaced = None if before is None else _described(before, store)
        return {**_described(goal, store), "replaced": replaced, "revision": revision}


def remove_goal(path: Path, name: str, *, author: str) -> dict[str, Any]:
    """Removes a goal, in a revision of its own that `Map.revert` undoes.

    Raises:
        InputError: the map has no such goal.
        MapError: the map cannot be written.
    """
    with Map.open(path, writes=True) as store:
        if name not in store.goals:
            known = ", ".join(sorted(store.goals)) or "none"
            raise InputError(f"{path} has no goal {name!r}; its goals: {known}")
        with store.begin_revision(
            author=author, message=f"remove goal {name}", configuration={"removed_goal": name}
        ) as writer:
            writer.remove_goal(name)
            return {"name": name, "revision": writer.commit().number}


def had_goal(store: MapReader, goal: Goal) -> bool:
    """Whether a map ever had a goal of this name at this place, at nodes that it has."""
    graph = store.graph
    for one in store.seen_goals:
        if one.name != goal.name or one.node not in graph or goal.node not in graph:
            continue
        way = graph.predict(graph.index(one.node), graph.index(goal.node))
        if way is not None:
            apart = one.node_from_goal.inverse() @ way[0] @ goal.node_from_goal
            if apart.distance_m <= _SAME_M and apart.angle_rad <= _SAME_RAD:
                return True
    return False


def list_goals(path: Path, at: int | str | None = None) -> list[dict[str, Any]]:
    """The goals of a map by name, and where they lie now.

    Raises:
        MapError: the map cannot be read, or has no such revision.
    """
    with Map.open(path, at=at) as store:
        return [_described(goal, store) for _, goal in sorted(store.goals.items())]


def _described(goal: Goal, store: MapReader) -> dict[str, Any]:
    """Name, node and place of a goal."""
    return {
        "name": goal.name,
        "node": str(goal.node),
        "from_node_m": round(goal.node_from_goal.distance_m, 3),
        **store.frame.locate(goal).to_dict(),
    }
