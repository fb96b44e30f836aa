"""Finds the wrong edges of a map: what the rest contradicts, and what nothing confirms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from engram.frontend.matching import MatcherConfig
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, LandmarkSource
from engram.graph.paths import PathMemory
from engram.monitor import QUIET, Monitor
from engram.repair.config import RepairConfig
from engram.repair.crossings import Crossings
from engram.repair.second_looks import Look, SecondLooks
from engram.repair.surroundings import Surroundings
from engram.repair.suspects import Suspicion, part_labels, suspect


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """An edge that is probably wrong, with the evidence.

    Attributes:
        edge: the edge.
        row: its index in the graph's edges.
        why: `contradicted` by the rest of the map, `alone`: nothing confirms it, or `derived`
            from edges that are.
        off_m, off_rad: disagreement with the rest of the map; 0 where nothing else tells.
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
    """What a search came to.

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
    matcher: MatcherConfig | None = None,
    monitor: Monitor = QUIET,
) -> Findings:
    """Finds the edges of a map that join what does not belong together.

    The whole map is adjusted robustly: edges that then lie far off contradict it. Other edges are
    confirmed by a short second way between their ends. What neither contradicts nor confirms, such
    as the only link between two components, is looked at again: nodes around both ends are matched,
    and drives that crossed it are counted.

    Args:
        graph: the graph of the map.
        paths: its path memory.
        frames: the landmarks of its nodes.
        config: settings.
        matcher: settings of the matcher; None for the defaults.
        monitor: receives progress, and may stop the search.
    """
    search = _Search(graph, paths, frames, config or RepairConfig(), matcher or MatcherConfig())
    return search.findings(monitor)


class _Search:
    def __init__(
        self,
        graph: ExperienceGraph,
        paths: PathMemory,
        frames: LandmarkSource,
        config: RepairConfig,
        matcher: MatcherConfig,
    ) -> None:
        self._graph, self._paths, self._frames = graph, paths, frames
        self._config, self._matcher = config, matcher

    @cached_property
    def _suspicion(self) -> Suspicion:
        return suspect(self._graph, self._config)

    @cached_property
    def _trusted(self) -> Surroundings:
        suspicion = self._suspicion
        return Surroundings(self._graph, suspicion.measured & ~suspicion.contradicted)

    @cached_property
    def _crossings(self) -> Crossings:
        return Crossings.of(self._graph, self._paths)

    def findings(self, monitor: Monitor) -> Findings:
        """The search, step by step."""
        suspicion = self._suspicion
        monitor.check()
        odometry = np.array(
            [edge.kind is EdgeKind.ODOMETRY for edge in self._graph.edges], np.bool_
        )
        alone = suspicion.measured & ~suspicion.confirmed & ~suspicion.contradicted & ~odometry
        rows = np.flatnonzero(suspicion.contradicted | alone).tolist()
        looks = SecondLooks(self._graph, self._frames, self._trusted, self._matcher, self._config)
        found = []
        with monitor.stage("second looks", len(rows)) as stage:
            for row in rows:
                found.append(self._finding(row, looks.at(row)))
                stage.advance()
                stage.check()
        wrong = [one for one in found if one.surety >= 1]
        wrong += self._derived({one.row for one in wrong})
        doubtful = [one for one in found if 0.5 <= one.surety < 1]
        return Findings(_ranked(wrong), _ranked(doubtful), len(rows), len(self._graph.edges))

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
            self._surety(contradicted, confirming, len(others), witnessed),
            confirming=confirming,
            looks=len(others),
            inliers=0 if own is None else own.inliers,
            witnessed=witnessed,
        )

    def _surety(self, contradicted: bool, confirming: int, looks: int, witnessed: int) -> float:
        """How surely an edge is wrong, from what speaks for and against it."""
        config = self._config
        if contradicted:
            return config.contradicted_surety - config.per_look * confirming
        failing = config.per_failing_look * (looks - confirming)
        known = min(failing, config.most_by_looks) - config.per_look * confirming
        return config.alone_surety + known - config.per_fix * min(witnessed, 5)

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
        return self._crossings.witnessed(sides[0], sides[1], len(self._graph))

    def _derived(self, wrong: set[int]) -> list[Finding]:
        """Predicted edges that contradict the map without the wrong ones."""
        suspicion, config, edges = self._suspicion, self._config, self._graph.edges
        kept = suspicion.measured & ~suspicion.contradicted
        kept[sorted(wrong)] = False
        ends = self._graph.edge_ends
        parts = part_labels(ends[kept], len(self._graph))
        gross = (suspicion.off_m > config.gross_m) & (suspicion.chi2 > config.gross_chi2)
        together = parts[ends[:, 0]] == parts[ends[:, 1]]
        return [
            self._finding_of(row, "derived", surety=1.0)
            for row in np.flatnonzero(~suspicion.measured & gross & together).tolist()
            if edges[row].kind is EdgeKind.PROXIMITY
        ]

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
