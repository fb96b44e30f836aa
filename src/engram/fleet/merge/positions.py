"""Transfers edges and positions from a robot's nodes to their equivalents in the fleet map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3, propagate_covariance
from engram.graph.model import Edge, EdgeKind, NodeId, Omission
from engram.localiser import Position

Array = NDArray[np.float64]

# Standard deviations of an omitted node's position, whose match covariance is not stored: wide
# against the errors of matches. Source: lab/reports/constants.md.
_OMITTED_SIGMA_M = 0.2
_OMITTED_SIGMA_RAD = float(np.deg2rad(1.0))


def position_of(omission: Omission) -> Position:
    """Position of an omitted node in the map that omits it."""
    spread = np.diag([_OMITTED_SIGMA_M**2] * 3 + [_OMITTED_SIGMA_RAD**2] * 3)
    return Position(omission.node, omission.node_from_omitted, spread)


def seen_from(edge: Edge, node: NodeId) -> tuple[NodeId, SE3, Array]:
    """The other end of an edge, ``node_from_other``, and its (6, 6) covariance."""
    if node == edge.a:
        return edge.b, edge.a_from_b, edge.covariance
    b_from_a = edge.a_from_b.inverse()
    adjoint = b_from_a.adjoint()
    return edge.a, b_from_a, adjoint @ edge.covariance @ adjoint.T


def beyond(known: Position, edge: Edge, node: NodeId) -> Position:
    """Position of a node, by its edge to another node whose position is known.

    Args:
        known: position of the edge's other end.
        edge: of the node.
        node: the end whose position is wanted.
    """
    other = edge.b if node == edge.a else edge.a
    _, other_from_node, covariance = seen_from(edge, other)
    return known.carried_on(other_from_node, covariance)


def recomposed(edge: Edge, a: Position, b: Position) -> Edge | None:
    """An edge between two of the robot's nodes, as one between their equivalents (method §7.3).

    A moved odometry edge becomes a tie, since it no longer links nodes of one experience.

    Args:
        edge: as in the robot's map.
        a, b: positions of its ends in the fleet map.

    Returns:
        The edge; None if both ends have the same equivalent.
    """
    if (a.node, b.node) == (edge.a, edge.b):
        return edge
    if a.node == b.node:
        return None
    covariance = propagate_covariance(a.node_from_live, a.covariance, edge.covariance)
    new_a_from_new_b = a.node_from_live @ edge.a_from_b @ b.node_from_live.inverse()
    adjoint = new_a_from_new_b.adjoint()
    covariance = covariance + adjoint @ b.covariance @ adjoint.T
    kind = EdgeKind.TIE if edge.kind is EdgeKind.ODOMETRY else edge.kind
    return Edge(a.node, b.node, kind, new_a_from_new_b, (covariance + covariance.T) / 2)


def uncertainty_m2(covariance: Array) -> float:
    """Sum of the translational variances of a (6, 6) covariance, m²; ranks two estimates."""
    return float(np.trace(covariance[:3, :3]))
