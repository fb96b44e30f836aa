"""Where the nodes of an open revision come to lie, from its own rows and the ends of its edges."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from sqlalchemy import Connection, select

from engram.graph.model import Edge, Node, NodeId, Placement
from engram.graph.placing import PlacingConfig, Surroundings, place
from engram.maps.lookups import node_records, places_of
from engram.maps.map_frame import changed, graph_of
from engram.maps.rows import Row, edges_from_rows, verified
from engram.maps.runs import Keys, Runs
from engram.maps.schema import edges, nodes
from engram.maps.totals import Own, Totals, changes_steps, state_at_head
from engram.maps.view import View, few, places_in_history


def new_places(
    connection: Connection,
    view: View,
    contents: Mapping[str, float],
    own: Own,
    config: PlacingConfig,
) -> list[Placement] | None:
    """The places of the new nodes of an open revision, as a layout of the whole map has them.

    Args:
        connection: of the map.
        view: the newest revision and the open one.
        contents: number of rows of the open revision, by table.
        own: its rows.
        config: how new nodes are laid out.

    Returns:
        None if what has a place may have to move: parts come together, edges go, or places are
        given.
    """
    if any(contents[name] for name in ("placements", "hidden", "removals")):
        return None
    totals, runs = state_at_head(connection, view.at)
    if runs is None or changes_steps(connection, view, own):
        return None
    fresh, joins = (
        list(verified(table, connection.execute(query.order_by(table.c.key))))
        for table, query in ((one, select(one).where(own.rows(one))) for one in (nodes, edges))
    )
    ends = np.array([(row["a"], row["b"]) for row in joins], np.int64).reshape(-1, 2)
    new = np.array([row["key"] for row in fresh], np.int64)
    old = np.setdiff1d(ends, new)
    if _brings_together(runs, new, ends):
        return None
    if not len(new):
        return []
    known = _older(connection, view, old)
    placed = places_of(connection, view, [row["key"] for row in known])
    if (runs.find(old) < 0).any() or len(placed) < len(old):
        return None
    records = node_records(connection, [*known, *fresh])
    by_key = dict(zip((row["key"] for row in (*known, *fresh)), records, strict=True))
    graph = graph_of(records, _edges(joins, by_key))
    before = {by_key[key].id: pose for key, pose in placed.items()}
    rest = _rest(totals, runs, np.array([row["key"] for row in known], np.int64))
    return changed(before, graph, place(graph, before, config, rest), config.same_m)


def _brings_together(runs: Runs, new: Keys, ends: Keys) -> bool:
    """Whether edges join components that were apart."""
    if (runs.find(np.setdiff1d(ends, new)) < 0).any():
        return True
    after = runs.with_nodes(new).joined(np.zeros((0, 2), np.int64), ends)
    left = after.component[after.find(runs.first)]
    return len(np.unique(left)) < len(np.unique(runs.component))


def _rest(totals: Totals, runs: Runs, placed: Keys) -> Surroundings:
    """What the layout has to know of the map, whose nodes with a place (P,) come first."""
    component = runs.component[runs.find(placed)]
    _, first, which = np.unique(component, return_index=True, return_inverse=True)
    held = np.column_stack([first[which], np.arange(len(placed))]).reshape(-1, 2)
    forward = {str(camera): np.array(shift) for camera, shift in totals.forward.items()}
    return Surroundings(held, forward, totals.right_m)


def _older(connection: Connection, view: View, keys: Keys) -> list[Row]:
    """Rows of nodes of earlier revisions, in the order of a graph that is read."""
    found: list[Row] = []
    for part in few(keys.tolist()):
        query = view.select(nodes).where(nodes.c.key.in_(part))
        found += verified(nodes, connection.execute(query))
    place_of = places_in_history(connection)
    return sorted(found, key=lambda row: (place_of[row["revision"]], row["key"]))


def _edges(rows: list[Row], nodes_by_key: Mapping[int, Node]) -> tuple[Edge, ...]:
    def named(key: int) -> NodeId:
        return nodes_by_key[key].id

    return edges_from_rows(rows, [(named(row["a"]), named(row["b"])) for row in rows])
