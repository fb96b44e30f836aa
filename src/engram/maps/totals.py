"""What is visible as of a revision, in numbers: stored with it, or counted from all rows.

`engram.maps.counting` counts on from those of the revision before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, Select, Table, and_, func, or_, select

from engram.errors import MapCorruptError
from engram.geometry.cameras import CameraId
from engram.graph.basin import BIN_COUNT, BasinCounts, count_attempts
from engram.graph.model import EdgeKind
from engram.graph.paths import Attempts
from engram.maps.attempts import unpack
from engram.maps.columns import Columns, read_columns
from engram.maps.marks import counting
from engram.maps.reading import load_cameras
from engram.maps.rows import Row, verified
from engram.maps.runs import Keys, Runs, load_runs
from engram.maps.schema import (
    attempts,
    edges,
    nodes,
    path_entries,
    paths,
    placements,
    receipts,
    removals,
    revisions,
    sessions,
)
from engram.maps.view import LARGEST_KEY, View, few, places_in_history

# Rows read at once.
_AT_ONCE = 20_000

_Key = Annotated[int, msgspec.Meta(ge=0, le=LARGEST_KEY)]
_Bins = Annotated[tuple[_Key, ...], msgspec.Meta(min_length=BIN_COUNT, max_length=BIN_COUNT)]
Bins = tuple[_Bins, _Bins, _Bins, _Bins]
Forward = Mapping[CameraId, tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class Totals:
    """What a map holds as of a revision.

    Attributes:
        cameras: ids of the cameras of visible sessions and nodes, rising.
        sessions, nodes, paths, path_entries, attempts: number of visible ones.
        edges: number of visible edges by kind, of kinds that have any.
        mapped_m: length of the odometry edges, metres.
        experiences: number of chains of odometry edges within drives.
        components, largest_component: number of connected components, and of nodes of the largest.
        forward: sum of the translations of the odometry edges of each camera, metres: where it
            looks.
        right_m: largest x of a stored place in the map frame; None if there is none.
        basin: `basin_counts`: attempts along and across, then successes along and across.
    """

    cameras: tuple[CameraId, ...] = ()
    sessions: int = 0
    nodes: int = 0
    paths: int = 0
    path_entries: int = 0
    attempts: int = 0
    edges: Mapping[str, int] = field(default_factory=dict)
    mapped_m: float = 0.0
    experiences: int = 0
    components: int = 0
    largest_component: int = 0
    forward: Forward = field(default_factory=dict)
    right_m: float | None = None
    basin: Bins = ((0,) * BIN_COUNT,) * 4

    @staticmethod
    def from_json(text: str, what: str) -> Totals:
        """Undoes `to_json`."""
        try:
            return msgspec.json.decode(text, type=Totals)
        except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
            raise MapCorruptError(f"{what}: its totals are malformed: {error}") from error

    def to_json(self) -> str:
        """As stored."""
        return msgspec.json.encode(self, order="sorted").decode()

    @property
    def basin_counts(self) -> BasinCounts:
        """Counts of the attempts between visible nodes, from which match basins are learnt."""
        counts = np.array(self.basin, np.int64)
        return BasinCounts(counts[:2], counts[2:])

    def with_basin(self, counts: BasinCounts) -> Totals:
        """With other counts of attempts."""
        (a, b), (c, d) = (map(tuple, one.tolist()) for one in (counts.attempts, counts.successes))
        return replace(self, basin=(a, b, c, d))

    def agrees(self, other: Totals) -> bool:
        """Whether they are equal, but for the rounding of sums and of places."""
        cameras = sorted({*self.forward, *other.forward})
        (exact, rough), (its_exact, its_rough) = (one._parts(cameras) for one in (self, other))
        return exact == its_exact and np.allclose(rough, its_rough)

    def _parts(self, cameras: Sequence[CameraId]) -> tuple[Totals, list[float]]:
        rough = [self.mapped_m, self.right_m or 0.0]
        # Edges that are gone may leave the rounding of their sum.
        rough += [shift for one in cameras for shift in self.forward.get(one, (0.0,) * 3)]
        return replace(self, mapped_m=0.0, right_m=None, forward={}), rough

    def of_runs(self, runs: Runs) -> Totals:
        """With the numbers that follow from the runs."""
        return replace(
            self,
            nodes=int(runs.sizes.sum()),
            experiences=len(np.unique(runs.experience)),
            components=len(np.unique(runs.component)),
            largest_component=runs.largest,
        )


@dataclass(frozen=True, slots=True)
class Own:
    """The rows of a revision.

    Attributes:
        key: of the revision.
        ranges: first and last key of its rows by table, of tables of which it has rows.
    """

    key: int
    ranges: Mapping[str, tuple[int, int]]

    def rows(self, table: Table) -> ColumnElement[bool]:
        """The condition that a row is one of them."""
        first, last = self.ranges.get(table.name, (0, -1))
        key = table.primary_key.columns[0]
        return key.between(first, last) & (table.c.revision == self.key)

    def erased(self, table: Table) -> ColumnElement[bool]:
        """The condition that a receipt is of one of them."""
        first, last = self.ranges.get(table.name, (0, -1))
        of_table = (receipts.c.record == table.name) & receipts.c.target.between(first, last)
        return of_table & (receipts.c.revision == self.key)


def own_rows(row: Row) -> Own:
    """The rows of a revision, given by its row.

    Raises:
        MapCorruptError: its ranges are malformed.
    """
    try:
        ranges = msgspec.json.decode(row["ranges"], type=dict[str, tuple[_Key, _Key]])
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise MapCorruptError(f"revision row {row['key']}: malformed ranges: {error}") from error
    return Own(row["key"], ranges)


def totals_at(connection: Connection, number: int) -> Totals:
    """The stored totals as of a committed revision; 0 for the map before the first."""
    if not number:
        return Totals()
    query = select(revisions).where(revisions.c.number == number)
    row = next(verified(revisions, connection.execute(query)))
    return Totals.from_json(row["totals"], f"revision {number}")


def state_at_head(connection: Connection, head: int) -> tuple[Totals, Runs | None]:
    """The totals and runs as of the newest revision; None for runs that do not fit."""
    totals, runs = totals_at(connection, head), load_runs(connection)
    fits = runs is not None and int(runs.sizes.sum()) == totals.nodes
    return totals, runs if fits else None


def count_all(connection: Connection, view: View) -> tuple[Totals, Runs]:
    """The totals of a view, from all its rows, and its runs."""
    seen = view.select(attempts).with_only_columns(func.sum(attempts.c.count)).order_by(None)
    entries = view.select(path_entries).order_by(None)
    places = entries.with_only_columns(path_entries.c.path, path_entries.c.sequence).distinct()
    found = Totals(
        cameras=_cameras(connection, *(view.select(one) for one in (sessions, nodes))),
        sessions=_count(connection, view.select(sessions)),
        paths=_count(connection, view.select(paths)),
        path_entries=_count(connection, places),
        attempts=int(connection.execute(seen).scalar() or 0),
        right_m=_right_m(connection, view),
    )
    found, runs = _count_graph(connection, view, found)
    return found.with_basin(_basin(connection, view, runs)), runs


def _count_graph(connection: Connection, view: View, before: Totals) -> tuple[Totals, Runs]:
    """The totals with all edges and nodes of a view, and its runs."""
    found = before
    known = [
        (part["key"], part["session"], part["camera"])
        for part in read_in_stretches(connection, view, nodes)
    ]
    owners = Owners(connection, *(np.concatenate(part) for part in zip(*known, strict=True)))
    runs = Runs.of(owners.nodes)
    skipped = np.array(sorted(_uncounted(connection, view)), np.int64)
    for stretch in read_in_stretches(connection, view, edges):
        part = stretch.rows(np.flatnonzero(~np.isin(stretch["key"], skipped)))
        found, runs = with_edges(found, part, owners), runs.joined(*joints(part, owners))
    return found.of_runs(runs), runs


def runs_of(connection: Connection, view: View) -> Runs:
    """The runs of a view, from all its rows."""
    return _count_graph(connection, view, Totals())[1]


def _basin(connection: Connection, view: View, runs: Runs) -> BasinCounts:
    """Counts of all attempts of a view, one session after another."""
    drives = view.select(attempts).with_only_columns(attempts.c.session).distinct().order_by(None)
    counts = BasinCounts.empty()
    for session in connection.execute(drives).scalars().all():
        query = view.select(attempts).where(attempts.c.session == session)
        counts += basin_of(list(verified(attempts, connection.execute(query))), runs)
    return counts


def basin_of(rows: Sequence[Row], runs: Runs) -> BasinCounts:
    """Counts of one session's attempts, of rows of `attempts`, at nodes that are in runs."""
    made = Attempts.joined([unpack(row["body"], row["count"])[1] for row in rows])
    at = runs.find(np.asarray(made.node, np.int64))
    seen = np.flatnonzero(at >= 0)
    made = made.rows(seen)
    return count_attempts(
        np.zeros(len(made), np.int64),
        runs.experience[at[seen]],
        made.iteration,
        (made.along_m.astype(np.float64), made.across_m.astype(np.float64)),
        made.sigma_m.astype(np.float64),
        made.accepted,
    )


