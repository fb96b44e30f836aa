"""Divides a robot's nodes into segments, to be replayed as live streams (method §7.2)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.fleet.merge.positions import seen_from
from engram.geometry import SE3
from engram.graph.model import Edge, EdgeKind, Node, NodeId


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A chain of nodes of one session, in the order of time.

    Attributes:
        nodes: at least one.
        steps: the odometry edges between them, one fewer than nodes; each in its stored
            direction.
    """

    nodes: tuple[Node, ...]
    steps: tuple[Edge, ...]

    @property
    def key(self) -> tuple[int, NodeId]:
        """Sort key of a session's segments: stamp and UUID of the first node."""
        return self.nodes[0].stamp_ns, self.nodes[0].id

    @property
    def motions(self) -> list[tuple[SE3, NDArray[np.float64]]]:
        """``prev_from_curr`` of each node but the first, and its (6, 6) covariance."""
        return [
            seen_from(edge, before.id)[1:]
            for edge, before in zip(self.steps, self.nodes[:-1], strict=True)
        ]


def string_segments(nodes: Sequence[Node], edges: Iterable[Edge]) -> list[Segment]:
    """Maximal chains of nodes linked by odometry edges, never across sessions.

    Every node is in one segment; one without an odometry edge forms its own. The result does
    not depend on the order of nodes or edges.

    Args:
        nodes: the nodes to divide.
        edges: any edges; only odometry edges between these nodes count.

    Returns:
        Segments by the stamp of their first node, then its UUID.

    Source: method §7.2; [G16] §V-A, Algorithm 1.
    """
    known = {node.id: node for node in nodes}
    following = _steps(known, edges)
    entered = {after for after, _ in following.values()}
    strung = [_from(node, known, following) for node in nodes if node.id not in entered]
    return sorted(strung, key=lambda segment: segment.key)


def _from(
    first: Node, known: dict[NodeId, Node], following: dict[NodeId, tuple[NodeId, Edge]]
) -> Segment:
    """The chain from a node; it ends, since steps lead forward in time."""
    nodes, steps = [first], []
    while (step := following.get(nodes[-1].id)) is not None:
        after, edge = step
        nodes.append(known[after])
        steps.append(edge)
    return Segment(tuple(nodes), tuple(steps))


def _steps(known: dict[NodeId, Node], edges: Iterable[Edge]) -> dict[NodeId, tuple[NodeId, Edge]]:
    """The next node of each node, and the edge between them.

    If edges branch, the one with the smaller time step is taken, then the smaller UUIDs: each node
    has at most one edge to an earlier node and one to a later node.
    """
    oriented: list[tuple[int, NodeId, NodeId, Edge]] = []
    for edge in edges:
        a, b = known.get(edge.a), known.get(edge.b)
        if edge.kind is not EdgeKind.ODOMETRY or a is None or b is None or a.session != b.session:
            continue
        if (b.stamp_ns, b.id) < (a.stamp_ns, a.id):
            a, b = b, a
        oriented.append((b.stamp_ns - a.stamp_ns, a.id, b.id, edge))
    # Of two opposite edges between the same nodes, the edge's key decides.
    oriented.sort(key=lambda one: (one[0], one[1], one[2], one[3].a))
    chosen: dict[NodeId, tuple[NodeId, Edge]] = {}
    entered: set[NodeId] = set()
    for _, a_id, b_id, edge in oriented:
        if a_id not in chosen and b_id not in entered:
            chosen[a_id] = b_id, edge
            entered.add(b_id)
    return chosen
