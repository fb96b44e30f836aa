"""Differences between two revisions of a map: nodes, sessions, metres, conditions, by region.

A map has no global frame: its regions are components, and stretches of their oldest sessions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from engram.counts import counted
from engram.errors import InputError
from engram.graph.clock import hour_of_day
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, Session, SessionId
from engram.maps.records import MapContents

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

STRETCH_M = 50.0
# Shortest stretch, metres: shorter ones are below the spacing of nodes, and overflow int32.
_LEAST_STRETCH_M = 1.0
# Least length of an edge, metres, so that nodes at one place are still a step apart.
_LEAST_STEP_M = 1e-3


UNKNOWN_HOUR = "unknown"
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """The region of each node of a graph.

    A stretch is `stretch_m` metres of a component's oldest session. A node belongs to the stretch
    of that session's nearest node along the edges.

    Attributes:
        component: (N,) int32, numbered from 0 by first node.
        stretch: (N,) int32, `from_m` in units of the stretch's length.
        oldest: the oldest session of each component.
        stretch_m: length of a stretch, metres.
    """

    component: NDArray[np.int32]
    stretch: NDArray[np.int32]
    oldest: tuple[SessionId, ...]
    stretch_m: float


def regions_of(
    graph: ExperienceGraph, sessions: dict[SessionId, Session], stretch_m: float = STRETCH_M
) -> Regions:
    """Divides a map into components and stretches.

    Args:
        graph: the map's.
        sessions: those of its nodes.
        stretch_m: length of a stretch, metres.

    Raises:
        InputError: the length is below 1 m, or not finite.
    """
    from scipy.sparse.csgraph import dijkstra

    if not (np.isfinite(stretch_m) and stretch_m >= _LEAST_STRETCH_M):
        raise InputError(
            f"a stretch is {stretch_m} m long, must be finite and >= {_LEAST_STRETCH_M:g} m"
        )
    component = graph.components()
    stretch = np.zeros(len(graph), np.int32)
    oldest = []
    links = edge_lengths(graph)
    for number in range(int(component.max(initial=-1)) + 1):
        nodes = np.flatnonzero(component == number)
        held = {graph.session(int(at)) for at in np.unique(graph.sessions[nodes])}
        first = min(held, key=lambda one: (sessions[one].start_ns, one.int))
        oldest.append(first)
        own = nodes[graph.sessions[nodes] == graph.session_number(first)]
        _, _, nearest = dijkstra(
            links, directed=False, indices=own, min_only=True, return_predecessors=True
        )
        stretch[nodes] = np.floor(graph.driven_m[nearest[nodes]] / stretch_m).astype(np.int32)
    return Regions(component, stretch, tuple(oldest), stretch_m)


def edge_lengths(graph: ExperienceGraph) -> csr_matrix:
    """(N, N) sparse: length of the shortest edge between two nodes, metres, once for each pair."""
    links = graph.lightest(lambda edge: max(edge.a_from_b.distance_m, _LEAST_STEP_M))
    return links.matrix(len(graph))


@dataclass(frozen=True, slots=True, eq=False)
class MapDifference:
    """The comparison of two revisions of one map.

    Attributes:
        before, after: numbers of the revisions.
        old, new: their records.
        graph: all nodes of both, joined by the edges of both.
        regions: of that graph.
    """

    before: int
    after: int
    old: MapContents
    new: MapContents
    graph: ExperienceGraph
    regions: Regions

    def to_dict(self) -> dict[str, Any]:
        """What ``diff --json`` prints."""
        old, new = self.old, self.new
        nodes = _both(old.nodes, new.nodes, lambda one: one.id)
        edges = _both(old.edges, new.edges, lambda one: (one.a, one.b, one.kind))
        entries = _both(old.path_entries, new.path_entries, lambda one: (one.path, one.sequence))
        added = [node for key, node in nodes[1].items() if key not in nodes[0]]
        removed = [node for key, node in nodes[0].items() if key not in nodes[1]]
        return {
            "before": self.before,
            "after": self.after,
            "nodes": _counts(*nodes),
            "sessions": {
                "added": _sessions_of_one_side(new, old, added),
                "removed": _sessions_of_one_side(old, new, removed),
            },
            "edges": _edge_counts(*edges),
            "mapped_m": {"before": _metres(old), "after": _metres(new)},
            "path_entries": _counts(*entries),
            "attempts": {"before": len(old.attempts), "after": len(new.attempts)},
            "components": {"before": _components(old), "after": _components(new)},
            # A map holds no weather, only the clocks of its sessions.
            "hours": {"before": hours_of_nodes(old), "after": hours_of_nodes(new)},
            "regions": self._regions(added, removed),
        }

    def _regions(self, added: list[Node], removed: list[Node]) -> list[dict[str, Any]]:
        """Each stretch in which something changed."""
        changes: dict[tuple[int, int], dict[str, Any]] = {}
        kept_in = Counter(self._region(node) for node in self.old.nodes)
        sessions = {one.id: one for one in (*self.old.sessions, *self.new.sessions)}
        for kind, nodes in (("added", added), ("removed", removed)):
            for node in nodes:
                entry = changes.setdefault(
                    self._region(node), {"added": 0, "removed": 0, "hours": Counter()}
                )
                entry[kind] += 1
                if kind == "added":
                    entry["hours"][_hour(sessions[node.session], node.stamp_ns)] += 1
        return [
            {
                "component": component,
                "oldest_session": str(self.regions.oldest[component]),
                "from_m": stretch * self.regions.stretch_m,
                "to_m": (stretch + 1) * self.regions.stretch_m,
                "nodes_before": kept_in[component, stretch],
                "added": entry["added"],
                "removed": entry["removed"],
                "hours_added": dict(sorted(entry["hours"].items())),
            }
            for (component, stretch), entry in sorted(changes.items())
        ]

    def _region(self, node: Node) -> tuple[int, int]:
        at = self.graph.index(node.id)
        return int(self.regions.component[at]), int(self.regions.stretch[at])

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
        lines += [_region_text(one) for one in told["regions"]]
        return "\n".join(lines)


def difference(
    before: int, old: MapContents, after: int, new: MapContents, stretch_m: float = STRETCH_M
) -> MapDifference:
    """Compares two revisions."""
    graph = _joined(old, new)
    sessions = {one.id: one for one in (*old.sessions, *new.sessions)}
    return MapDifference(before, after, old, new, graph, regions_of(graph, sessions, stretch_m))


def hours_of_nodes(contents: MapContents) -> dict[str, int]:
    """Number of nodes by hour of day; "unknown" without a UTC clock and a place."""
    sessions = {one.id: one for one in contents.sessions}
    hours = Counter(_hour(sessions[node.session], node.stamp_ns) for node in contents.nodes)
    return dict(sorted(hours.items()))


def _both(
    old: Iterable[_T], new: Iterable[_T], key: Callable[[_T], Any]
) -> tuple[dict[Any, _T], dict[Any, _T]]:
    return {key(one): one for one in old}, {key(one): one for one in new}


def _counts(old: dict[Any, Any], new: dict[Any, Any]) -> dict[str, int]:
    return {
        "before": len(old),
        "after": len(new),
        "added": len(new.keys() - old.keys()),
        "removed": len(old.keys() - new.keys()),
    }


def _edge_counts(old: dict[Any, Edge], new: dict[Any, Edge]) -> dict[str, dict[str, int]]:
    """Edges by kind, and the number measured again."""
    found = {}
    for kind in EdgeKind:
        was = {key: edge for key, edge in old.items() if edge.kind is kind}
        now = {key: edge for key, edge in new.items() if edge.kind is kind}
        if was or now:
            changed = sum(not _same(was[key], now[key]) for key in was.keys() & now.keys())
            found[str(kind)] = {**_counts(was, now), "changed": changed}
    return found


def _same(one: Edge, other: Edge) -> bool:
    return np.array_equal(one.a_from_b.matrix(), other.a_from_b.matrix()) and np.array_equal(
        one.covariance, other.covariance
    )


def _sessions_of_one_side(
    here: MapContents, there: MapContents, changed: Iterable[Node]
) -> list[dict[str, Any]]:
    """The sessions of only one side."""
    nodes = Counter(node.session for node in changed)
    known = {session.id for session in there.sessions}
    return [
        {
            "session": str(session.id),
            "robot": session.robot,
            "start_ns": session.start_ns,
            "clock": str(session.clock),
            "hour": hour_of_day(session, session.start_ns),
            "nodes": nodes[session.id],
        }
        for session in here.sessions
        if session.id not in known
    ]


def _metres(contents: MapContents) -> float:
    return sum(
        edge.a_from_b.distance_m for edge in contents.edges if edge.kind is EdgeKind.ODOMETRY
    )


def _components(contents: MapContents) -> int:
    return int(_joined(contents).components().max(initial=-1)) + 1


def _joined(*contents: MapContents) -> ExperienceGraph:
    """All nodes, joined by all edges."""
    graph = ExperienceGraph()
    for one in contents:
        for node in one.nodes:
            graph.add_node(node)
    for one in contents:
        graph.add_edges(one.edges)
    return graph


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
        f"{name}{'' if name == UNKNOWN_HOUR else ' h'} {hours['before'].get(name, 0)} → "
        f"{hours['after'].get(name, 0)}"
        for name in sorted({*hours["before"], *hours["after"]})
    ]
    return (", ".join(told) or "no nodes") + " (maps hold no weather)"


def _region_text(one: dict[str, Any]) -> str:
    hours = ", ".join(f"{name}: {count}" for name, count in one["hours_added"].items())
    return (
        f"  component {one['component']}, {one['from_m']:.0f}-{one['to_m']:.0f} m of session "
        f"{one['oldest_session'][:8]}: {counted(one['nodes_before'], 'node')}, +{one['added']} "
        f"-{one['removed']}" + (f" (by hour {hours})" if hours else "")
    )
