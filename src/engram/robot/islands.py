"""Parts of a map that nothing ties are joined where their anchors say that they are one place.

Anchors, such as satellite fixes, only propose which nodes may show the same; matches decide, two
that lie apart and agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.counts import counted
from engram.errors import MapCorruptError
from engram.frontend.matching import match_frames, pair_seed
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, LandmarkSource
from engram.localiser import AcceptanceConfig
from engram.mapper.loops import edges_agree
from engram.maps import Map, MapFrame
from engram.monitor import QUIET, Monitor
from engram.robot.settings import Settings

T = TypeVar("T")

# Matches between two parts that are compared with each other, way by way.
_JUDGED = 40


@dataclass(frozen=True, slots=True)
class IslandsConfig:
    """Which nodes of two parts are compared, and which matches join them.

    Attributes:
        sigmas: nodes are compared up to so many standard deviations of their parts' anchors.
        reach_m: and so much farther, as views match that lie apart.
        turn_rad: largest difference of their headings.
        nearest: nodes of the other part that each node is compared with.
        attempts: most matches that are tried between two parts.
        apart_m: least distance between two matches that confirm each other. Source: that of loops.
        certain_m: largest standard deviation of the distances between them.
    """

    sigmas: Annotated[float, Meta(gt=0, le=10)] = 3.0
    reach_m: Annotated[float, Meta(ge=0, le=50)] = 4.0
    turn_rad: Annotated[float, Meta(gt=0, le=np.pi)] = 0.8
    nearest: Annotated[int, Meta(ge=1, le=100)] = 5
    attempts: Annotated[int, Meta(ge=1, le=100_000)] = 400
    apart_m: Annotated[float, Meta(ge=0, le=100)] = 8.0
    certain_m: Annotated[float, Meta(gt=0, le=100)] = 1.0

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True)
class IslandReport:
    """Result of joining the parts of a map.

    Attributes:
        revision: its number; None if nothing was joined.
        compared: matches tried.
        joined: nodes of both sides of each edge that joins two parts.
    """

    revision: int | None = None
    compared: int = 0
    joined: tuple[tuple[str, str], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What ``anchor --json`` prints under ``islands``."""
        return {"revision": self.revision, "compared": self.compared, "joined": list(self.joined)}

    def text(self) -> str:
        """In words; "" if there was nothing to compare."""
        if not self.compared:
            return ""
        if self.revision is None:
            pairs = counted(self.compared, "pair")
            return f"unconnected parts: {pairs} of nodes compared, none joins them"
        return (
            f"unconnected parts: {counted(len(self.joined), 'match')} of {self.compared} joined, "
            f"revision {self.revision}"
        )


def join_islands(
    path: Path,
    author: str,
    settings: Settings | None = None,
    config: IslandsConfig | None = None,
    monitor: Monitor = QUIET,
) -> IslandReport:
    """Joins the parts of an anchored map that show the same places, in a revision of its own.

    Raises:
        MapError: the map cannot be read or written.
    """
    with Map.open(path, writes=True) as store:
        resolved = (settings or Settings()).for_descriptor(store.descriptor)
        islands = _Islands(store.graph, store.frame, store.frames, resolved, config)
        edges = islands.edges(_sigmas_m(store), monitor)
        ids = tuple((str(edge.a), str(edge.b)) for edge in edges)
        if not edges:
            return IslandReport(None, islands.compared, ids)
        about = {"islands": {"compared": islands.compared, "joined": len(edges)}}
        with store.begin_revision(
            author=author,
            message=f"join parts by {counted(len(edges), 'match')}",
            configuration=about,
        ) as writer:
            for edge in edges:
                writer.add_edge(edge)
            number = writer.commit(resolved.placing).number
        return IslandReport(number, islands.compared, ids)


def _sigmas_m(store: Map) -> dict[int, float]:
    """Standard deviation of the anchors of each component that has two or more, by label."""
    labels = store.graph.components()
    found: dict[int, list[float]] = {}
    for one in store.anchors:
        if one.node in store.graph:
            label = int(labels[store.graph.index(one.node)])
            found.setdefault(label, []).append(one.sigma_m)
    return {label: float(np.median(all_m)) for label, all_m in found.items() if len(all_m) > 1}


