"""Stringing a robot's nodes into segments, to be replayed as live streams (SPEC §7 MERGE 2)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engram.fleet.merge.positions import seen_from
from engram.geometry import SE3
from engram.graph.model import Edge, EdgeKind, Node, NodeId


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A chain of nodes that one session saved, in the order of time.

    Attributes:
        nodes: at least one.
        steps: the odometry edges between them, one fewer than nodes; each as it is in the map, so
            it may run either way.
    """

    nodes: tuple[Node, ...]
    steps: tuple[Edge, ...]

    @property
    def key(self) -> tuple[int, NodeId]:
        """Stamp and UUID of the first node: segments of one session are replayed in this order."""
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

    Every node is in one segment; one without an odometry edge is a segment of its own. The result
    does not depend on the order of nodes or edges.

    Args:
        nodes: those to be strung.
        edges: any edges; only odometry edges between these nodes count.

    Returns:
        Segments by the stamp of their first node, then its UUID.

    Source: SPEC §7 MERGE 2; [G16] §V-A, Algorithm 1.
    """
    known = {node.id: node for node in nodes}
    steps = _steps(known, edges)
    chains = _Chains()
    for a, b in steps:
        chains.link(a, b)
    strung = [_segment(chain, known, steps) for chain in chains.all()]
    strung += [Segment((node,), ()) for node in known.values() if node.id not in chains]
    return sorted(strung, key=lambda segment: segment.key)


def _steps(known: dict[NodeId, Node], edges: Iterable[Edge]) -> dict[tuple[NodeId, NodeId], Edge]:
    """The odometry edges that go on, by (earlier, later) node.

    Where edges branch, the one with the smaller time step goes on, then the smaller UUIDs: so each
    node has one edge at most to an earlier node and one to a later.
    """
    oriented: list[tuple[int, NodeId, NodeId, Edge]] = []
    for edge in edges:
        a, b = known.get(edge.a), known.get(edge.b)
        if edge.kind is not EdgeKind.ODOMETRY or a is None or b is None or a.session != b.session:
            continue
        if (b.stamp_ns, b.id) < (a.stamp_ns, a.id):
            a, b = b, a
        oriented.append((b.stamp_ns - a.stamp_ns, a.id, b.id, edge))
    # An edge laid both ways between the same nodes: the key of the edge decides which is taken.
    oriented.sort(key=lambda one: (one[0], one[1], one[2], one[3].a))
    chosen: dict[tuple[NodeId, NodeId], Edge] = {}
    left: set[NodeId] = set()
    entered: set[NodeId] = set()
    for _, a_id, b_id, edge in oriented:
        if a_id not in left and b_id not in entered:
            chosen[a_id, b_id] = edge
            left.add(a_id)
            entered.add(b_id)
    return chosen


class _Chains:
    """[G16] Algorithm 1 by cases; the comments of its lines 6 and 8 are swapped in the paper.

    Edges come in any order, as they do from a map; each node has one edge to an earlier node and
    one to a later at most.
    """

    def __init__(self) -> None:
        self._ending: dict[NodeId, deque[NodeId]] = {}
        self._beginning: dict[NodeId, deque[NodeId]] = {}
        self._held: set[NodeId] = set()

    def __contains__(self, node: NodeId) -> bool:
        return node in self._held

    def link(self, a: NodeId, b: NodeId) -> None:
        """An edge from a to b."""
        before, after = self._ending.pop(a, None), self._beginning.pop(b, None)
        if before is not None and after is not None:
            self._fuse(before, after)
        elif before is not None:
            before.append(b)
            self._ending[b] = before
        elif after is not None:
            after.appendleft(a)
            self._beginning[a] = after
        else:
            self._beginning[a] = self._ending[b] = deque((a, b))
        self._held |= {a, b}

    def _fuse(self, before: deque[NodeId], after: deque[NodeId]) -> None:
        """The shorter chain moves: fusing costs n log n altogether."""
        first, last = before[0], after[-1]
        if len(before) >= len(after):
            before.extend(after)
            fused = before
        else:
            after.extendleft(reversed(before))
            fused = after
        self._beginning[first] = self._ending[last] = fused

    def all(self) -> Iterable[deque[NodeId]]:
        """The chains."""
        return self._beginning.values()


def _segment(
    chain: deque[NodeId],
    known: dict[NodeId, Node],
    steps: dict[tuple[NodeId, NodeId], Edge],
) -> Segment:
    ids = list(chain)
    return Segment(
        tuple(known[one] for one in ids),
        tuple(steps[pair] for pair in pairwise(ids)),
    )
