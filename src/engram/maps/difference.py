"""Differences between two revisions of a map: nodes, sessions, metres, hours of day, by region.

Only what differs is read: the rows of the revisions between. A map has no global frame, so regions
are stretches of sessions: of the oldest one among the nodes that changed and their neighbours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from engram.counts import counted
from engram.errors import InputError
from engram.graph.clock import hour_of_day
from engram.graph.graph import labels_of
from engram.graph.model import EdgeKind, NodeId, Session
from engram.maps.changes import Changes, Touched, columns_of, rows_by
from engram.maps.columns import Columns
from engram.maps.reading import load_cameras, sessions_by_key
from engram.maps.rows import node_from_bytes
from engram.maps.runs import Keys
from engram.maps.schema import edges, nodes, path_entries, sessions
from engram.maps.totals import Totals, totals_at
from engram.maps.view import View

STRETCH_M = 50.0
# Shortest stretch, metres: shorter ones are below the spacing of nodes, and overflow int32.
_LEAST_STRETCH_M = 1.0
# Least length of an edge, metres, so that nodes at one place are still a step apart.
_LEAST_STEP_M = 1e-3


UNKNOWN_HOUR = "unknown"


@dataclass(frozen=True, slots=True)
class Region:
    """A stretch of a session along which nodes were added or removed.

    Attributes:
        part: connected part of the nodes that changed and their neighbours, numbered from 0.
        oldest: the oldest session of that part.
        from_m, to_m: the stretch, metres from the start of that session.
        added, removed: number of nodes.
        hours_added: number of added nodes by hour of day.
    """

    part: int
    oldest: Session
    from_m: float
    to_m: float
    added: int
    removed: int
    hours_added: Mapping[str, int]

    def to_dict(self) -> dict[str, Any]:
        """What ``diff --json`` prints."""
        return {
            "part": self.part,
            "oldest_session": str(self.oldest.id),
            "from_m": self.from_m,
            "to_m": self.to_m,
            "added": self.added,
            "removed": self.removed,
            "hours_added": dict(self.hours_added),
        }

    def text(self) -> str:
        """The region in one line."""
        hours = ", ".join(f"{name}: {count}" for name, count in self.hours_added.items())
        return (
            f"  part {self.part}, {self.from_m:.0f}-{self.to_m:.0f} m of session "
            f"{str(self.oldest.id)[:8]}: +{self.added} -{self.removed}"
            + (f" (by hour {hours})" if hours else "")
        )


@dataclass(frozen=True, slots=True, eq=False)
class MapDifference:
    """The comparison of two revisions of one map.

    Attributes:
        before, after: numbers of the revisions.
        old, new: their totals.
        changes: the rows that differ.
        sessions: those of the nodes and rows that differ, by key.
        regions: where nodes were added or removed.
    """

    before: int
    after: int
    old: Totals
    new: Totals
    changes: Changes
    sessions: Mapping[int, Session]
    regions: Sequence[Region]

    @property
    def added(self) -> set[NodeId]:
        """The nodes that are in the second revision only."""
        return _ids(self.changes[nodes].gained)

    @property
    def removed(self) -> set[NodeId]:
        """The nodes that are in the first revision only."""
        return _ids(self.changes[nodes].lost)

    def to_dict(self) -> dict[str, Any]:
        """What ``diff --json`` prints."""
        old, new = self.old, self.new
        added, removed = self.changes[nodes].gained, self.changes[nodes].lost
        entries = _by_key(self.changes[path_entries], ("path", "sequence"))
        return {
            "before": self.before,
            "after": self.after,
            "nodes": _counts(old.nodes, new.nodes, len(added), len(removed)),
            "sessions": {
                "added": self._sessions(self.changes[sessions].gained, added),
                "removed": self._sessions(self.changes[sessions].lost, removed),
            },
            "edges": self._edges(),
            "mapped_m": {"before": old.mapped_m, "after": new.mapped_m},
            "path_entries": _counts(
                old.path_entries,
                new.path_entries,
                len(entries[1].keys() - entries[0].keys()),
                len(entries[0].keys() - entries[1].keys()),
            ),
            "attempts": {"before": old.attempts, "after": new.attempts},
            "components": {"before": old.components, "after": new.components},
            # A map holds no weather, only the clocks of its sessions.
            "hours": {
                "added": _hours(added, self.sessions),
                "removed": _hours(removed, self.sessions),
            },
            "regions": [one.to_dict() for one in self.regions],
        }

    def _edges(self) -> dict[str, dict[str, int]]:
        """Edges by kind, and the number measured again."""
        was, now = _by_key(self.changes[edges], ("a", "b", "kind"))
        measured = self.changes[edges].rows
        found = {}
        for kind in filter(lambda one: one in {**self.old.edges, **self.new.edges}, EdgeKind):
            lost, gained = ({key for key in one if key[2] == kind} for one in (was, now))
            changed = (
                any(
                    not np.array_equal(measured[name][was[key]], measured[name][now[key]])
                    for name in ("a_from_b", "covariance")
                )
                for key in lost & gained
            )
            found[str(kind)] = {
                **_counts(
                    self.old.edges.get(kind, 0),
                    self.new.edges.get(kind, 0),
                    len(gained - lost),
                    len(lost - gained),
                ),
                "changed": sum(changed),
            }
        return found

    def _sessions(self, here: Columns, changed: Columns) -> list[dict[str, Any]]:
        """The sessions of only one side."""
        saved = Counter(changed["session"].tolist())
        return [
            {
                "session": str(session.id),
                "robot": session.robot,
                "start_ns": session.start_ns,
                "clock": str(session.clock),
                "hour": hour_of_day(session, session.start_ns),
                "nodes": saved[key],
            }
            for key in here["key"].tolist()
            for session in [self.sessions[key]]
        ]

    def text(self) -> str:
        """The comparison as text."""
        told = self.to_dict()
        lines = [
            f"revision {self.before} → {self.after}",
            f"nodes          {_plus_minus(told['nodes'])}",
            f"path entries   {_plus_minus(told['path_entries'])}",
        ]
        lines.append(f"{'edges':14s} {_edges_text(told['edges'])}")
        for name, unit in (("mapped_m", " m"), ("attempts", ""), ("components", "")):
            before, after = told[name]["before"], told[name]["after"]
            label = name.removesuffix("_m").replace("_", " ")
            lines.append(f"{label:14s} {before:.0f}{unit} → {after:.0f}{unit}")
        for kind, sign in (("added", "+"), ("removed", "-")):
            lines += [f"{sign} session {_session_text(one)}" for one in told["sessions"][kind]]
        lines.append("hour of day    " + _hours_text(told["hours"]))
        lines += [one.text() for one in self.regions]
        return "\n".join(lines)


def difference(
    connection: Connection, before: int, after: int, stretch_m: float = STRETCH_M
) -> MapDifference:
    """Compares two revisions.

    Args:
        connection: of the map.
        before, after: their numbers.
        stretch_m: length of the stretches by which changes are listed, metres.

    Raises:
        InputError: the length is below 1 m, or not finite.
        MapCorruptError: a row does not match its checksum.
    """
    if not (np.isfinite(stretch_m) and stretch_m >= _LEAST_STRETCH_M):
        raise InputError(
            f"a stretch is {stretch_m} m long, must be finite and >= {_LEAST_STRETCH_M:g} m"
        )
    views = View(before), View(after)
    changes = Changes.between(connection, *views)
    beside = _Beside.of(connection, changes)
    keys = {*beside.nodes["session"].tolist(), *changes[sessions].rows["key"].tolist()}
    cameras = load_cameras(connection)
    drives = {
        key: one
        for view in views
        for key, one in sessions_by_key(connection, view, cameras, keys).items()
    }
    return MapDifference(
        before,
        after,
        totals_at(connection, before),
        totals_at(connection, after),
        changes,
        drives,
        beside.regions(changes, drives, stretch_m),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Beside:
    """The nodes that changed, their neighbours, and the edges between.

    Attributes:
        nodes: rows, by key.
        ends: (E, 2) indices into `nodes`.
        lengths_m: (E,) metres.
    """

    nodes: Columns
    ends: NDArray[np.intp]
    lengths_m: NDArray[np.float64]

    @staticmethod
    def of(connection: Connection, changes: Changes) -> _Beside:
        changed = np.concatenate([changes[nodes].gained["key"], changes[nodes].lost["key"]])
        either = changes[edges].counts.any(axis=0)
        joined = changes[edges].rows.rows(np.flatnonzero(either))
        ends = np.column_stack([joined["a"], joined["b"]]).reshape(-1, 2)
        at = np.isin(ends, changed).any(axis=1)
        shift = joined["a_from_b"].view("<f8")[at, 9:]
        rows = rows_by(connection, nodes, "key", np.union1d(changed, ends[at]).tolist())
        found = columns_of(nodes, (rows[key] for key in sorted(rows)))
        lengths_m = np.maximum(np.linalg.norm(shift, axis=1), _LEAST_STEP_M)
        return _Beside(found, np.searchsorted(found["key"], ends[at]), lengths_m)

    def regions(
        self, changes: Changes, drives: Mapping[int, Session], stretch_m: float
    ) -> list[Region]:
        """Each stretch in which something changed."""
        part, oldest, along_m = self._along(drives)
        stretch = np.floor(along_m / stretch_m).astype(np.int32)
        at = {
            kind: np.searchsorted(self.nodes["key"], rows["key"])
            for kind, rows in (("+", changes[nodes].gained), ("-", changes[nodes].lost))
        }
        counts = {
            kind: Counter(zip(part[one].tolist(), stretch[one].tolist(), strict=True))
            for kind, one in at.items()
        }
        found = []
        for number, step in sorted({*counts["+"], *counts["-"]}):
            here = at["+"][(part[at["+"]] == number) & (stretch[at["+"]] == step)]
            found.append(
                Region(
                    number,
                    drives[oldest[number]],
                    step * stretch_m,
                    (step + 1) * stretch_m,
                    counts["+"][number, step],
                    counts["-"][number, step],
                    _hours(self.nodes.rows(here), drives),
                )
            )
        return found

    def _along(
        self, drives: Mapping[int, Session]
    ) -> tuple[NDArray[np.int64], list[int], NDArray[np.float64]]:
        """Part of each node, the oldest session of each part, and the metre of it of each node."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import dijkstra

        count = len(self.nodes)
        part = labels_of(self.ends, count)
        # The shortest of the edges between two nodes.
        order = np.argsort(self.lengths_m)
        pairs, first = np.unique(np.sort(self.ends[order], axis=1), axis=0, return_index=True)
        links = coo_matrix((self.lengths_m[order][first], pairs.T), (count, count)).tocsr()
        along_m, oldest = np.zeros(count), []
        for members in _members(part):
            held = np.unique(self.nodes["session"][members]).tolist()
            oldest.append(min(held, key=lambda key: (drives[key].start_ns, drives[key].id.int)))
            own = members[self.nodes["session"][members] == oldest[-1]]
            _, _, nearest = dijkstra(
                links, directed=False, indices=own, min_only=True, return_predecessors=True
            )
            along_m[members] = self.nodes["driven_m"][nearest[members]]
        return part, oldest, along_m


