"""Regions of a map without a global frame: components, and stretches of their oldest sessions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from engram.errors import InputError
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Session, SessionId

STRETCH_M = 50.0
# Shorter ones are finer than nodes lie, and their numbers would overflow.
_LEAST_STRETCH_M = 1.0
# A node in the very place of another is still one step away.
_LEAST_STEP_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """Which region each node of a graph is in.

    A stretch is so many metres of the oldest session of a component; a node belongs to the
    stretch of that session's node that is nearest to it along the edges.

    Attributes:
        component: (N,) int32, numbered from 0 by first node.
        stretch: (N,) int32, `from_m` in units of the stretch's length.
        oldest: for each component its oldest session.
        stretch_m: length of a stretch.
    """

    component: NDArray[np.int32]
    stretch: NDArray[np.int32]
    oldest: tuple[SessionId, ...]
    stretch_m: float


def regions_of(
    graph: ExperienceGraph, sessions: dict[SessionId, Session], stretch_m: float = STRETCH_M
) -> Regions:
    """Divide a map into components and stretches.

    Args:
        graph: the map's.
        sessions: those of its nodes.
        stretch_m: length of a stretch, metres.

    Raises:
        InputError: the length is below 1 m, or not finite.
    """
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
