"""Rows of removals, placements, anchors and goals, and the edges that count without them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from sqlalchemy import Connection, Table, select

from engram.errors import InputError, MapCorruptError
from engram.geometry.se3 import SE3
from engram.graph.model import (
    Anchor,
    EdgeKind,
    Goal,
    Mark,
    NodeId,
    Placement,
    Removal,
    same_measurement,
)
from engram.maps.columns import Columns, read_columns
from engram.maps.rows import (
    Row,
    cell_of,
    checked_int,
    checked_text,
    node_from_bytes,
    transform_bytes,
    transform_from_bytes,
    transforms_from_bytes,
    verified,
)
from engram.maps.schema import anchors, goals, nodes, placements, removals
from engram.maps.view import View


def mark_row(mark: Mark, key_of: Callable[[NodeId], int]) -> tuple[Table, Row]:
    """The table and columns of a mark, without key and revision.

    Args:
        mark: the record.
        key_of: key of a node; raises InputError for one that is not in the map.

    Raises:
        InputError: a node is not in the map, or a value cannot be stored.
    """
    if isinstance(mark, Placement):
        return placements, {
            "node": key_of(mark.node),
            "map_from_node": transform_bytes(mark.map_from_node),
            "cell": cell_of(mark.map_from_node),
        }
    if isinstance(mark, Goal):
        return goals, {
            "name": checked_text(mark.name, "name"),
            "node": key_of(mark.node),
            "node_from_goal": transform_bytes(mark.node_from_goal),
        }
    if isinstance(mark, Anchor):
        values = (mark.x_m, mark.y_m, 0.0 if mark.z_m is None else mark.z_m, mark.sigma_m)
        if not np.isfinite(values).all() or mark.sigma_m <= 0:
            raise InputError(f"anchor of node {mark.node}: {values} must be finite, sigma > 0")
        return anchors, {
            "node": key_of(mark.node),
            "x_m": float(mark.x_m),
            "y_m": float(mark.y_m),
            "z_m": None if mark.z_m is None else float(mark.z_m),
            "sigma_m": float(mark.sigma_m),
            "source": checked_text(mark.source, "source"),
        }
    return removals, {
        "a": key_of(mark.a),
        "b": key_of(mark.b),
        "kind": str(mark.kind),
        "a_from_b": transform_bytes(mark.a_from_b),
        "reason": checked_text(mark.reason, "reason"),
        "removed_ns": checked_int(mark.removed_ns, "removed_ns"),
    }


def load_removals(connection: Connection, view: View) -> tuple[Removal, ...]:
    """The removals that count, oldest first."""
    return _removals(connection, list(view.rows(connection, removals)))


def seen_removals(connection: Connection, view: View) -> set[tuple[NodeId, NodeId, EdgeKind, int]]:
    """Keys of all removals that ever counted, reverted ones included."""
    query = select(removals).where(removals.c.revision.in_(view.revision_keys()))
    rows = list(verified(removals, connection.execute(query.order_by(removals.c.key))))
    return {one.key for one in _removals(connection, rows)}


def _removals(connection: Connection, rows: list[Row]) -> tuple[Removal, ...]:
    ids = _node_ids(connection, {row[end] for row in rows for end in ("a", "b")})
    return tuple(removal_from_row(row, ids) for row in rows)


def load_placements(connection: Connection, view: View) -> dict[NodeId, SE3]:
    """The newest ``map_from_node`` of each placed node."""
    ids = _all_node_ids(connection, view)
    found = read_columns(connection, view, placements).newest("node")
    keys, placed = found["key"], found["node"].tolist()
    poses = transforms_from_bytes(found["map_from_node"], lambda at: f"placement {keys[at]}")
    return {ids[node]: pose for node, pose in zip(placed, poses, strict=True) if node in ids}


def load_anchors(connection: Connection, view: View) -> tuple[Anchor, ...]:
    """The anchors of the newest revision that has any: an anchoring replaces the one before."""
    rows = list(view.rows(connection, anchors))
    newest = [row for row in rows if row["revision"] == rows[-1]["revision"]]
    ids = _node_ids(connection, {row["node"] for row in newest})
    names = ("x_m", "y_m", "z_m", "sigma_m", "source")
    return tuple(Anchor(ids[row["node"]], *(row[name] for name in names)) for row in newest)


def load_goals(connection: Connection, view: View) -> dict[str, Goal]:
    """The newest goal of each name."""
    rows = list(view.rows(connection, goals))
    ids = _node_ids(connection, {row["node"] for row in rows})
    return {row["name"]: goal_from_row(row, ids) for row in rows}


def seen_goals(connection: Connection, view: View) -> tuple[Goal, ...]:
    """All goals that the map ever had, at nodes that it has."""
    query = select(goals).where(goals.c.revision.in_(view.revision_keys()))
    rows = list(verified(goals, connection.execute(query.order_by(goals.c.key))))
    ids = _node_ids(connection, {row["node"] for row in rows})
    return tuple(goal_from_row(row, ids) for row in rows)


def removal_from_row(row: Row, ids: Mapping[int, NodeId]) -> Removal:
    """The removal."""
    what = f"removal {row['key']}"
    if row["kind"] not in set(map(str, EdgeKind)):
        raise MapCorruptError(f"{what}: {row['kind']!r} is not a valid EdgeKind")
    a_from_b = transform_from_bytes(row["a_from_b"], what)
    kind = EdgeKind(row["kind"])
    return Removal(ids[row["a"]], ids[row["b"]], kind, a_from_b, row["reason"], row["removed_ns"])


def goal_from_row(row: Row, ids: Mapping[int, NodeId]) -> Goal:
    """The goal."""
    pose = transform_from_bytes(row["node_from_goal"], f"goal {row['name']}")
    return Goal(row["name"], ids[row["node"]], pose)


def counting(connection: Connection, view: View, rows: list[Row]) -> list[Row]:
    """The rows of edges without those that were removed."""
    removed = removed_measurements(view.rows(connection, removals))
    if not removed:
        return rows
    return [row for row in rows if not is_removed(row, removed.get(edge_key(row), []))]


# What was removed by `edge_key`: from which end, and the transform to the other.
Removed = dict[tuple[frozenset[int], str], list[tuple[int, SE3]]]


def removed_measurements(rows: Iterable[Row]) -> Removed:
    """What these rows of removals remove."""
    removed: Removed = {}
    for row in rows:
        a_from_b = transform_from_bytes(row["a_from_b"], f"removal {row['key']}")
        removed.setdefault(edge_key(row), []).append((row["a"], a_from_b))
    return removed


def edge_key(row: Row) -> tuple[frozenset[int], str]:
    """The two ends of an edge, in any order, and its kind."""
    return frozenset((row["a"], row["b"])), row["kind"]


def is_removed(row: Row, removed: list[tuple[int, SE3]]) -> bool:
    """Whether an edge measures what was removed between its ends."""
    if not removed:
        return False
    a_from_b = transform_from_bytes(row["a_from_b"], f"edge {row['key']}")
    inverse = a_from_b.inverse()
    return any(same_measurement(was, a_from_b if a == row["a"] else inverse) for a, was in removed)


def without_removed(removed: Removed, found: Columns) -> Columns:
    """The edges without those that were removed; hardly any map has some."""
    if not removed:
        return found
    codes, texts = found.texts["kind"]
    kept = []
    for at, (key, a, b, code) in enumerate(
        zip(*(found[name].tolist() for name in ("key", "a", "b")), codes.tolist(), strict=True)
    ):
        row = {"key": key, "a": a, "b": b, "kind": texts[code]}
        measured = removed.get(edge_key(row))
        if measured is None or not is_removed(
            {**row, "a_from_b": found["a_from_b"][at].tobytes()}, measured
        ):
            kept.append(at)
    return found.rows(np.array(kept, np.intp))


def _node_ids(connection: Connection, keys: set[int]) -> dict[int, NodeId]:
    query = select(nodes.c.key, nodes.c.uuid).where(nodes.c.key.in_(keys))
    return {row[0]: node_from_bytes(row[1]) for row in connection.execute(query)}


def _all_node_ids(connection: Connection, view: View) -> dict[int, NodeId]:
    query: Any = view.select(nodes).with_only_columns(nodes.c.key, nodes.c.uuid)
    return {row[0]: node_from_bytes(row[1]) for row in connection.execute(query)}
