"""Edges of a map held against the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from engram.geometry import SE3
from engram.graph.model import Edge, EdgeKind, NodeId
from engram.localiser import Position

# An edge joins two places if it is further off than this, and than three standard deviations.
OTHER_PLACE_M = 5.0


@dataclass(frozen=True, slots=True)
class EdgeError:
    """How wrong an edge is.

    Attributes:
        kind: origin of the edge.
        error_m: how far off it is, metres.
        joins_places: whether it joins two places, which ruins a map. Where odometry had
            lost track, edges are far off and say so.
    """

    kind: EdgeKind
    error_m: float
    joins_places: bool


def edge_errors(
    edges: Iterable[Edge], world_from_node: Callable[[NodeId], SE3 | None]
) -> Iterator[EdgeError]:
    """The errors of the edges between nodes whose true poses are known.

    Args:
        edges: of a map.
        world_from_node: true pose of a node; None where it is not known.
    """
    for edge in edges:
        a, b = world_from_node(edge.a), world_from_node(edge.b)
        if a is None or b is None:
            continue
        error_m = (edge.a_from_b.inverse() @ (a.inverse() @ b)).distance_m
        sigma_m = Position(edge.a, edge.a_from_b, edge.covariance).sigma_m
        yield EdgeError(edge.kind, error_m, error_m > max(OTHER_PLACE_M, 3 * sigma_m))
