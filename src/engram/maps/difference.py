"""What differs between two revisions of a map: nodes, sessions, metres, conditions, by region."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from engram.graph.clock import hour_of_day
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, NodeId, Session, SessionId
from engram.maps.records import MapContents
from engram.maps.regions import STRETCH_M, Regions, regions_of

UNKNOWN_HOUR = "unknown"


@dataclass(frozen=True, slots=True, eq=False)
class MapDifference:
    """Two revisions of one map, beside each other.

    Attributes:
        before, after: numbers of the revisions.
        old, new: what they hold.
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
        old, new = _keyed(self.old), _keyed(self.new)
        added = [node for node in self.new.nodes if node.id not in old.nodes]
        removed = [node for node in self.old.nodes if node.id not in new.nodes]
        return {
            "before": self.before,
            "after": self.after,
            "nodes": _counts(old.nodes, new.nodes),
            "sessions": {
                "added": _told(new.sessions, old.sessions, added, self.new),
                "removed": _told(old.sessions, new.sessions, removed, self.old),
            },
            "edges": _edge_counts(old.edges, new.edges),
            "mapped_m": {"before": _metres(self.old), "after": _metres(self.new)},
            "path_entries": _counts(old.entries, new.entries),
            "attempts": {"before": len(self.old.attempts), "after": len(self.new.attempts)},
            "components": {"before": _components(self.old), "after": _components(self.new)},
            # A map knows no weather: only what the clocks of its sessions say.
            "hours": {"before": hours_of_nodes(self.old), "after": hours_of_nodes(self.new)},
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
                "hours_added": _sorted_hours(entry["hours"]),
            }
            for (component, stretch), entry in sorted(changes.items())
        ]

    def _region(self, node: Node) -> tuple[int, int]:
        at = self.graph.index(node.id)
        return int(self.regions.component[at]), int(self.regions.stretch[at])

    def text(self) -> str:
        """For people."""
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
    """Compare what two revisions hold."""
    graph = ExperienceGraph()
    for contents in (old, new):
        for node in contents.nodes:
            graph.add_node(node)
    for contents in (old, new):
        graph.add_edges(contents.edges)
    sessions = {one.id: one for one in (*old.sessions, *new.sessions)}
    return MapDifference(before, after, old, new, graph, regions_of(graph, sessions, stretch_m))


def hours_of_nodes(contents: MapContents) -> dict[str, int]:
    """How many nodes were saved in each hour of day; "unknown" where no clock tells."""
    sessions = {one.id: one for one in contents.sessions}
    hours = Counter(_hour(sessions[node.session], node.stamp_ns) for node in contents.nodes)
    return _sorted_hours(hours)


@dataclass(frozen=True, slots=True)
class _Keyed:
    nodes: dict[NodeId, Node]
    sessions: dict[SessionId, Session]
    edges: dict[tuple[NodeId, NodeId, EdgeKind], Edge]
    entries: dict[tuple[Any, int], NodeId]


def _keyed(contents: MapContents) -> _Keyed:
    return _Keyed(
        {node.id: node for node in contents.nodes},
        {session.id: session for session in contents.sessions},
        {(edge.a, edge.b, edge.kind): edge for edge in contents.edges},
        {(entry.path, entry.sequence): entry.node for entry in contents.path_entries},
    )


def _counts(old: dict[Any, Any], new: dict[Any, Any]) -> dict[str, int]:
    return {
        "before": len(old),
        "after": len(new),
        "added": len(new.keys() - old.keys()),
        "removed": len(old.keys() - new.keys()),
    }


def _edge_counts(old: dict[Any, Edge], new: dict[Any, Edge]) -> dict[str, dict[str, int]]:
    """By kind, and how many were measured anew."""
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


def _told(
    there: dict[SessionId, Session],
    known: dict[SessionId, Session],
    changed: Iterable[Node],
    contents: MapContents,
) -> list[dict[str, Any]]:
    """The sessions that only one side has."""
    nodes = Counter(node.session for node in changed)
    return [
        {
            "session": str(session.id),
            "robot": session.robot,
            "start_ns": session.start_ns,
            "clock": str(session.clock),
            "hour": hour_of_day(session, session.start_ns),
            "nodes": nodes[session.id],
        }
        for session in contents.sessions
        if session.id not in known and session.id in there
    ]


def _metres(contents: MapContents) -> float:
    return sum(
        edge.a_from_b.distance_m for edge in contents.edges if edge.kind is EdgeKind.ODOMETRY
    )


def _components(contents: MapContents) -> int:
    graph = ExperienceGraph()
    for node in contents.nodes:
        graph.add_node(node)
    graph.add_edges(contents.edges)
    return int(graph.components().max(initial=-1)) + 1


def _hour(session: Session, stamp_ns: int) -> str:
    hour = hour_of_day(session, stamp_ns)
    return UNKNOWN_HOUR if hour is None else f"{int(hour):02d}"


def _sorted_hours(hours: Counter[str]) -> dict[str, int]:
    return dict(sorted(hours.items()))


def _plus_minus(counts: dict[str, int]) -> str:
    return f"{counts['before']} → {counts['after']} (+{counts['added']} -{counts['removed']})"


def _edges_text(kinds: dict[str, dict[str, int]]) -> str:
    return (
        "; ".join(
            f"{kind} {_plus_minus(counts)}"
            + (f", {counts['changed']} measured anew" if counts["changed"] else "")
            for kind, counts in kinds.items()
        )
        or "none"
    )


def _session_text(one: dict[str, Any]) -> str:
    hour = "hour unknown" if one["hour"] is None else f"{one['hour']:.1f} h"
    return f"{one['session']} of {one['robot']}, {hour}, {one['nodes']} nodes"


def _hours_text(hours: dict[str, dict[str, int]]) -> str:
    told = [
        f"{name}{'' if name == UNKNOWN_HOUR else ' h'} {hours['before'].get(name, 0)} → "
        f"{hours['after'].get(name, 0)}"
        for name in sorted({*hours["before"], *hours["after"]})
    ]
    return (", ".join(told) or "no nodes") + " (weather is not known to a map)"


def _region_text(one: dict[str, Any]) -> str:
    hours = ", ".join(f"{name}: {count}" for name, count in one["hours_added"].items())
    return (
        f"  component {one['component']}, {one['from_m']:.0f}-{one['to_m']:.0f} m of session "
        f"{one['oldest_session'][:8]}: {one['nodes_before']} nodes, +{one['added']} "
        f"-{one['removed']}" + (f" (by hour {hours})" if hours else "")
    )
