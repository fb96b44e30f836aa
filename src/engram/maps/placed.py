"""All nodes of a map with their places and sizes: columns, no record of any node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, func, select

from engram.errors import MapCorruptError
from engram.graph.graph import labels_of
from engram.graph.model import EdgeKind, Session
from engram.maps.reading import edges_between, load_cameras, sessions_by_key
from engram.maps.schema import frames, nodes, placements
from engram.maps.totals import read_in_stretches, state_at_head
from engram.maps.view import View, head, places_in_history

_AT_ONCE = 4096


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


@dataclass(frozen=True, slots=True, eq=False)
class SizedNodes:
    """All N nodes of a map in the order of saving, a struct of arrays.

    Attributes:
        sessions: the drives of the map.
        keys: (N,) int64, of their rows.
        uuids: (N, 16) uint8.
        session: (N,) int64, place in `sessions`.
        stamp_ns: (N,) int64.
        positions: (N, 3) float64, metres in the map frame; NaN without a place.
        sizes: (N,) int64 bytes of the landmarks of each node, and (N,) of its picture.
    """

    sessions: Sequence[Session]
    keys: NDArray[np.int64]
    uuids: NDArray[np.uint8]
    session: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    positions: NDArray[np.float64]
    sizes: tuple[NDArray[np.int64], NDArray[np.int64]]

    def __len__(self) -> int:
        return len(self.keys)


def load_sized(connection: Connection, view: View) -> SizedNodes:
    """The nodes of a view, read in stretches; of their landmarks and pictures only the sizes.

    Raises:
        MapCorruptError: a row is damaged.
    """
    rows = _NodeRows.of(connection, view)
    positions = np.full((len(rows.keys), 3), np.nan)
    at, found = _newest_places(connection, view, rows.keys)
    positions[at] = found
    return SizedNodes(
        tuple(rows.known.values()),
        rows.keys,
        rows.uuids,
        rows.places_of_sessions(),
        rows.stamps_ns,
        positions,
        _sizes(connection, rows.keys),
    )


def _sizes(
    connection: Connection, keys: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    landmarks, pictures = np.zeros((2, len(keys)), np.int64)
    lengths = func.length(frames.c.landmarks), func.length(frames.c.thumbnail)
    for start in range(0, len(keys), _AT_ONCE):
        some = keys[start : start + _AT_ONCE]
        query = select(frames.c.node, *lengths)
        inside = query.where(frames.c.node.between(int(some[0]), int(some[-1])))
        found = np.array(
            [(key, size, other or 0) for key, size, other in connection.execute(inside)], np.int64
        ).reshape(-1, 3)
        row = np.minimum(np.searchsorted(keys, found[:, 0]), len(keys) - 1)
        held = keys[row] == found[:, 0]
        landmarks[row[held]], pictures[row[held]] = found[held, 1:].T
    return landmarks, pictures


@dataclass(frozen=True, slots=True, eq=False)
class _NodeRows:
    """The rows of nodes of a view by key, and its sessions by key, in the order of history."""

    known: Mapping[int, Session]
    keys: NDArray[np.int64]
    uuids: NDArray[np.uint8]
    owners: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    revisions: NDArray[np.int64]

    @staticmethod
    def of(connection: Connection, view: View) -> _NodeRows:
        known = sessions_by_key(connection, view, load_cameras(connection))
        names = ("key", "uuid", "session", "stamp_ns", "revision")
        parts = [
            tuple(part[name] for name in names)
            for part in read_in_stretches(connection, view, nodes)
        ]
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        order = np.argsort(columns[0])
        return _NodeRows(known, *(column[order] for column in columns))

    def places_of_sessions(self) -> NDArray[np.int64]:
        """(N,) place of each node's session in the order of history."""
        keys = np.array(sorted(self.known), np.int64)
        if len(self.owners) and not np.isin(self.owners, keys).all():
            raise MapCorruptError("table nodes: a node's session is missing; run engram check")
        in_order = {key: number for number, key in enumerate(self.known)}
        to_place = np.array([in_order[key] for key in keys.tolist()], np.int64)
        return to_place[np.searchsorted(keys, self.owners)]


def load_placed(connection: Connection, view: View) -> PlacedNodes:
    """The placed nodes of a view, read in stretches.

    Raises:
        MapCorruptError: a row is damaged.
    """
    rows = _NodeRows.of(connection, view)
    numbers = places_in_history(connection)
    at, positions = _newest_places(connection, view, rows.keys)
    brought, which = np.unique(rows.revisions[at], return_inverse=True)
    number_of = np.array([numbers[key] for key in brought.tolist()], np.int64)
    component, experience = _known_joined(connection, view, rows.keys) or _joined(
        connection, view, rows.keys, rows.owners
    )
    return PlacedNodes(
        tuple(rows.known.values()),
        rows.uuids[at],
        rows.places_of_sessions()[at],
        rows.stamps_ns[at],
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