def _members(labels: Keys) -> list[NDArray[np.intp]]:
    """The indices with each label, by label."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(order) else []


def _ids(found: Columns) -> set[NodeId]:
    return {node_from_bytes(one.tobytes()) for one in found["uuid"]}


def _by_key(
    touched: Touched, names: Sequence[str]
) -> tuple[dict[tuple[Any, ...], int], dict[tuple[Any, ...], int]]:
    """The index of each row that counts on one side only, by these columns, for both sides."""
    only = touched.counts[0] != touched.counts[1]
    found = []
    for side in touched.counts:
        rows = np.flatnonzero(side & only)
        keys = zip(*(_plain(touched.rows, name, rows) for name in names), strict=True)
        found.append(dict(zip(keys, rows.tolist(), strict=True)))
    return found[0], found[1]


def _plain(found: Columns, name: str, rows: NDArray[np.intp]) -> list[Any]:
    if name not in found.texts:
        return list(found[name][rows].tolist())
    codes, texts = found.texts[name]
    return [texts[code] for code in codes[rows].tolist()]


def _counts(before: int, after: int, added: int, removed: int) -> dict[str, int]:
    return {"before": before, "after": after, "added": added, "removed": removed}


def _hours(found: Columns, drives: Mapping[int, Session]) -> dict[str, int]:
    """Number of nodes by hour of day; "unknown" without a UTC clock and a place."""
    stamps = zip(found["session"].tolist(), found["stamp_ns"].tolist(), strict=True)
    return dict(sorted(Counter(_hour(drives[key], stamp_ns) for key, stamp_ns in stamps).items()))


def _hour(session: Session, stamp_ns: int) -> str:
    hour = hour_of_day(session, stamp_ns)
    return UNKNOWN_HOUR if hour is None else f"{int(hour):02d}"


def _plus_minus(counts: dict[str, int]) -> str:
    return f"{counts['before']} → {counts['after']} (+{counts['added']} -{counts['removed']})"


def _edges_text(kinds: dict[str, dict[str, int]]) -> str:
    return (
        "; ".join(
            f"{kind} {_plus_minus(counts)}"
            + (f", {counts['changed']} measured again" if counts["changed"] else "")
            for kind, counts in kinds.items()
        )
        or "none"
    )


def _session_text(one: dict[str, Any]) -> str:
    hour = "hour unknown" if one["hour"] is None else f"{one['hour']:.1f} h"
    return f"{one['session']} of {one['robot']}, {hour}, {counted(one['nodes'], 'node')}"


def _hours_text(hours: dict[str, dict[str, int]]) -> str:
    told = [
        f"{name}{'' if name == UNKNOWN_HOUR else ' h'} +{hours['added'].get(name, 0)} "
        f"-{hours['removed'].get(name, 0)}"
        for name in sorted({*hours["added"], *hours["removed"]})
    ]
    return (", ".join(told) or "no nodes") + " (maps hold no weather)"