def _cameras(connection: Connection, *rows: Select[Any]) -> tuple[CameraId, ...]:
    """Ids of the cameras of rows of sessions or nodes, rising."""
    known = load_cameras(connection)
    keys = set()
    for query in rows:
        camera = query.selected_columns["camera"]
        used = query.with_only_columns(camera).order_by(None).distinct()
        keys |= set(connection.execute(used).scalars())
    if missing := keys - known.keys():
        raise MapCorruptError(f"table cameras: row {min(missing)}, which others use, is missing")
    return tuple(sorted(known[key].id for key in keys))


class Owners:
    """The session and the camera of nodes: of given ones, and of others by a look-up.

    Args:
        connection: of the map.
        nodes: (N,) keys, ascending.
        sessions, cameras: (N,) keys.
    """

    def __init__(self, connection: Connection, nodes: Keys, sessions: Keys, cameras: Keys) -> None:
        self._connection = connection
        self.nodes = nodes
        self._values = np.column_stack([sessions, cameras]).reshape(-1, 2)
        self.cameras = {key: one.id for key, one in load_cameras(connection).items()}

    def of(self, keys: Keys) -> Keys:
        """(K, 2) the session and the camera of each node."""
        wanted = np.unique(keys)
        self._learn(wanted[~np.isin(wanted, self.nodes)])
        return self._values[np.searchsorted(self.nodes, keys)]

    def _learn(self, keys: Keys) -> None:
        """Looks up nodes.

        Raises:
            MapCorruptError: one is missing.
        """
        rows = []
        for part in few(keys.tolist()):
            query = select(nodes).where(nodes.c.key.in_(part))
            found = verified(nodes, self._connection.execute(query.order_by(nodes.c.key)))
            rows += [(row["key"], row["session"], row["camera"]) for row in found]
        if len(rows) != len(keys):
            raise MapCorruptError(f"{len(keys) - len(rows)} nodes of edges are missing")
        if rows:
            known = np.array(rows, np.int64)
            every = np.concatenate([self.nodes, known[:, 0]])
            order = np.argsort(every)
            self.nodes = every[order]
            self._values = np.concatenate([self._values, known[:, 1:]])[order]