class _Islands:
    """Compares the nodes of parts that lie at the same place."""

    def __init__(
        self,
        graph: ExperienceGraph,
        frame: MapFrame,
        frames: LandmarkSource,
        settings: Settings,
        config: IslandsConfig | None,
    ) -> None:
        self.compared = 0
        self._graph, self._frames = graph, frames
        self._places = frame.positions[:, :2]
        self._ahead = np.array([frame.pose(node.id).rotation[:2, 2] for node in graph.nodes])
        self._matcher = settings.localiser.matcher
        self._acceptance: AcceptanceConfig = settings.localiser.acceptance
        self._config = config or IslandsConfig()

    def edges(self, sigmas_m: dict[int, float], monitor: Monitor) -> list[Edge]:
        """The matches that join parts, each confirmed by another.

        Args:
            sigmas_m: of the anchors, by label of the parts that have some.
            monitor: receives progress, and may cancel.
        """
        labels = self._graph.components()
        found: list[Edge] = []
        with monitor.stage("parts that nothing ties", len(sigmas_m)) as stage:
            for one, other in combinations(sorted(sigmas_m), 2):
                within_m = self._config.sigmas * float(np.hypot(sigmas_m[one], sigmas_m[other]))
                within_m += self._config.reach_m
                sides = np.flatnonzero(labels == one), np.flatnonzero(labels == other)
                found += self._confirmed(list(self._matches(*sides, within_m)))
                stage.check()
        return found

    def _matches(
        self, ones: NDArray[np.int64], others: NDArray[np.int64], within_m: float
    ) -> Iterator[Edge]:
        """The matches between two parts, of nodes that may show the same."""
        low, high = self._places[others].min(axis=0), self._places[others].max(axis=0)
        inside = (self._places[ones] > low - within_m) & (self._places[ones] < high + within_m)
        near = ones[inside.all(axis=1)]
        pairs = [pair for one in near for pair in self._near(int(one), others, within_m)]
        for pair in _evenly(pairs, self._config.attempts):
            edge = self._match(*pair)
            if edge is not None:
                yield edge

    def _near(self, node: int, others: NDArray[np.int64], within_m: float) -> list[tuple[int, int]]:
        far_m = np.linalg.norm(self._places[others] - self._places[node], axis=1)
        alike = self._ahead[others] @ self._ahead[node] >= np.cos(self._config.turn_rad)
        order = np.argsort(np.where(alike, far_m, np.inf), kind="stable")[: self._config.nearest]
        return [(node, int(others[at])) for at in order if alike[at] and far_m[at] <= within_m]

    def _match(self, a: int, b: int) -> Edge | None:
        """The match of two nodes, if it would place a lost robot."""
        self.compared += 1
        ids = self._graph.node(a).id, self._graph.node(b).id
        try:
            match = match_frames(
                self._frames.frame(ids[0]),
                self._frames.frame(ids[1]),
                self._matcher,
                pair_seed(ids[1], ids[0]),
            )
        except MapCorruptError:
            return None
        pose, covariance = match.reference_from_live, match.covariance
        if pose is None or covariance is None or pose.distance_m > self._acceptance.reach_m:
            return None
        if match.inliers < self._acceptance.min_inliers_plausible:
            return None
        sure = np.trace(covariance[:3, :3]) <= self._acceptance.max_sigma_m**2
        return Edge(*ids, EdgeKind.MATCH, pose, covariance) if sure else None

    def _confirmed(self, edges: list[Edge]) -> list[Edge]:
        """The largest group of matches that confirm each other, one of each place."""
        config, graph = self._config, self._graph
        best: list[Edge] = []
        judged = _evenly(edges, _JUDGED)
        for first in judged:
            group = [first]
            for edge in judged:
                ends = [(edge.a, group[-1].a), (edge.b, group[-1].b)]
                ways = [graph.predict(graph.index(then), graph.index(to)) for to, then in ends]
                apart = all(way is not None and way[0].distance_m >= config.apart_m for way in ways)
                if apart and edges_agree(
                    graph, group[-1], edge, self._acceptance, config.certain_m
                ):
                    group.append(edge)
            best = max(best, group, key=len)
        return best if len(best) > 1 else []


def _evenly(items: list[T], most: int) -> list[T]:
    """A given number of items, spread over a list: what one place hides another may show."""
    if len(items) <= most:
        return items
    return [items[at] for at in np.linspace(0, len(items) - 1, most).astype(np.int64).tolist()]
