"""The pages of a map's graph, as of one revision: rows found by ranges of node keys.

A node's dense index is its key less one: keys are counted up from 1 in the order of saving, so that
the nodes of a page were saved one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import (
    BindParameter,
    Table,
    and_,
    bindparam,
    func,
    literal_column,
    not_,
    select,
    union_all,
)

from engram.errors import MapCorruptError
from engram.geometry.cameras import CameraId
from engram.graph.basin import BasinCounts, MatchBasin, count_attempts
from engram.graph.graph import EDGE_KINDS, labels_of
from engram.graph.model import EdgeKind, NodeId, PathEntryKind, PathId, SessionId, path_id
from engram.graph.pages import PAGE, GraphPage
from engram.graph.paths import ENTRY_KINDS, Attempts, Evidence
from engram.maps.attempts import unpack
from engram.maps.columns import Columns, Visible, read_columns
from engram.maps.marks import removed_measurements, without_removed
from engram.maps.reading import load_cameras, sessions_by_key
from engram.maps.rows import (
    edge_arrays,
    from_json,
    member,
    node_from_bytes,
    uuid_from_bytes,
    verified,
)
from engram.maps.schema import attempts, edges, nodes, path_entries, paths, removals, revisions
from engram.maps.sqlite import SqliteDatabase, reading_rows
from engram.maps.totals import own_rows
from engram.maps.view import View

# Dense indices are of 32 bits; what a process adds follows after those of the map.
_LARGEST_KEY = 2**31 - 2**24
_NODE_SIZES = {"uuid": 16, "landmark_hash": 16}
_EDGE_SIZES = {"a_from_b": 96, "covariance": 168}


class MapPages:
    """The `GraphPages` of a map.

    Args:
        database: the map's database.
        view: the visible rows.

    Raises:
        MapCorruptError: a row is damaged, or a node has a key that no map of this size has.
    """

    def __init__(self, database: SqliteDatabase, view: View) -> None:
        self._database, self._view = database, view
        with database.reading() as connection:
            known = sessions_by_key(connection, view, cameras := load_cameras(connection))
            self.sessions: Sequence[SessionId] = [one.id for one in known.values()]
            self._session_numbers = {key: number for number, key in enumerate(known)}
            self._cameras: dict[int, CameraId] = {key: one.id for key, one in cameras.items()}
            (self._visible,) = Visible.of(connection, view)
            path_rows = list(view.rows(connection, paths))
            self._removed = removed_measurements(view.rows(connection, removals))
            newest = connection.execute(select(func.max(nodes.c.key))).scalar() or 0
        if newest > _LARGEST_KEY:
            raise MapCorruptError(f"{database.name}: a node has the key {newest}; run engram check")
        self.end: int = newest
        self.paths: Sequence[PathId] = [
            PathId(uuid_from_bytes(row["uuid"], f"path {row['key']}")) for row in path_rows
        ]
        self._path_numbers = {row["key"]: number for number, row in enumerate(path_rows)}

    def page(self, number: int) -> GraphPage:
        """See `GraphPages`."""
        keys = {"first": number * PAGE + 1, "last": (number + 1) * PAGE}
        with reading_rows(self._database.name):
            found = self._seen(nodes, self._database.rows(_NODES, keys), _NODE_SIZES)
            found = found.rows(np.argsort(found["key"], kind="stable"))
            joined = self._seen(edges, self._database.rows(_EDGES, keys), _EDGE_SIZES)
            return GraphPage(
                number,
                (found["key"] - 1).astype(np.int32),
                found["uuid"],
                self._numbered(found),
                [self._camera(key) for key in found["camera"].tolist()],
                found["stamp_ns"],
                found["driven_m"],
                *self._edges(joined),
            )

    def find(self, node: NodeId) -> int | None:
        """See `GraphPages`."""
        row = self._database.first(_BY_UUID, {"uuid": node.bytes})
        if row is None or not self._visible.has(nodes, *row):
            return None
        return int(row[0]) - 1

    def ids(self, first: int) -> Iterator[NodeId | None]:
        """See `GraphPages`."""
        for start in range(first, self.end, _MANY):
            end = min(start + _MANY, self.end)
            keys = {"first": start + 1, "last": end}
            found = {
                key: node_from_bytes(uuid)
                for key, revision, uuid in self._database.rows(_IDS, keys)
                if self._visible.has(nodes, key, revision)
            }
            yield from (found.get(index + 1) for index in range(start, end))

    def unused(self, end: int) -> Iterator[int]:
        """See `GraphPages`; asks for the ranges of revisions, and for keys where they have gaps."""
        next_key = 1
        for first, last, whole in sorted(self._ranges()):
            yield from range(next_key - 1, min(first - 1, end))
            if not whole:
                found = zip(range(first - 1, min(last, end)), self.ids(first - 1), strict=False)
                yield from (index for index, node in found if node is None)
            next_key = last + 1
        yield from range(next_key - 1, end)
        hidden = self._visible.hidden_of(nodes)
        yield from (key - 1 for key in hidden if key <= end)

    def _ranges(self) -> Iterator[tuple[int, int, bool]]:
        """First and last key of the nodes of visible revisions, and whether all keys are used."""
        query = select(revisions).where(revisions.c.key.in_(self._view.revision_keys()))
        with self._database.reading() as connection:
            for row in verified(revisions, connection.execute(query)):
                if nodes.name in (own := own_rows(row).ranges):
                    first, last = own[nodes.name]
                    count = from_json(row["contents"], f"contents of revision {row['number']}").get(
                        nodes.name
                    )
                    yield first, last, last - first + 1 == count

    def edges(self) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """See `GraphPages`."""
        with self._database.reading() as connection:
            found = read_columns(connection, self._view, edges, _EDGE_SIZES)
        ends, _, poses, _ = self._edges(found)
        return ends, poses

    def visits(
        self, first: int, end: int
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.uint8]]:
        """See `PathPages`."""
        keys = {"first": first + 1, "last": end}
        with reading_rows(self._database.name):
            # With those that may supersede them, at whichever node they are.
            rows = {
                row[0]: row
                for query in (_ENTRIES, _SAME_PLACES)
                for row in self._database.rows(query, keys)
            }
            found = self._seen(path_entries, list(rows.values()), {})
            known = np.isin(found["path"], list(self._path_numbers))
            found = found.rows(np.flatnonzero(known)).newest("path", "sequence")
            here = (found["node"] > first) & (found["node"] <= end)
            found = found.rows(np.flatnonzero(here))
            codes, texts = found.texts["kind"]
            kinds = [ENTRY_KINDS.index(member(PathEntryKind, one, "path_entries")) for one in texts]
            numbers = [self._path_numbers[key] for key in found["path"].tolist()]
            return (
                (found["node"] - 1).astype(np.int32),
                np.array(numbers, np.int32),
                np.array(kinds, np.uint8)[codes],
            )

    def evidence(self, basin: MatchBasin) -> Callable[[int, int], Evidence]:
        """How past drives fared with the nodes from a dense index up to another one.

        Args:
            basin: gives the success rates of attempts.
        """
        good, bad = np.zeros((2, self.end))
        silent = set(range(len(self.sessions)))
        for session, made in self._drives():
            rates = basin.success_rate(
                made.along_m.astype(np.float64), made.across_m.astype(np.float64)
            )
            np.add.at(good, made.node, made.accepted)
            np.add.at(bad, made.node, np.where(made.accepted, 0.0, rates))
            silent.discard(session)
        quiet = {path_id(self.sessions[number]) for number in silent}
        return partial(
            self._evidence, good, bad, [at for at, one in enumerate(self.paths) if one in quiet]
        )

    def _evidence(
        self,
        good: NDArray[np.float64],
        bad: NDArray[np.float64],
        silent: list[int],
        first: int,
        end: int,
    ) -> Evidence:
        """The evidence of a range, by successes and failures of all nodes and silent paths."""
        keys = {"first": first + 1, "last": end}
        with reading_rows(self._database.name):
            found = self._seen(nodes, self._database.rows(_NODES, keys), _NODE_SIZES)
            found = found.rows(np.argsort(found["key"], kind="stable"))
            joined = self._seen(edges, self._database.rows(_STEPS, keys), _EDGE_SIZES)
            at, sessions = (found["key"] - 1).astype(np.int32), self._numbered(found)
            links = np.searchsorted(at, self._edges(joined)[0])
            links = links[sessions[links[:, 0]] == sessions[links[:, 1]]]
            matched = good[at]
            if silent:
                visited, on, _ = self.visits(first, end)
                walked = visited[np.isin(on, silent)]
                np.add.at(matched, np.searchsorted(at, walked), 1.0)
        return Evidence(at, found["driven_m"], links.astype(np.int32), matched, bad[at])

    def _drives(self) -> Iterator[tuple[int, Attempts]]:
        """The attempts between visible nodes of one session after another, with its number."""
        hidden = np.array(list(self._visible.hidden_of(nodes)), np.int64)
        for key, number in self._session_numbers.items():
            rows = [
                row
                for row in verified(attempts, self._database.rows(_OF_SESSION, {"session": key}))
                if self._visible.has(attempts, row["key"], row["revision"])
            ]
            rows.sort(key=lambda row: (self._visible.places[row["revision"]], row["key"]))
            made = Attempts.joined([unpack(row["body"], row["count"]) for row in rows])
            ends = np.stack([made.reference, made.node]).astype(np.int64)
            seen = ((ends > 0) & (ends <= self.end) & ~np.isin(ends, hidden)).all(axis=0)
            if seen.any():
                made = made.rows(np.flatnonzero(seen))
                yield number, replace(made, node=(made.node - 1).astype(np.int32))

    @cached_property
    def basin_counts(self) -> BasinCounts:
        """Counts of the attempts of all drives, from which match basins are learnt."""
        experiences = self._experiences()
        counts = BasinCounts.empty()
        for _, made in self._drives():
            counts += count_attempts(
                np.zeros(len(made), np.int64),
                experiences[made.node],
                made.iteration,
                (made.along_m.astype(np.float64), made.across_m.astype(np.float64)),
                made.sigma_m.astype(np.float64),
                made.accepted,
            )
        return counts

    def _experiences(self) -> NDArray[np.int64]:
        """(end,) int64: equal for the nodes of a chain of odometry edges within a session."""
        sessions = np.full(self.end + 1, -1, np.int64)
        for key, revision, session in self._database.rows(_OWNERS, {}):
            if self._visible.has(nodes, key, revision):
                sessions[key] = session
        rows = self._database.rows(_ALL_STEPS, {})
        steps = [(a, b) for key, revision, a, b in rows if self._visible.has(edges, key, revision)]
        ends = np.array(steps, np.int64).reshape(-1, 2)
        a, b = sessions[ends].T
        return labels_of(ends[(a == b) & (a >= 0)] - 1, self.end)

    def _seen(
        self, table: Table, rows: Sequence[tuple[Any, ...]], sizes: dict[str, int]
    ) -> Columns:
        """The visible ones of some rows, verified, by revision and then by key."""
        found = Columns.verified(table, rows, sizes)
        found = found.rows(np.flatnonzero(self._visible.shows(table, found)))
        return self._visible.in_history(found)

    def _edges(
        self, found: Columns
    ) -> tuple[NDArray[np.int32], NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64]]:
        """Ends, kinds, poses and covariances of the edges that count, of rows in their order."""
        found = without_removed(self._removed, found.newest("a", "b", "kind"))
        codes, texts = found.texts["kind"]
        numbers = [EDGE_KINDS.index(member(EdgeKind, text, "edges")) for text in texts]
        return (
            np.column_stack([found["a"] - 1, found["b"] - 1]).astype(np.int32),
            np.array(numbers, np.uint8)[codes],
            *edge_arrays(found["a_from_b"], found["covariance"], found["key"]),
        )

    def _numbered(self, found: Columns) -> NDArray[np.int32]:
        """(n,) int32: the numbers of the nodes' sessions."""
        keys = found["session"].tolist()
        numbers = [self._session_numbers.get(key, -1) for key in keys]
        if -1 in numbers:
            at = numbers.index(-1)
            raise MapCorruptError(
                f"node {int(found['key'][at])}: its session, row {keys[at]}, is missing"
            )
        return np.array(numbers, np.int32)

    def _camera(self, key: int) -> CameraId:
        if key not in self._cameras:
            raise MapCorruptError(f"table nodes: a node's camera, row {key}, is missing")
        return self._cameras[key]


