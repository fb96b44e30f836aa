"""What a map has of given nodes, paths and sessions: found by indices, at any size of the map."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table, func, select

from engram.geometry.se3 import SE3
from engram.graph.model import (
    Edge,
    Goal,
    Node,
    NodeId,
    Omission,
    PathEntry,
    PathEntryKind,
    PathId,
    SessionId,
)
from engram.graph.paths import Attempts
from engram.maps.attempts import unpack_drive
from engram.maps.forgetting import forgotten_of
from engram.maps.map_frame import Moves, moves
from engram.maps.marks import counting
from engram.maps.reading import load_cameras
from engram.maps.rows import (
    CELL_M,
    Row,
    cell_at,
    edges_from_rows,
    member,
    node_from_bytes,
    node_from_row,
    session_from_row,
    transform_from_bytes,
    uuid_from_bytes,
    verified,
)
from engram.maps.runs import Runs
from engram.maps.schema import (
    attempts,
    edges,
    frames,
    nodes,
    omissions,
    omitted_landmarks,
    path_entries,
    paths,
    placements,
    revisions,
    sessions,
)
from engram.maps.sqlite import SqliteDatabase
from engram.maps.totals import own_rows, runs_of, state_at_head, totals_at
from engram.maps.view import View, few, head


@dataclass(frozen=True, slots=True)
class HeldNode:
    """A node of a map.

    Attributes:
        node: the record.
        landmark_hash: hash (16 bytes) of its landmarks.
        key: of its row.
    """

    node: Node
    landmark_hash: bytes
    key: int


class Lookups:
    """Questions to a map as of one view.

    Args:
        database: the map's.
        view: the visible rows; those of an open revision as far as they are written.

    Raises:
        MapCorruptError: a row is damaged; of each method.
    """

    def __init__(self, database: SqliteDatabase, view: View) -> None:
        self._database, self._view = database, view

    def nodes(self, some: Iterable[NodeId]) -> dict[NodeId, HeldNode]:
        """Those of some nodes that the map has."""
        with self._database.reading() as connection:
            rows = list(self._named(connection, nodes, some))
            records = node_records(connection, rows)
            held = zip(records, rows, strict=True)
            return {node.id: HeldNode(node, row["landmark_hash"], row["key"]) for node, row in held}

    def node_keys(self, drives: Iterable[SessionId], some: Iterable[NodeId]) -> NDArray[np.int64]:
        """(N,) keys, rising, of the nodes of some sessions and of some others that the map has."""
        keys: list[int] = []
        with self._database.reading() as connection:
            for part in few([one.bytes for one in drives]):
                owners = select(sessions.c.key).where(sessions.c.uuid.in_(part))
                query = self._view.select(nodes).where(nodes.c.session.in_(owners))
                keys += connection.execute(query.with_only_columns(nodes.c.key)).scalars()
            keys += [row["key"] for row in self._named(connection, nodes, some)]
        return np.unique(np.array(keys, np.int64))

    def omissions(self, some: Iterable[NodeId]) -> dict[NodeId, Omission]:
        """Those of some nodes that the map omitted, each with its newest visible equivalent."""
        some = list(some)
        with self._database.reading() as connection:
            rows = list(self._named(connection, omissions, some))
            ids = _node_ids(connection, {row["node"] for row in rows})
            hashes = {
                row["uuid"]: row["landmark_hash"]
                for row in self._named(connection, omitted_landmarks, some)
            }
            found = {}
            for row in rows:
                omitted = node_from_bytes(row["uuid"])
                pose = transform_from_bytes(row["node_from_omitted"], f"omission {omitted}")
                found[omitted] = Omission(omitted, ids[row["node"]], pose, hashes.get(row["uuid"]))
        return found

    def known(self, some: Sequence[bytes]) -> frozenset[bytes]:
        """The UUIDs of nodes that the map has, omitted or forgot, and of sessions that it forgot.

        Nothing of these need be handed in.
        """
        with self._database.reading() as connection:
            return frozenset(forgotten_of(connection, self._view, some)).union(
                uuid
                for table in (nodes, omissions, omitted_landmarks)
                for part in few(some)
                for uuid in connection.execute(
                    self._view.select(table)
                    .with_only_columns(table.c.uuid)
                    .where(table.c.uuid.in_(part))
                ).scalars()
            )

    def forgotten(self, some: Iterable[SessionId | NodeId]) -> frozenset[UUID]:
        """Those of some sessions and nodes that the map has forgotten."""
        with self._database.reading() as connection:
            found = forgotten_of(connection, self._view, [one.bytes for one in some])
        return frozenset(UUID(bytes=uuid) for uuid in found)

    def landmark_hashes(self, some: Iterable[NodeId]) -> dict[NodeId, bytes]:
        """Hash (16 bytes) of the landmarks of some nodes that the map has, or had omitted."""
        some = list(some)
        with self._database.reading() as connection:
            return {
                node_from_bytes(row["uuid"]): row["landmark_hash"]
                for table in (omitted_landmarks, nodes)
                for row in self._named(connection, table, some)
            }

    def entries(self, path: PathId) -> list[PathEntry]:
        """A path's entries by sequence number; none of an unknown path."""
        with self._database.reading() as connection:
            key = select(paths.c.key).where(paths.c.uuid == path.bytes).scalar_subquery()
            query = self._view.select(path_entries).where(path_entries.c.path == key)
            rows = {
                row["sequence"]: row for row in verified(path_entries, connection.execute(query))
            }
            ids = _node_ids(connection, {row["node"] for row in rows.values()})
            return [
                PathEntry(
                    path,
                    sequence,
                    ids[row["node"]],
                    member(PathEntryKind, row["kind"], "path_entries"),
                    row["stamp_ns"],
                )
                for sequence, row in sorted(rows.items())
            ]

    def attempts(self, some: Sequence[SessionId]) -> Attempts:
        """Remembered attempts of some sessions.

        Returns:
            `session` is a place in `some`, `reference` and `node` are keys of nodes.
        """
        made = dict.fromkeys(some, Attempts.none())
        with self._database.reading() as connection:
            hidden = np.array(list(connection.execute(self._view.hidden_keys(nodes)).scalars()))
            for part in few(some):
                known = {one.bytes: one for one in part}
                named = select(sessions.c.key, sessions.c.uuid).where(sessions.c.uuid.in_(known))
                ids = {key: known[uuid] for key, uuid in connection.execute(named)}
                query = self._view.select(attempts).where(attempts.c.session.in_(list(ids)))
                rows = defaultdict[int, list[Row]](list)
                for row in verified(attempts, connection.execute(query.order_by(attempts.c.key))):
                    rows[row["session"]].append(row)
                made |= {ids[key]: unpack_drive(own) for key, own in rows.items()}
        parts = [
            replace(own, session=np.full(len(own), place, np.int32))
            for place, own in enumerate(made.values())
        ]
        found = Attempts.joined(parts)
        unseen = np.isin(np.stack([found.reference, found.node]), hidden)
        return found.rows(np.flatnonzero(~unseen.any(axis=0)))

    def edges(self, some: Iterable[NodeId]) -> list[Edge]:
        """The edges at some nodes, each once; of those with one (a, b, kind) the newest."""
        keys = [held.key for held in self.nodes(some).values()]
        with self._database.reading() as connection:
            rows = {
                (row["a"], row["b"], row["kind"]): row
                for part in few(keys)
                for end in (edges.c.a, edges.c.b)
                for row in verified(
                    edges, connection.execute(self._view.select(edges).where(end.in_(part)))
                )
            }
            kept = counting(connection, self._view, list(rows.values()))
            ids = _node_ids(connection, {row[end] for row in kept for end in ("a", "b")})
            return list(edges_from_rows(kept, [(ids[row["a"]], ids[row["b"]]) for row in kept]))

    def placements(self, some: Iterable[NodeId]) -> dict[NodeId, SE3]:
        """``map_from_node`` of those of some nodes that have a place."""
        with self._database.reading() as connection:
            keys = {row["key"]: row["uuid"] for row in self._named(connection, nodes, some)}
            found = places_of(connection, self._view, keys)
            return {node_from_bytes(keys[key]): pose for key, pose in found.items()}

    def blob_sizes(self, some: Sequence[NodeId]) -> NDArray[np.int64]:
        """(N, 2) int64: bytes of each node's landmarks, and of its thumbnail; 0 without any."""
        sizes: dict[bytes, tuple[int, int]] = {}
        lengths = func.length(frames.c.landmarks), func.length(frames.c.thumbnail)
        with self._database.reading() as connection:
            for part in few([one.bytes for one in some]):
                query = select(nodes.c.uuid, *lengths).join(frames, frames.c.node == nodes.c.key)
                found = connection.execute(query.where(nodes.c.uuid.in_(part)))
                sizes |= {uuid: (landmarks, picture or 0) for uuid, landmarks, picture in found}
        found_sizes = [sizes.get(one.bytes, (0, 0)) for one in some]
        return np.array(found_sizes, np.int64).reshape(-1, 2)

    def entry_counts(self, some: Sequence[PathId]) -> dict[PathId, int]:
        """Number of entries of those of some paths that have any."""
        query = (
            self._view.select(path_entries)
            .with_only_columns(paths.c.uuid, func.count(path_entries.c.sequence.distinct()))
            .join(paths, paths.c.key == path_entries.c.path)
            .group_by(paths.c.uuid)
            .order_by(None)
        )
        found: dict[PathId, int] = {}
        with self._database.reading() as connection:
            for part in few([one.bytes for one in some]):
                counted = connection.execute(query.where(paths.c.uuid.in_(part)))
                found |= {PathId(uuid_from_bytes(one, "a path")): count for one, count in counted}
        return found

    def last_stamps_ns(self) -> dict[SessionId, int]:
        """Stamp of the node that each session saved last, of sessions that saved any."""
        newest = (
            select(nodes.c.stamp_ns)
            .where(nodes.c.session == sessions.c.key)
            .order_by(nodes.c.key.desc())
            .limit(1)
            .scalar_subquery()
        )
        query = self._view.select(sessions).with_only_columns(sessions.c.uuid, newest)
        with self._database.reading() as connection:
            return {
                SessionId(uuid_from_bytes(uuid, "a session")): stamp_ns
                for uuid, stamp_ns in connection.execute(query)
                if stamp_ns is not None
            }

    def runs(self) -> Runs:
        """Which nodes are connected as of the newest committed revision that is visible."""
        with self._database.reading() as connection:
            _, runs = state_at_head(connection, self._view.at)
            if runs is None or head(connection) != self._view.at:
                return runs_of(connection, View(self._view.at))
            return runs

    def moves(self, number: int, goals: Sequence[Goal]) -> Moves:
        """What a revision moved in the map frame.

        Args:
            number: of the revision.
            goals: goals known before it.
        """
        with self._database.reading() as connection:
            query = select(revisions).where(revisions.c.number == number)
            own = own_rows(next(verified(revisions, connection.execute(query))))
            placed = select(placements.c.node).where(own.rows(placements)).distinct()
            keys = set(connection.execute(placed).scalars())
            at_goals = self._named(connection, nodes, {goal.node for goal in goals})
            keys |= {row["key"] for row in at_goals}
            before, after = (places_of(connection, View(at), keys) for at in (number - 1, number))
            ids = _node_ids(connection, before.keys())
            of_nodes = totals_at(connection, number - 1).nodes
            was, now = ({ids[key]: places[key] for key in before} for places in (before, after))
        return replace(moves(was, now, goals), of_nodes=of_nodes)

    def is_empty(self) -> bool:
        """Whether the map has no committed node."""
        with self._database.reading() as connection:
            return not totals_at(connection, self._view.at).nodes

    def places(self, some: Iterable[NodeId]) -> dict[NodeId, SE3]:
        """``map_from_node`` of those of some nodes that have a place."""
        with self._database.reading() as connection:
            keys = {row["key"]: row["uuid"] for row in self._named(connection, nodes, some)}
            found = places_of(connection, self._view, keys)
        return {node_from_bytes(keys[key]): pose for key, pose in found.items()}

    def places_near(self, x_m: float, y_m: float, within_m: float) -> dict[NodeId, SE3]:
        """``map_from_node`` of the nodes in a square of the map frame, and of some around it.

        Args:
            x_m, y_m: its middle.
            within_m: half its side; infinite for all nodes.
        """
        with self._database.reading() as connection:
            keys: set[int] = set()
            for first, last in _strips(x_m, y_m, within_m):
                placed = select(placements.c.node).where(placements.c.cell.between(first, last))
                keys |= set(connection.execute(placed).scalars())
            found = places_of(connection, self._view, keys)
            ids: dict[int, NodeId] = {}
            for part in few(sorted(found)):
                query = self._view.select(nodes).where(nodes.c.key.in_(part))
                for row in verified(nodes, connection.execute(query)):
                    ids[row["key"]] = node_from_bytes(row["uuid"])
        return {ids[key]: found[key] for key in sorted(found) if key in ids}

    def _named(self, connection: Connection, table: Table, some: Iterable[NodeId]) -> Iterator[Row]:
        """The visible rows of a table about some nodes, the newest last."""
        for part in few([one.bytes for one in some]):
            query = self._view.select(table).where(table.c.uuid.in_(part))
            yield from verified(table, connection.execute(query))


