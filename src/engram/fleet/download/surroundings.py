"""What lies around the places of a mission: found along the edges, page by page.

A download needs more than the nodes that it may send: bridges lead through nodes that stay behind
(`close_gaps`), and the forecast counts what would have matched there. So some metres around the
mission's area are read as well, and more where only a longer path connects its parts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.graph.graph import Links, labels_of
from engram.graph.pages import PAGE, GraphPage
from engram.maps.pages import MapPages
from engram.maps.runs import Runs

Indices = NDArray[np.int64]

# Read around the area: more than twice the length of a short bridge.
MARGIN_M = 30.0
_WIDER, _FARTHEST_M = 4.0, 1e6
# Least length of an edge, so that nodes at one place are still a step apart.
_LEAST_STEP_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Nodes of a map around some places, and the edges between them.

    Attributes:
        found: all of them as one page.
        inside: (N,) bool, which of `found.nodes` belong to the area.
        whole: whether these are all nodes of the map.
    """

    found: GraphPage
    inside: NDArray[np.bool_]
    whole: bool

    @staticmethod
    def everything(pages: MapPages) -> Surroundings:
        """All nodes of a map."""
        found = pages.part(0, pages.end)
        return Surroundings(found, np.ones(len(found.nodes), np.bool_), whole=True)

    @staticmethod
    def of(pages: MapPages, runs: Runs | None, seeds: Indices, radius_m: float) -> Surroundings:
        """The nodes within a distance of any seed along the edges, and those around them.

        Args:
            pages: of the map.
            runs: which of its nodes are connected; what connects the area is read as well. None
                for no more than a margin.
            seeds: (S,) dense indices.
            radius_m: of the area, metres.
        """
        loaded: dict[int, GraphPage] = {}
        margin_m = MARGIN_M
        while True:
            nodes, distance_m = _search(pages, loaded, seeds, radius_m + margin_m)
            here = Surroundings(
                _joined([loaded[number] for number in sorted(loaded)], nodes),
                distance_m <= radius_m,
                whole=False,
            )
            if runs is None or margin_m > _FARTHEST_M or here._is_connected_as(runs):
                return here
            margin_m *= _WIDER

    def _is_connected_as(self, runs: Runs) -> bool:
        """Whether the area's nodes are connected here if they are in the map."""
        nodes = self.found.nodes.astype(np.int64)
        here = labels_of(np.searchsorted(nodes, self.found.ends), len(nodes))[self.inside]
        there = runs.component[runs.find(nodes[self.inside] + 1)]
        return len(np.unique(np.column_stack([here, there]), axis=0)) == len(np.unique(there))


def _search(
    pages: MapPages, loaded: dict[int, GraphPage], seeds: Indices, limit_m: float
) -> tuple[Indices, NDArray[np.float64]]:
    """Nodes within a distance of the seeds, and that distance, metres; reads what is missing."""
    wanted = np.setdiff1d(seeds // PAGE, list(loaded))
    while True:
        loaded |= {number: pages.page(number) for number in wanted.tolist()}
        nodes, distance_m = _reached(loaded.values(), seeds, limit_m)
        wanted = np.setdiff1d(nodes // PAGE, list(loaded))
        if not len(wanted):
            return nodes, distance_m


def _reached(
    parts: Iterable[GraphPage], seeds: Indices, limit_m: float
) -> tuple[Indices, NDArray[np.float64]]:
    from scipy.sparse.csgraph import dijkstra

    ends = np.concatenate([part.ends for part in parts]).astype(np.int64)
    steps_m = np.linalg.norm(np.concatenate([part.poses[:, 9:] for part in parts]), axis=1)
    known = np.unique(np.concatenate([ends.ravel(), seeds]))
    links = Links.lightest(np.searchsorted(known, ends), np.maximum(steps_m, _LEAST_STEP_M))
    distance_m = dijkstra(
        links.matrix(len(known)),
        directed=False,
        indices=np.searchsorted(known, seeds),
        min_only=True,
        limit=limit_m,
    )
    reached = np.flatnonzero(np.isfinite(distance_m))
    return known[reached], distance_m[reached]


def _joined(parts: Sequence[GraphPage], nodes: Indices) -> GraphPage:
    """Some nodes of pages, rising dense indices, and the edges between them, each once."""
    at = [np.flatnonzero(np.isin(part.nodes, nodes)) for part in parts]

    def of_nodes(name: str) -> NDArray[Any]:
        rows = zip(parts, at, strict=True)
        return np.concatenate([getattr(part, name)[own] for part, own in rows])

    ends, kinds, poses, covariances = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("ends", "kinds", "poses", "covariances")
    )
    inner = np.flatnonzero(np.isin(ends, nodes).all(axis=1))
    keys = np.column_stack([ends[inner], kinds[inner]])
    rows = inner[np.unique(keys, axis=0, return_index=True)[1]]
    return GraphPage(
        number=0,
        nodes=of_nodes("nodes"),
        uuids=of_nodes("uuids"),
        sessions=of_nodes("sessions"),
        cameras=[
            part.cameras[row] for part, own in zip(parts, at, strict=True) for row in own.tolist()
        ],
        stamps_ns=of_nodes("stamps_ns"),
        driven_m=of_nodes("driven_m"),
        ends=ends[rows],
        kinds=kinds[rows],
        poses=poses[rows],
        covariances=covariances[rows],
    )