_MANY = 4096
_FIRST: BindParameter[int] = bindparam("first")
_LAST: BindParameter[int] = bindparam("last")
_NODES = select(*nodes.columns).where(nodes.c.key.between(_FIRST, _LAST))
_EDGES = union_all(
    select(*edges.columns).where(edges.c.a.between(_FIRST, _LAST)),
    select(*edges.columns).where(
        edges.c.b.between(_FIRST, _LAST), not_(edges.c.a.between(_FIRST, _LAST))
    ),
)
_IDS = select(nodes.c.key, nodes.c.revision, nodes.c.uuid).where(nodes.c.key.between(_FIRST, _LAST))
_STEPS = select(*edges.columns).where(
    edges.c.a.between(_FIRST, _LAST),
    edges.c.b.between(_FIRST, _LAST),
    edges.c.kind == literal_column(f"'{EdgeKind.ODOMETRY}'"),
)
# Of these an index has all columns.
_ALL_STEPS = select(edges.c.key, edges.c.revision, edges.c.a, edges.c.b).where(
    edges.c.kind == literal_column(f"'{EdgeKind.ODOMETRY}'")
)
_OWNERS = select(nodes.c.key, nodes.c.revision, nodes.c.session)
_OF_SESSION = select(*attempts.columns).where(attempts.c.session == bindparam("session"))
_ENTRIES = select(*path_entries.columns).where(path_entries.c.node.between(_FIRST, _LAST))
_same = path_entries.alias()
_SAME_PLACES = (
    select(*path_entries.columns)
    .select_from(_same)
    .join(
        path_entries,
        and_(
            path_entries.c.path == _same.c.path,
            path_entries.c.sequence == _same.c.sequence,
            path_entries.c.revision != _same.c.revision,
        ),
    )
    .where(_same.c.node.between(_FIRST, _LAST))
)
_BY_UUID = select(nodes.c.key, nodes.c.revision).where(nodes.c.uuid == bindparam("uuid"))
