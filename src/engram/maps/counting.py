"""The totals and runs after a revision, counted on from those before by what it changes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from sqlalchemy import Connection, func, select

from engram.errors import MapCorruptError
from engram.geometry.cameras import CameraId
from engram.graph.basin import BasinCounts
from engram.graph.graph import labels_of
from engram.graph.model import EdgeKind
from engram.maps.attempts import page_of
from engram.maps.changes import Changes, Touched, columns_of, rows_by, rows_within
from engram.maps.columns import Columns, Visible, stretches
from engram.maps.marks import without_removed
from engram.maps.reading import descriptor_of, load_cameras
from engram.maps.records import MapInfo
from engram.maps.rows import verified
from engram.maps.runs import Keys, Runs
from engram.maps.schema import (
    attempts,
    edges,
    nodes,
    path_entries,
    paths,
    placements,
    sessions,
)
from engram.maps.totals import (
    Own,
    Owners,
    Totals,
    basin_of,
    count_all,
    greater_m,
    joints,
    state_at_head,
    totals_at,
    with_edges,
)
from engram.maps.view import View

_FILMED = (sessions, nodes)
# Nodes whose edges are read at once, and how many times from one part before the next.
_AT_ONCE, _STEPS = 256, 4


def totals_of(connection: Connection, view: View) -> Totals:
    """The totals of a view: as stored, with what an open revision has by now."""
    return totals_at(connection, view.at) if view.own is None else count_open(connection, view)[0]


def info(connection: Connection, view: View, *, size_bytes: int) -> MapInfo:
    """Counts and sizes of the map."""
    found = totals_of(connection, view)
    return MapInfo(
        revision=view.at,
        descriptor=descriptor_of(connection, view),
        cameras=len(found.cameras),
        sessions=found.sessions,
        nodes=found.nodes,
        edges=sum(found.edges.values()),
        edges_of_kind={str(kind): found.edges[kind] for kind in EdgeKind if kind in found.edges},
        path_entries=found.path_entries,
        attempts=found.attempts,
        mapped_m=found.mapped_m,
        size_bytes=size_bytes,
    )


def count_open(
    connection: Connection, view: View, own: Own | None = None
) -> tuple[Totals, Runs, Runs | None]:
    """The totals and runs with an open revision, and the stored runs, if they fit.

    Args:
        connection: of the map.
        view: the newest revision and the open one.
        own: the rows of the open one, if known.
    """
    before, runs = state_at_head(connection, view.at)
    if runs is None:
        return *count_all(connection, view), None
    changes = Changes.between(connection, View(view.at), view, own)
    return *count_on(connection, view, before, runs, changes), runs


def count_on(
    connection: Connection, view: View, before: Totals, runs: Runs, changes: Changes
) -> tuple[Totals, Runs]:
    """The totals and runs of a view.

    Args:
        connection: of the map.
        view: the view.
        before: the totals of another view.
        runs: the runs of the other one.
        changes: what differs between the two.
    """
    fresh = changes[nodes].gained
    fresh = fresh.rows(np.argsort(fresh["key"]))
    owners = Owners(connection, fresh["key"], fresh["session"], fresh["camera"])
    cameras = _cameras(connection, view, before, changes)
    found = with_edges(before, changes[edges].lost, owners, -1)
    found = with_edges(found, changes[edges].gained, owners)
    found = replace(
        found,
        cameras=cameras,
        sessions=before.sessions + _more(changes[sessions]),
        paths=before.paths + _more(changes[paths]),
        path_entries=before.path_entries + _more(changes[path_entries]),
        attempts=before.attempts + _more(changes[attempts], "count"),
        forward={camera: shift for camera, shift in found.forward.items() if camera in cameras},
        right_m=_right_m(connection, before, changes[placements], changes.after),
    )
    after = _parted(connection, runs, changes, owners)
    after = after.with_nodes(fresh["key"]).joined(*joints(changes[edges].gained, owners))
    basin = _basin(connection, before, runs, after, changes)
    return found.with_basin(basin).of_runs(after), after


def _basin(
    connection: Connection, before: Totals, runs: Runs, after: Runs, changes: Changes
) -> BasinCounts:
    """Counts of attempts: of the sessions concerned all are counted again."""
    found = before.basin_counts
    for session in _concerned(connection, before, runs, after, changes):
        query = select(attempts).where(attempts.c.session == session).order_by(attempts.c.key)
        rows = list(verified(attempts, connection.execute(query)))
        parts = [
            [row for row in rows if shown.has(attempts, row["key"], row["revision"])]
            for shown in (changes.before, changes.after)
        ]
        found = found - basin_of(parts[0], runs) + basin_of(parts[1], after)
    return found


def _concerned(
    connection: Connection, before: Totals, runs: Runs, after: Runs, changes: Changes
) -> set[int]:
    """Sessions whose attempts may count otherwise than before, by key.

    They gain or lose attempts, or made some at nodes that come or go or whose experience is another
    one.
    """
    tried = changes[attempts]
    found = set(tried.rows["session"][tried.seen[0] != tried.seen[1]].tolist())
    if not before.attempts:
        return found
    known, come = changes[nodes], changes[nodes].gained
    again = come["key"][np.isin(come["revision"], list(changes.before.places))]
    parts = [(int(key), int(key)) for key in (*known.lost["key"], *again)]
    pages = {
        page
        for first, last in (*parts, *runs.regrouped(after))
        for page in range(int(page_of(first)), int(page_of(last)) + 1)
    }
    for first, last in stretches(pages):
        query = select(attempts.c.session).where(attempts.c.page.between(first, last)).distinct()
        found |= set(connection.execute(query.order_by(attempts.c.session)).scalars())
    return found


def _more(touched: Touched, column: str = "") -> int:
    """By how much the number of rows, or the sum of a column, grows."""
    weight = touched.rows[column] if column else np.ones(len(touched.rows), np.int64)
    before, after = (touched.counts @ weight).tolist()
    return int(after - before)


def _cameras(
    connection: Connection, view: View, before: Totals, changes: Changes
) -> tuple[CameraId, ...]:
    """Ids of the cameras that visible sessions or nodes have, rising."""
    ids = {key: one.id for key, one in load_cameras(connection).items()}
    gained, lost = (
        {key for touched in parts for key in touched["camera"].tolist()}
        for parts in zip(
            *((changes[one].gained, changes[one].lost) for one in _FILMED), strict=True
        )
    )
    if missing := (gained | lost) - ids.keys():
        raise MapCorruptError(f"table cameras: row {min(missing)}, which others use, is missing")
    unused = {ids[key] for key in lost - gained if not _is_used(connection, view, key)}
    return tuple(sorted({*before.cameras, *(ids[key] for key in gained)} - unused))


def _is_used(connection: Connection, view: View, camera: int) -> bool:
    queries = (view.select(one).where(one.c.camera == camera).order_by(None) for one in _FILMED)
    return any(connection.execute(query.limit(1)).first() is not None for query in queries)


def _right_m(
    connection: Connection, before: Totals, placed: Touched, shown: Visible
) -> float | None:
    """The largest x of a place."""
    lost, gained = (one["map_from_node"].view("<f8")[:, 9] for one in (placed.lost, placed.gained))
    known = before.right_m
    if known is not None and len(lost) and lost.max() >= known > gained.max(initial=-np.inf):
        return _rightmost_m(connection, shown)
    return greater_m(known, gained)


def _rightmost_m(connection: Connection, shown: Visible) -> float | None:
    """The largest x of a place, metres: the strips of cells are read from the right."""
    beyond = 2**63 - 1
    while True:
        query = select(func.max(placements.c.cell)).where(placements.c.cell < beyond)
        top = connection.execute(query).scalar()
        if top is None:
            return None
        beyond = top >> 32 << 32
        held = columns_of(placements, rows_within(connection, placements, "cell", (beyond, top)))
        at = rows_by(connection, placements, "node", held["node"])  # which may lie elsewhere now
        found = columns_of(placements, at.values())
        found = found.rows(np.flatnonzero(shown.shows(placements, found)))
        found = shown.in_history(found).newest("node")
        here = found["map_from_node"].view("<f8")[found["cell"] >= beyond, 9]
        if len(here):
            return float(here.max())


def _parted(connection: Connection, runs: Runs, changes: Changes, owners: Owners) -> Runs:
    """The runs without the nodes and edges that are lost."""
    gone, touched = changes[nodes].lost["key"], changes[edges]
    if not len(touched.lost) and not len(gone):
        return runs
    runs, kept = runs.without(gone), _Kept(connection, changes)
    chained, ends = (
        np.setdiff1d(lost, gone)
        for lost in _lost(joints(touched.lost, owners), joints(touched.gained, owners))
    )
    runs = runs.with_chains(_chains(runs, kept, owners, chained))
    return runs.with_components(_Spreading(runs, kept, ends).parts())


def _lost(lost: tuple[Keys, Keys], gained: tuple[Keys, Keys]) -> Iterator[Keys]:
    """The nodes at which edges go, but those in whose place others come."""
    for old, new in zip(lost, gained, strict=True):
        pairs = set(map(tuple, old.tolist())) - set(map(tuple, new.tolist()))
        yield np.array([node for pair in pairs for node in pair], np.int64)


@dataclass(frozen=True, slots=True)
class _Kept:
    """The edges that count before and after.

    Attributes:
        connection: of the map.
        changes: what differs.
    """

    connection: Connection
    changes: Changes

    def at(self, first: int, last: int) -> Columns:
        """Those at the nodes with keys from the first to the last."""
        rows = {
            row[0]: row
            for end in ("a", "b")
            for row in rows_within(self.connection, edges, end, (first, last))
        }
        found, shown = columns_of(edges, rows.values()), self.changes.after
        found = found.rows(np.flatnonzero(shown.shows(edges, found)))
        found = shown.in_history(found).newest("a", "b", "kind")
        found = without_removed(self.changes.removed[1], found)
        fresh = np.isin(found["key"], self.changes[edges].gained["key"])
        return found.rows(np.flatnonzero(~fresh))


def _chains(runs: Runs, kept: _Kept, owners: Owners, ends: Keys) -> list[Keys]:
    """The nodes of each of the chains into which those fall that lost odometry edges at `ends`."""
    found = []
    for label in np.unique(runs.experience[runs.find(ends)]).tolist():
        stretches = runs.stretches(label)
        held = np.concatenate([np.arange(first, last + 1) for first, last in stretches])
        steps = np.concatenate(
            [joints(kept.at(*part), owners)[0] for one in stretches for part in _chunks(*one)]
        )
        groups = labels_of(np.searchsorted(held, steps), len(held))
        found += [held[groups == number] for number in range(int(groups.max()) + 1)]
    return found


def _chunks(first: int, last: int) -> Iterator[tuple[int, int]]:
    """Parts of a stretch of nodes, each of which is read at once."""
    for start in range(first, last + 1, _AT_ONCE):
        yield start, min(start + _AT_ONCE - 1, last)


class _Spreading:
    """Spreads from chains that lost edges until it is known which are still connected.

    Where all but one of the parts of what was connected are known whole, the last is the rest: what
    is spread over is hardly more than the smaller parts.

    Args:
        runs: without the nodes that are gone.
        kept: the edges.
        ends: (N,) nodes at which edges went.
    """

    def __init__(self, runs: Runs, kept: _Kept, ends: Keys) -> None:
        self._runs, self._kept = runs, kept
        self._part: dict[int, int] = {}  # of each chain, named by one of its chains
        self._members: dict[int, list[int]] = {}
        self._open: dict[int, list[tuple[int, int]]] = {}  # nodes not spread from yet
        self._component: dict[int, int] = {}
        for node in ends.tolist():
            self._add(node)

    def parts(self) -> list[Keys]:
        """The chains of each part that is known whole."""
        while chosen := self._smaller():
            for root in chosen:
                if root in self._open:  # else another one has reached it
                    at_once, self._open[root] = self._open[root][:_STEPS], self._open[root][_STEPS:]
                    for stretch in at_once:
                        self._spread(*stretch)
        return [
            np.array(self._members[root], np.int64)
            for roots in self._by_component().values()
            if len(roots) > 1
            for root in roots
            if not self._open[root]
        ]

    def _by_component(self) -> dict[int, list[int]]:
        roots = defaultdict(list)
        for root in self._members:
            roots[self._component[root]].append(root)
        return roots

    def _smaller(self) -> list[int]:
        """The parts from which to spread: all but the largest open one of each component."""
        chosen = []
        for roots in self._by_component().values():
            spread = [root for root in roots if self._open[root]]
            spread.sort(key=lambda root: len(self._members[root]))
            chosen += spread[:-1]
        return chosen

    def _spread(self, first: int, last: int) -> None:
        found = self._kept.at(first, last)
        ends = np.column_stack([found["a"], found["b"]]).reshape(-1, 2)
        chains = self._runs.experience[self._runs.find(ends.ravel())].reshape(-1, 2)
        _, one_of_each = np.unique(chains, axis=0, return_index=True)
        for a, b in ends[one_of_each].tolist():
            self._join(self._add(a), self._add(b))

    def _add(self, node: int) -> int:
        """The part of a node's chain, a new one perhaps."""
        (at,) = self._runs.find(np.array([node]))
        chain = int(self._runs.experience[at])
        if chain not in self._part:
            self._part[chain], self._members[chain] = chain, [chain]
            self._component[chain] = int(self._runs.component[at])
            self._open[chain] = sorted(
                (part for one in self._runs.stretches(chain) for part in _chunks(*one)),
                key=lambda part: abs(part[0] - node),
            )
        return self._part[chain]

    def _join(self, one: int, other: int) -> None:
        if one == other:
            return
        if len(self._members[one]) < len(self._members[other]):
            one, other = other, one
        for chain in self._members[other]:
            self._part[chain] = one
        self._members[one] += self._members.pop(other)
        self._open[one] += self._open.pop(other)
