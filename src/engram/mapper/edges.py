"""Edges that a live camera measures between nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind
from engram.localiser import AcceptanceConfig, Position, Prediction, agrees
from engram.localiser.attempts import Outcome


def match_edges(
    graph: ExperienceGraph, outcomes: Sequence[Outcome], config: AcceptanceConfig
) -> list[Edge]:
    """Edges between nodes that one live frame matched: their relative pose is measured.

    A measurement that contradicts the known path between two nodes gives no edge: one of the two
    matches is then wrong, and its edge would fold the map permanently. This happens when a lost
    robot tries nodes far apart.

    Args:
        graph: has all nodes of the outcomes.
        outcomes: of one live frame. All edges start at the node of the best match.
        config: allowed disagreement with the known path, as for a match.

    Returns:
        Edges of kind `MATCH`, the best match's node as `a`.
    """
    best_first = sorted(outcomes, key=lambda outcome: -outcome.match.inliers)
    seen_from = [
        Position(outcome.candidate.node, pose, covariance)
        for outcome in best_first
        if outcome.accepted
        and (pose := outcome.match.reference_from_live) is not None
        and (covariance := outcome.match.covariance) is not None
    ]
    edges = [edge_through_live(seen_from[0], other, EdgeKind.MATCH) for other in seen_from[1:]]
    return [edge for edge in edges if fits(graph, edge, config)]


def edge_through_live(a: Position, b: Position, kind: EdgeKind) -> Edge:
    """The edge from `a.node` to `b.node`, of which each sees the same live camera."""
    a_from_b = a.node_from_live @ b.node_from_live.inverse()
    adjoint = a_from_b.adjoint()
    covariance = a.covariance + adjoint @ b.covariance @ adjoint.T
    return Edge(a.node, b.node, kind, a_from_b, covariance)


def fits(graph: ExperienceGraph, edge: Edge, config: AcceptanceConfig) -> bool:
    """Whether an edge agrees with the known path between its ends; True without a path."""
    known = graph.predict(graph.index(edge.a), graph.index(edge.b))
    if known is None:
        return True
    a_from_b, covariance = known
    whole = covariance + edge.covariance
    sigma_m, sigma_rad = (
        float(np.sqrt(max(np.linalg.eigvalsh(part)[-1], 0.0)))
        for part in (whole[:3, :3], whole[3:, 3:])
    )
    return agrees(edge.a_from_b, Prediction(a_from_b, sigma_m, sigma_rad), config)
