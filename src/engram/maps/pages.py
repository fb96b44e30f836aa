"""The pages of a map's graph, as of one revision: rows found by ranges of node keys.

A node's dense index is its key less one: keys are counted up from 1 in the order of saving, so that
the nodes of a page were saved one after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import (
    BindParameter,
    Table,
    and_,
    bindparam,
    literal_column,
    not_,
    select,
    union_all,
)

from engram.errors import MapCorruptError
from engram.geometry.cameras import CameraId
from engram.graph.basin import BasinCounts, MatchBasin
from engram.graph.graph import EDGE_KINDS
from engram.graph.model import (
    EdgeKind,
    NodeId,
    PathEntry,
    PathEntryKind,
    PathId,
    SessionId,
)
from engram.graph.pages import PAGE, GraphPage
from engram.graph.paths import ENTRY_KINDS, Attempts, Evidence
from engram.maps.attempts import PAGE as ATTEMPT_PAGE
from engram.maps.attempts import page_of, unpack, unpack_drive
from engram.maps.columns import Columns, Visible, read_columns, stretches
from engram.maps.counting import count_open, totals_of
from engram.maps.marks import removed_measurements, without_removed
from engram.maps.reading import load_cameras, sessions_by_key
from engram.maps.rows import (
    Row,
    edge_arrays,
    from_json,
    member,
    node_from_bytes,
    uuid_from_bytes,
    verified,
)
from engram.maps.runs import Runs
from engram.maps.schema import (
    attempts,
    edges,
    nodes,
    path_entries,
    paths,
    removals,
    revisions,
)
from engram.maps.sqlite import SqliteDatabase, reading_rows
from engram.maps.totals import count_all, own_rows
from engram.maps.view import View, head

# Dense indices are of 32 bits; what a process adds follows after those of the map.
_LARGEST_KEY = 2**31 - 2**24


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
            (visible,) = Visible.of(connection, view, ask=database.rows)
            self._visible = visible.as_of_now(connection)
            path_rows = list(view.rows(connection, paths))
            self._removed = removed_measurements(view.rows(connection, removals))
        newest = self._visible.until[nodes.name]
        if newest > _LARGEST_KEY:
            raise MapCorruptError(f"{database.name}: a node has the key {newest}; run engram check")
        self.end: int = newest
        self.paths: Sequence[PathId] = [
            PathId(uuid_from_bytes(row["uuid"], f"path {row['key']}")) for row in path_rows
        ]
        self._path_numbers = {row["key"]: number for number, row in enumerate(path_rows)}
        self._path_sessions = [row["session"] for row in path_rows]
        self._silent: dict[int, bool] = {}  # by number of the path, as far as requested

    def page(self, number: int) -> GraphPage:
        """See `GraphPages`."""
        return self.part(number * PAGE, (number + 1) * PAGE)

    def part(self, first: int, end: int) -> GraphPage:
        """The nodes from one dense index up to another, and their edges, as one large page."""
        keys = {"first": first + 1, "last": end}
        with reading_rows(self._database.name):
            found = self._seen(nodes, self._database.rows(_NODES, keys))
            found = found.rows(np.argsort(found["key"], kind="stable"))
            joined = self._seen(edges, self._database.rows(_EDGES, keys))
            return GraphPage(
                first // PAGE,
                (found["key"] - 1).astype(np.int32),
                found["uuid"],
                self._numbered(found),
                [self._camera(key) for key in found["camera"].tolist()],
                found["stamp_ns"],
                found["driven_m"],
                *self._edges(joined),
            )

    def edges_at(self, some: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """See `GraphPages`."""
        rows: dict[int, tuple[Any, ...]] = {}
        with reading_rows(self._database.name):
            for first, last in stretches(some + 1):
                found = self._database.rows(_EDGES, {"first": first, "last": last})
                rows.update((row[0], row) for row in found)
            ends, _, poses, _ = self._edges(self._seen(edges, list(rows.values())))
        return ends, poses

    def find(self, node: NodeId) -> int | None:
        """See `GraphPages`."""
        row = self._database.first(_BY_UUID, {"uuid": node.bytes})
        if row is None or not self._visible.has(nodes, *row):
            return None
        return int(row[0]) - 1

    def session_of(self, index: int) -> SessionId:
        """See `GraphPages`."""
        with reading_rows(self._database.name):
            found = self._database.rows(_NODES, {"first": index + 1, "last": index + 1})
            (row,) = verified(nodes, found)
            return self.sessions[self._session_numbers[row["session"]]]

    def ids(self, first: int, end: int) -> Iterator[NodeId | None]:
        """See `GraphPages`."""
        for start in range(first, end, _MANY):
            stop = min(start + _MANY, end)
            keys = {"first": start + 1, "last": stop}
            found = {
                key: node_from_bytes(uuid)
                for key, revision, uuid in self._database.rows(_IDS, keys)
                if self._visible.has(nodes, key, revision)
            }
            yield from (found.get(index + 1) for index in range(start, stop))

    def experiences(self, nodes: NDArray[np.int32]) -> NDArray[np.int32]:
        """See `GraphPages`."""
        at = self._runs.find(nodes.astype(np.int64) + 1)
        if (at < 0).any():
            raise MapCorruptError(
                f"{self._database.name}: node {int(nodes[at < 0][0]) + 1} is in no run of nodes; "
                "run engram check"
            )
        return (self._runs.experience[at] - 1).astype(np.int32)

    @cached_property
    def _runs(self) -> Runs:
        """The runs of all visible nodes."""
        with self._database.reading() as connection:
            if self._view.own is None and self._view.at < head(connection):
                return count_all(connection, self._view)[1]
            return count_open(connection, self._view)[1]

    def unused(self, end: int) -> Iterator[int]:
        """See `GraphPages`; asks for the ranges of revisions, and for keys where they have gaps."""
        next_key = 1
        for first, last, whole in sorted(self._ranges()):
            yield from range(next_key - 1, min(first - 1, end))
            if not whole:
                stop = min(last, end)
                found = zip(range(first - 1, stop), self.ids(first - 1, stop), strict=True)
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
            found = read_columns(connection, self._view, edges)
        ends, _, poses, _ = self._edges(found)
        return ends, poses

    def visits(
        self, first: int, end: int
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.uint8]]:
        """See `PathPages`."""
        with reading_rows(self._database.name):
            found = self._entries(first, end)
            codes, texts = found.texts["kind"]
            kinds = [ENTRY_KINDS.index(member(PathEntryKind, one, "path_entries")) for one in texts]
            numbers = [self._path_numbers[key] for key in found["path"].tolist()]
            return (
                (found["node"] - 1).astype(np.int32),
                np.array(numbers, np.int32),
                np.array(kinds, np.uint8)[codes],
            )

    @cached_property
    def basin_counts(self) -> BasinCounts:
        """Counts of the attempts of all drives, from which match basins are learnt."""
        with self._database.reading() as connection:
            return totals_of(connection, self._view).basin_counts

    def entries(self, first: int, end: int, ids: Mapping[int, NodeId]) -> list[PathEntry]:
        """Path entries at nodes in a range of dense indices.

        Args:
            first, end: dense indices of the first node and of that after the last.
            ids: the nodes in question, by dense index.
        """
        with reading_rows(self._database.name):
            found = self._entries(first, end)
            codes, texts = found.texts["kind"]
            kinds = [member(PathEntryKind, text, "path_entries") for text in texts]
            names = ("path", "sequence", "node", "stamp_ns")
            rows = zip(*(found[name].tolist() for name in names), codes.tolist(), strict=True)
            return [
                PathEntry(
                    self.paths[self._path_numbers[path]],
                    sequence,
                    ids[node - 1],
                    kinds[code],
                    stamp_ns,
                )
                for path, sequence, node, stamp_ns, code in rows
                if node - 1 in ids
            ]

    def _entries(self, first: int, end: int) -> Columns:
        """The newest entries that are at nodes of a range."""
        keys = {"first": first + 1, "last": end}
        # With those that may supersede them, at whichever node they are.
        rows = {
            row[0]: row
            for query in (_ENTRIES, _SAME_PLACES)
            for row in self._database.rows(query, keys)
        }
        found = self._seen(path_entries, list(rows.values()))
        known = np.isin(found["path"], list(self._path_numbers))
        found = found.rows(np.flatnonzero(known)).newest("path", "sequence")
        here = (found["node"] > first) & (found["node"] <= end)
        return found.rows(np.flatnonzero(here))

    def attempts(self, some: NDArray[np.int64]) -> Attempts:
        """The remembered attempts between some nodes (N,), given and returned by dense index.

        Returns:
            `session` is a place in `sessions`; each session's attempts in order.
        """
        chosen = np.zeros(self.end + 1, np.bool_)
        chosen[some + 1] = True
        parts = []
        with reading_rows(self._database.name):
            rows = self._attempt_rows(np.unique(page_of(some + 1)).tolist())
            for session, own in groupby(rows, key=itemgetter("session")):
                made = unpack_drive(list(own))
                ends = np.stack([made.reference, made.node]).astype(np.int64)
                known = ends <= self.end  # those of erased nodes may be beyond
                seen = known & chosen[np.where(known, ends, 0)]
                made = made.rows(np.flatnonzero(seen.all(axis=0)))
                parts.append(
                    replace(
                        made,
                        session=np.full(len(made), self._session_numbers[session], np.int32),
                        reference=(made.reference - 1).astype(np.int32),
                        node=(made.node - 1).astype(np.int32),
                    )
                )
        return Attempts.joined(parts)

    def _attempt_rows(self, pages: Iterable[int]) -> list[Row]:
        """Rows of attempts on pages of nodes: session by session, earlier revisions first."""
        rows = [
            row
            for page in pages
            for row in verified(attempts, self._database.rows(_ON_PAGE, {"page": page}))
            if self._visible.has(attempts, row["key"], row["revision"])
            and row["session"] in self._session_numbers
        ]
        numbers, places = self._session_numbers, self._visible.places
        return sorted(
            rows, key=lambda row: (numbers[row["session"]], places[row["revision"]], row["key"])
        )

    def evidence(self, basin: MatchBasin) -> Callable[[int, int], Evidence]:
        """How past drives fared with the nodes from a dense index up to another one.

        Args:
            basin: gives the success rates of attempts.
        """
        return partial(self._evidence, basin, {})

    def _evidence(
        self, basin: MatchBasin, known: dict[int, NDArray[np.float64]], first: int, end: int
    ) -> Evidence:
        """The evidence of a range; `known` takes successes and failures by page of attempts."""
        keys = {"first": first + 1, "last": end}
        with reading_rows(self._database.name):
            found = self._seen(nodes, self._database.rows(_NODES, keys))
            found = found.rows(np.argsort(found["key"], kind="stable"))
            joined = self._seen(edges, self._database.rows(_STEPS, keys))
            at, sessions = (found["key"] - 1).astype(np.int32), self._numbered(found)
            links = np.searchsorted(at, self._edges(joined)[0])
            links = links[sessions[links[:, 0]] == sessions[links[:, 1]]]
            good, bad = self._fared(basin, known, found["key"])
            visitors = self._database.rows(_VISITORS, keys)
            silent = [
                number
                for (path,) in visitors
                if (number := self._path_numbers.get(path)) is not None and self._is_silent(number)
            ]
            if silent:
                visited, on, _ = self.visits(first, end)
                walked = visited[np.isin(on, silent)]
                np.add.at(good, np.searchsorted(at, walked), 1.0)
        return Evidence(at, found["driven_m"], links.astype(np.int32), good, bad)

    def _fared(
        self, basin: MatchBasin, known: dict[int, NDArray[np.float64]], keys: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """(2, n) successes, and weights of failures, of nodes with these keys (n,)."""
        numbers, which = np.unique(page_of(keys), return_inverse=True)
        if len(known) > _MOST_PAGES:  # they are asked for while a robot is near
            known.clear()
        for page in numbers.tolist():
            if page not in known:
                known[page] = self._fared_on(basin, page)
        if not len(keys):
            return np.zeros((2, 0))
        pages = np.stack([known[page] for page in numbers.tolist()])
        return np.ascontiguousarray(pages[which, :, (keys - 1) % ATTEMPT_PAGE].T)

    def _fared_on(self, basin: MatchBasin, page: int) -> NDArray[np.float64]:
        """(2, ATTEMPT_PAGE) successes, and weights of failures, of the nodes of a page."""
        made = self._attempts_on(page)
        rates = basin.success_rate(
            made.along_m.astype(np.float64), made.across_m.astype(np.float64)
        )
        at = (made.node - 1) % ATTEMPT_PAGE
        weights = made.accepted, np.where(made.accepted, 0.0, rates)
        return np.stack([np.bincount(at, one, ATTEMPT_PAGE) for one in weights])

    def _attempts_on(self, page: int) -> Attempts:
        """The attempts of all sessions, one after another, on a page of nodes."""
        rows = self._attempt_rows([page])
        made = Attempts.joined([self._between_visible(row) for row in rows])
        here = np.flatnonzero(page_of(made.node) == page)
        return made if len(here) == len(made) else made.rows(here)

    def _between_visible(self, row: Row) -> Attempts:
        """The attempts of a row between visible nodes."""
        _, made = unpack(row["body"], row["count"])
        if not (hidden := self._visible.hidden_of(nodes)):
            return made
        gone = np.isin([made.reference, made.node], list(hidden))
        return made.rows(np.flatnonzero(~gone.any(axis=0)))

    def _is_silent(self, path: int) -> bool:
        """Whether the session of a path has no attempts between visible nodes."""
        if path not in self._silent:
            session = self._path_sessions[path]
            rows = self._database.rows(_OF_SESSION, {"session": session})
            self._silent[path] = session in self._session_numbers and not any(
                len(self._between_visible(row))
                for row in verified(attempts, rows)
                if self._visible.has(attempts, row["key"], row["revision"])
            )
        return self._silent[path]

    def _seen(self, table: Table, rows: Sequence[tuple[Any, ...]]) -> Columns:
        """The visible ones of some rows, verified, by revision and then by key."""
        found = Columns.verified(table, rows)
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
_MOST_PAGES = 64
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
_OF_SESSION = select(*attempts.columns).where(attempts.c.session == bindparam("session"))
_ON_PAGE = select(*attempts.columns).where(attempts.c.page == bindparam("page"))
_VISITORS = select(path_entries.c.path).where(path_entries.c.node.between(_FIRST, _LAST)).distinct()
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
