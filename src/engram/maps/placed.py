"""All nodes of a map with their places, for plots and pages: columns, no record of any node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from engram.errors import MapCorruptError
from engram.graph.graph import labels_of
from engram.graph.model import EdgeKind, Session
from engram.maps.reading import edges_between, load_cameras, sessions_by_key
from engram.maps.schema import nodes, placements
from engram.maps.totals import read_in_stretches, state_at_head
from engram.maps.view import View, head, places_in_history


@dataclass(frozen=True, slots=True, eq=False)
class PlacedNodes:
    """The N nodes that have a place in the map frame, in the order of saving, a struct of arrays.

    Attributes:
        sessions: the drives of the map.
        uuids: (N, 16) uint8.
        session: (N,) int64, place in `sessions`.
        stamp_ns: (N,) int64.
        revision: (N,) int64, number of the revision that brought each; 0 of an open one.
        positions: (N, 3) float64, metres in the map frame.
        component: (N,) int64, number of the connected component of each.
        experience: (N,) int64, number of the chain of odometry edges of each.
    """

    sessions: Sequence[Session]
    uuids: NDArray[np.uint8]
    session: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    revision: NDArray[np.int64]
    positions: NDArray[np.float64]
    component: NDArray[np.int64]
    experience: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.session)


def load_placed(connection: Connection, view: View) -> PlacedNodes:
    """The placed nodes of a view, read in stretches.

    Raises:
        MapCorruptError: a row is damaged.
    """
    known = sessions_by_key(connection, view, load_cameras(connection))
    numbers = places_in_history(connection)
    names = ("key", "uuid", "session", "stamp_ns", "revision")
    parts = [
        tuple(part[name] for name in names) for part in read_in_stretches(connection, view, nodes)
    ]
    keys, uuids, owners, stamps, revisions = map(np.concatenate, zip(*parts, strict=True))
    order = np.argsort(keys)
    at, positions = _newest_places(connection, view, keys[order])
    chosen = order[at]
    session_keys = np.array(sorted(known), np.int64)
    session = np.searchsorted(session_keys, owners[chosen])
    if len(chosen) and not np.isin(owners[chosen], session_keys).all():
        raise MapCorruptError("table nodes: a node's session is missing; run engram check")
    in_order = {key: number for number, key in enumerate(known)}
    to_place = np.array([in_order[key] for key in session_keys.tolist()], np.int64)
    brought, which = np.unique(revisions[chosen], return_inverse=True)
    number_of = np.array([numbers[key] for key in brought.tolist()], np.int64)
    component, experience = _known_joined(connection, view, keys[order]) or _joined(
        connection, view, keys[order], owners[order]
    )
    return PlacedNodes(
        tuple(known.values()),
        uuids[chosen],
        to_place[session],
        stamps[chosen],
        number_of[which],
        positions,
        component[at],
        experience[at],
    )


def _known_joined(
    connection: Connection, view: View, keys: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """As `_joined`, from what the newest revision keeps; None where another one is seen.

    A city's edges take forty times as long to read.
    """
    if view.own is not None or view.at != head(connection):
        return None
    runs = state_at_head(connection, view.at)[1]
    if runs is None:
        return None
    at = runs.find(keys)
    if (at < 0).any():
        return None
    component, experience = runs.component[at], runs.experience[at]
    return (
        np.unique(component, return_inverse=True)[1],
        np.unique(experience, return_inverse=True)[1],
    )


def _joined(
    connection: Connection, view: View, keys: NDArray[np.int64], owners: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The (N,) component and experience of nodes by their keys, ascending, and their sessions."""
    found, ends = edges_between(connection, view, keys)
    codes, kinds = found.texts["kind"]
    odometry = np.array([kind == EdgeKind.ODOMETRY for kind in kinds], np.bool_)[codes]
    chained = odometry & (owners[ends[:, 0]] == owners[ends[:, 1]])
    return labels_of(ends, len(keys)), labels_of(ends[chained], len(keys))


def _newest_places(
    connection: Connection, view: View, keys: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of those of the (N,) ascending keys that have a place, and the (P, 3) places, metres."""
    numbers = places_in_history(connection)
    positions = np.full((len(keys), 3), np.nan)
    placed_by = np.full(len(keys), -1, np.int64)
    for part in read_in_stretches(connection, view, placements):
        row = np.searchsorted(keys, part["node"])
        held = np.flatnonzero(row < len(keys))
        held = held[keys[row[held]] == part["node"][held]]
        brought = np.array([numbers[key] for key in part["revision"][held].tolist()], np.int64)
        # Of one node's rows the newest revision counts, and of its rows the last: so does the last
        # value that is assigned to one index.
        order = np.argsort(brought, kind="stable")
        order = order[brought[order] >= placed_by[row[held[order]]]]
        at = row[held[order]]
        placed_by[at] = brought[order]
        positions[at] = part["map_from_node"][held[order]].view("<f8")[:, 9:]
    found = np.flatnonzero(placed_by >= 0)
    return found, positions[found]