def _strips(x_m: float, y_m: float, within_m: float) -> Iterator[tuple[int, int]]:
    """First and last cell of each strip of cells along y that a square touches."""
    if not np.isfinite(within_m):
        yield 0, 2**63 - 1  # those with x >= 0 are beyond the largest key
        return
    for strip in range(int(2 * within_m // CELL_M) + 2):
        along_m = min(x_m - within_m + strip * CELL_M, x_m + within_m)
        yield cell_at(along_m, y_m - within_m), cell_at(along_m, y_m + within_m)


def node_records(connection: Connection, rows: Sequence[Row]) -> list[Node]:
    """The nodes of rows."""
    cameras = load_cameras(connection)
    drives = {}
    for part in few(sorted({row["session"] for row in rows})):
        query = select(sessions).where(sessions.c.key.in_(part)).order_by(sessions.c.key)
        for row in verified(sessions, connection.execute(query)):
            drives[row["key"]] = session_from_row(row, cameras[row["camera"]].id).id
    return [node_from_row(row, drives[row["session"]], cameras[row["camera"]].id) for row in rows]


def places_of(connection: Connection, view: View, keys: Iterable[int]) -> dict[int, SE3]:
    """The newest place of each of some nodes that have one, by key."""
    found = {}
    for part in few(sorted(keys)):
        query = view.select(placements).where(placements.c.node.in_(part))
        for row in verified(placements, connection.execute(query)):
            found[row["node"]] = transform_from_bytes(row["map_from_node"], "a placement")
    return found


def _node_ids(connection: Connection, keys: Iterable[int]) -> dict[int, NodeId]:
    found: dict[int, NodeId] = {}
    for part in few(sorted(keys)):
        query = select(nodes.c.key, nodes.c.uuid).where(nodes.c.key.in_(part))
        found |= {key: node_from_bytes(uuid) for key, uuid in connection.execute(query)}
    return found