def with_edges(before: Totals, added: Columns, owners: Owners, sign: int = 1) -> Totals:
    """The totals with these edges; without them if `sign` is -1."""
    codes, texts = added.texts["kind"]
    by_kind = dict(before.edges)
    for code, count in enumerate(np.bincount(codes, minlength=len(texts)).tolist()):
        by_kind[texts[code]] = by_kind.get(texts[code], 0) + sign * count
    steps = np.flatnonzero(_are_steps(added))
    shifts = sign * added["a_from_b"][steps].view("<f8")[:, 9:]
    cameras = owners.of(added["b"][steps])[:, 1]
    if missing := {*cameras.tolist()} - owners.cameras.keys():
        raise MapCorruptError(f"table cameras: row {min(missing)}, which others use, is missing")
    forward = {key: np.array(value) for key, value in before.forward.items()}
    mapped_m = before.mapped_m
    # One after the other: sums then do not depend on where one commit ends.
    for camera, shift in zip(cameras.tolist(), shifts, strict=True):
        mapped_m += sign * float(np.sqrt(shift @ shift))
        known = forward.setdefault(owners.cameras[camera], np.zeros(3))
        known += shift
    return replace(
        before,
        edges={kind: count for kind, count in by_kind.items() if count},
        mapped_m=mapped_m if by_kind.get(EdgeKind.ODOMETRY) else 0.0,
        forward={key: tuple(value.tolist()) for key, value in forward.items()},
    )


