"""Finds the wrong edges of a map: what the rest contradicts, and what nothing confirms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, LandmarkSource
from engram.graph.paths import PathMemory
from engram.monitor import QUIET, Monitor
from engram.repair.config import RepairConfig
from engram.repair.crossings import Crossings
from engram.repair.second_looks import Look, SecondLooks
from engram.repair.surroundings import Surroundings
from engram.repair.suspects import suspect

# Way from the ends of a wrong edge within which edges were predicted through it, metres.
_BESIDE_M = 12.0
# Entries of a path within which a drive crosses an edge: a tie leads from a match to a node saved
# some frames later; both ends of a match were seen at once, and over more entries a drive goes from
# one look-alike to the next without it.
_PAUSES = {EdgeKind.TIE: 8}


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """An edge that is probably wrong, with the evidence.

    Attributes:
        edge: the edge.
        row: its index in the graph's edges.
        why: `contradicted` by the rest of the map, `alone`: nothing confirms it, or `derived`
            from edges that are.
        off_m, off_rad: disagreement with the rest of the map; 0 where nothing else constrains it.
        chi2: the same, squared and normalised.
        sigma_m: the standard deviation that the edge claims, metres.
        confirming, looks: pairs of nodes around it that match as it says, of those tried.
        inliers: of a match of its own ends.
        witnessed: fixes of the best drive that crossed it, on the weaker side.
        surety: how surely it is wrong; 1 and more is certain enough to remove it.
    """

    edge: Edge
    row: int
    why: str
    off_m: float
    off_rad: float
    chi2: float
    sigma_m: float
    confirming: int
    looks: int
    inliers: int
    witnessed: int
    surety: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "a": str(self.edge.a),
            "b": str(self.edge.b),
            "kind": str(self.edge.kind),
            "why": self.why,
            "off_m": round(self.off_m, 2),
            "off_deg": round(float(np.rad2deg(self.off_rad)), 1),
            "sigma_m": round(self.sigma_m, 3),
            "sigmas": round(float(np.sqrt(self.chi2)), 1),
            "confirming": self.confirming,
            "looks": self.looks,
            "inliers": self.inliers,
            "witnessed": self.witnessed,
            "surety": round(self.surety, 2),
        }

    def text(self) -> str:
        """One line for people."""
        ends = f"{self.edge.kind:9} {str(self.edge.a)[:8]} → {str(self.edge.b)[:8]}"
        if self.why == "derived":
            return f"{ends}  follows from wrong edges, {self.off_m:.1f} m off"
        looks = f"{self.confirming} of {self.looks} second looks agree"
        if self.why == "contradicted":
            return (
                f"{ends}  {self.off_m:.1f} m off the rest of the map "
                f"({np.sqrt(self.chi2):.0f} σ); {looks}"
            )
        return f"{ends}  the only link of its kind; {looks}, {self.inliers} inliers"


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """Result of a search.

    Attributes:
        wrong: edges to remove, the surest first.
        doubtful: edges that something speaks against, and too little.
        examined: edges that were looked at once more, of all.
        of_edges: number of edges of the map.
    """

    wrong: tuple[Finding, ...]
    doubtful: tuple[Finding, ...]
    examined: int
    of_edges: int


def find_wrong_edges(
    graph: ExperienceGraph,
    paths: PathMemory,
    frames: LandmarkSource,
    config: RepairConfig | None = None,
    monitor: Monitor = QUIET,
) -> Findings:
    """Finds the edges of a map that join what does not belong together.

    The whole map is adjusted robustly: edges that then lie far off contradict it. Other edges are
    confirmed by a short second path between their ends. What neither contradicts nor confirms, such
    as the only link between two components, is looked at again: nodes around both ends are matched,
    and drives that crossed it are counted.

    Args:
        graph: the graph of the map.
        paths: its path memory.
        frames: the landmarks of its nodes.
        config: settings.
        monitor: receives progress, and may stop the search.
    """
    config = config or RepairConfig()
    crossings = Crossings.of(graph, paths)
    gone: dict[int, Finding] = {}
    while True:
        search = _Search(graph, crossings, frames, config, gone)
        found = search.findings(monitor)
        alone = [one for one in found if one.surety >= 1 and one.why == "alone"]
        if not alone:
            return search.report(found)
        # In a single cycle any edge may be to blame: without the edges that nothing confirms
        # others may no longer be contradicted.
        gone |= {one.row: one for one in alone}


class _Search:
    """One round of the search, without the edges that earlier rounds found wrong."""

    def __init__(
        self,
        graph: ExperienceGraph,
        crossings: Crossings,
        frames: LandmarkSource,
        config: RepairConfig,
        gone: Mapping[int, Finding],
    ) -> None:
        self._graph, self._crossings, self._frames = graph, crossings, frames
        self._config, self._gone = config, gone
        self._suspicion = suspect(graph, config, gone)
        trusted = self._suspicion.measured & ~self._suspicion.contradicted
        trusted[list(gone)] = False
        self._trusted = Surroundings(graph, trusted)

    def findings(self, monitor: Monitor) -> list[Finding]:
        """The suspected edges, judged."""
        suspicion = self._suspicion
        monitor.check()
        odometry = np.array(
            [edge.kind is EdgeKind.ODOMETRY for edge in self._graph.edges], np.bool_
        )
        alone = suspicion.measured & ~suspicion.confirmed & ~suspicion.contradicted & ~odometry
        rows = np.flatnonzero(suspicion.contradicted | alone).tolist()
        looks = SecondLooks(self._graph, self._frames, self._trusted, self._config)
        found = []
        with monitor.stage("second looks", len(rows)) as stage:
            for row in rows:
                if row not in self._gone:
                    found.append(self._finding(row, looks.at(row)))
                stage.advance()
                stage.check()
        return found

    def report(self, found: Sequence[Finding]) -> Findings:
        """Result of the rounds; `found` is of this, the last one."""
        wrong = [*self._gone.values(), *(one for one in found if one.surety >= 1)]
        wrong += self._derived(wrong)
        doubtful = [one for one in found if self._config.doubtful <= one.surety < 1]
        examined = len(self._gone) + len(found)
        return Findings(_ranked(wrong), _ranked(doubtful), examined, len(self._graph.edges))

    def _finding(self, row: int, looks: Sequence[Look]) -> Finding:
        suspicion, edge = self._suspicion, self._graph.edges[row]
        own = next((look for look in looks if look.way_m == 0), None)
        others = [look for look in looks if look.way_m > 0]
        confirming = sum(map(self._confirms, others))
        contradicted = bool(suspicion.contradicted[row])
        witnessed = 0 if contradicted else self._witnessed(row, edge)
        return self._finding_of(
            row,
            "contradicted" if contradicted else "alone",
            self._surety(edge.kind, contradicted, confirming, len(others), witnessed)
            - self._by_own_match(edge, own),
            confirming=confirming,
            looks=len(others),
            inliers=0 if own is None else own.inliers,
            witnessed=witnessed,
        )

    def _surety(
        self, kind: EdgeKind, contradicted: bool, confirming: int, looks: int, witnessed: int
    ) -> float:
        """How surely an edge is wrong, from what speaks for and against it."""
        config = self._config
        if contradicted:
            against = config.contradicted_surety - config.per_look * confirming
            # Where a map is bent, ties and steps of odometry are off that nothing else disproves.
            seen = kind is EdgeKind.MATCH or looks - confirming >= config.least_failing_looks
            return against if seen else min(against, config.most_unseen)
        failing = min(config.per_failing_look * (looks - confirming), config.most_by_looks)
        tied = config.tie_surety * (kind is EdgeKind.TIE)
        for_it = config.per_look * confirming + config.per_fix * min(witnessed, 5) + tied
        return config.alone_surety + failing - for_it

    def _by_own_match(self, edge: Edge, own: Look | None) -> float:
        """Surety that an edge loses whose two frames match as it says, better than look-alikes."""
        config = self._config
        odometry = edge.kind is EdgeKind.ODOMETRY
        needed = config.odometry_inliers if odometry else config.match_inliers
        strong = own is not None and own.inliers >= needed and self._confirms(own)
        return config.contradicted_surety * strong

    def _confirms(self, look: Look) -> bool:
        config = self._config
        return (
            look.inliers >= config.agree_inliers
            and look.off_m <= config.agree_m
            and look.off_rad <= config.agree_rad
        )

    def _witnessed(self, row: int, edge: Edge) -> int:
        reach_m, index = self._config.look_within_m, self._graph.index
        sides = [
            [near.node for near in self._trusted.around(index(end), reach_m, without=row)]
            for end in (edge.a, edge.b)
        ]
        pause = _PAUSES.get(edge.kind, 1)
        return self._crossings.witnessed(sides[0], sides[1], len(self._graph), pause)

    def _derived(self, wrong: Sequence[Finding]) -> list[Finding]:
        """Predicted edges near wrong ones that assert the same."""
        graph, config = self._graph, self._config
        found: dict[int, Finding] = {}
        for one in wrong:
            sides = [
                {near.node: near.root_from_node for near in self._trusted.around(end, _BESIDE_M)}
                for end in map(graph.index, (one.edge.a, one.edge.b))
            ]
            for node, a_from_node in sides[0].items():
                for edge, row in graph.numbered_edges_of(node):
                    ahead = graph.index(edge.a) == node
                    other = graph.index(edge.b if ahead else edge.a)
                    if edge.kind is not EdgeKind.PROXIMITY or other not in sides[1]:
                        continue
                    said = a_from_node.inverse() @ one.edge.a_from_b @ sides[1][other]
                    measured = edge.a_from_b if ahead else edge.a_from_b.inverse()
                    apart_m = (measured.inverse() @ said).distance_m
                    off_m = float(self._suspicion.off_m[row])
                    if apart_m <= config.gross_m < off_m:
                        found[row] = self._finding_of(row, "derived", surety=1.0)
        return list(found.values())

    def _finding_of(self, row: int, why: str, surety: float, **evidence: int) -> Finding:
        suspicion, edge = self._suspicion, self._graph.edges[row]
        counts = dict.fromkeys(("confirming", "looks", "inliers", "witnessed"), 0) | evidence
        return Finding(
            edge=edge,
            row=row,
            why=why,
            off_m=float(suspicion.off_m[row]),
            off_rad=float(suspicion.off_rad[row]),
            chi2=float(suspicion.chi2[row]),
            sigma_m=float(np.sqrt(np.linalg.eigvalsh(edge.covariance[:3, :3])[-1])),
            surety=surety,
            **counts,
        )


def _ranked(found: Sequence[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(found, key=lambda one: (-one.surety, -one.off_m, one.row)))