def joints(added: Columns, owners: Owners) -> tuple[Keys, Keys]:
    """Ends (C, 2) of the odometry edges within drives, and (E, 2) of all edges."""
    ends = np.column_stack([added["a"], added["b"]]).reshape(-1, 2)
    steps = ends[_are_steps(added)]
    drives = owners.of(steps.ravel())[:, 0].reshape(-1, 2)
    return steps[drives[:, 0] == drives[:, 1]], ends


def _are_steps(added: Columns) -> NDArray[np.bool_]:
    codes, texts = added.texts["kind"]
    return np.isin(codes, [at for at, text in enumerate(texts) if text == EdgeKind.ODOMETRY])


def read_in_stretches(connection: Connection, view: View, table: Table) -> Iterator[Columns]:
    """The visible rows of a table by key, at most so many at once; one stretch at least."""
    key = table.primary_key.columns[0]
    start: int | None = connection.execute(select(func.min(key))).scalar() or 0
    while start is not None:
        stop = min(start + _AT_ONCE - 1, 2**63 - 1)  # a damaged map may have keys beyond ours
        yield read_columns(connection, view, table, within=(start, stop))
        start = connection.execute(select(func.min(key)).where(key > stop)).scalar()


def _uncounted(connection: Connection, view: View) -> set[int]:
    """Keys of visible edges that do not count: superseded, or removed."""
    named = (edges.c.a, edges.c.b, edges.c.kind)
    doubled = select(*named).group_by(*named).having(func.count() > 1).order_by(*named)
    found = set()
    for a, b, kind in connection.execute(doubled).fetchall():
        same = view.select(edges).where(edges.c.a == a, edges.c.b == b, edges.c.kind == kind)
        found |= {row["key"] for row in list(verified(edges, connection.execute(same)))[:-1]}
    for removal in view.rows(connection, removals):
        between = or_(*(and_(edges.c.a == a, edges.c.b == b) for a, b in _both_ways(removal)))
        rows = list(verified(edges, connection.execute(view.select(edges).where(between))))
        counted = {row["key"] for row in counting(connection, view, rows)}
        found |= {row["key"] for row in rows} - counted
    return found


def _both_ways(row: Row) -> tuple[tuple[int, int], tuple[int, int]]:
    return (row["a"], row["b"]), (row["b"], row["a"])


def changes_steps(connection: Connection, view: View, own: Own) -> bool:
    """Whether an edge of a revision replaces odometry of `view`, or is removed there.

    Another measurement between nodes that have a place, of any other kind, moves none of them.
    """
    older = select(revisions.c.key).where(revisions.c.number <= view.at)
    other = edges.alias()
    same = and_(*(other.c[name] == edges.c[name] for name in ("a", "b", "kind")))
    query = select(other.c.key).select_from(edges.join(other, same))
    replaced = query.where(own.rows(edges), edges.c.kind == str(EdgeKind.ODOMETRY))
    if connection.execute(replaced.where(other.c.revision.in_(older)).limit(1)).first() is not None:
        return True
    removed = select(removals.c.a, removals.c.b).where(removals.c.revision.in_(older))
    ends = [(row.a, row.b) for row in connection.execute(removed.order_by(removals.c.key))]
    for a, b in {*ends, *((b, a) for a, b in ends)}:
        query = select(edges.c.key).where(edges.c.a == a, edges.c.b == b, own.rows(edges)).limit(1)
        if connection.execute(query).first() is not None:
            return True
    return False


def _right_m(connection: Connection, view: View) -> float | None:
    """The largest x of the newest place of each node, metres, from all places."""
    parts = [
        (part["node"], part["revision"], part["key"], part["map_from_node"].view("<f8")[:, 9])
        for part in read_in_stretches(connection, view, placements)
    ]
    node, revision, key, x_m = (np.concatenate(one) for one in zip(*parts, strict=True))
    place_of = places_in_history(connection)
    known, which = np.unique(revision, return_inverse=True)
    place = np.array([place_of[one] for one in known.tolist()], np.int64)[which]
    order = np.lexsort((key, place, node))
    newest = np.flatnonzero(np.diff(node[order], append=-1))
    return greater_m(None, x_m[order][newest])


def greater_m(known: float | None, values: NDArray[np.float64]) -> float | None:
    """The largest of a value and others (N,), metres; None without any."""
    if not len(values):
        return known
    most = float(values.max())
    return most if known is None else max(known, most)


def _count(connection: Connection, rows: Select[Any]) -> int:
    return connection.execute(
        select(func.count()).select_from(rows.order_by(None).subquery())
    ).scalar_one()
