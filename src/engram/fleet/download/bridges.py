"""Edges across omitted nodes, so that a download stays as connected as the fleet map (method §7).

Every omitted node belongs to the basin of the sent node that reaches it along the chain of least
variance. If two basins touch, the chain between their two sent nodes is a candidate. A spanning
tree of candidates closes every gap. Short candidates are sent as well: two experiences that were
tied every few metres through a third one stay tied every few metres.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3, propagate_covariance
from engram.graph.graph import Links
from engram.graph.model import Edge, EdgeKind, NodeId

Array = NDArray[np.float64]

# Beyond the reach of a neighbourhood search (`SearchConfig.margin_m`), a bridge shortens nothing.
_NEAR_M = 12.0
# Metres per radian in the cost of a chain: the usual distance of a landmark.
_LEVER_M = 10.0
# Chains of perfectly known edges still prefer fewer edges.
_LEAST_COST = 1e-12


def close_gaps(
    nodes: Sequence[NodeId], edges: Sequence[Edge], sent: NDArray[np.bool_]
) -> list[Edge]:
    """Bridges between sent nodes, composed through omitted nodes.

    Args:
        nodes: all nodes of the graph.
        edges: all its edges.
        sent: (N,) bool, which nodes are sent.

    Returns:
        Edges of kind `bridge`, with summed covariances, ordered by their ends. With them the sent
        nodes are in as many components as they are in the whole graph.
    """
    if sent.all() or not sent.any():
        return []
    index = {node: at for at, node in enumerate(nodes)}
    ends = np.array([(index[edge.a], index[edge.b]) for edge in edges], np.int64).reshape(-1, 2)
    # Of several edges between two nodes, the one of least variance.
    steps = Links.lightest(ends, np.array([_variance(edge.covariance) for edge in edges]))
    search = _Search(nodes, edges, ends, steps, sent)
    needed, near = search.candidates()
    chosen = {pair: search.bridge(*pair) for pair in needed}
    for pair in near:
        bridge = chosen.get(pair) or search.bridge(*pair)
        if bridge.a_from_b.distance_m <= _NEAR_M:
            chosen[pair] = bridge
    return [chosen[pair] for pair in sorted(chosen)]


def components(count: int, ends: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) label of each node's component."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    links = csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def _variance(covariance: Array) -> float:
    diagonal = np.diag(covariance)
    return max(float(diagonal[:3].sum() + _LEVER_M**2 * diagonal[3:].sum()), _LEAST_COST)


class _Search:
    """Chains from sent nodes outwards through omitted nodes."""

    def __init__(
        self,
        nodes: Sequence[NodeId],
        edges: Sequence[Edge],
        ends: NDArray[np.int64],
        steps: Links,
        sent: NDArray[np.bool_],
    ) -> None:
        self._nodes, self._edges, self._ends, self._steps = nodes, edges, ends, steps
        self._sent = sent
        # Edges between two sent nodes are sent themselves.
        self._through = ~(sent[steps.low] & sent[steps.high])
        inner = sent[ends].all(axis=1)
        self._joined = components(len(nodes), ends[inner])
        odometry = np.array([edge.kind is EdgeKind.ODOMETRY for edge in edges], np.bool_)
        self._pieces = components(len(nodes), ends[inner & odometry])
        self._edge_of = {
            (int(low), int(high)): int(edge)
            for low, high, edge in zip(steps.low, steps.high, steps.edge, strict=True)
        }
        self._reach()

    def _reach(self) -> None:
        """The chain of least variance from any sent node to each omitted node."""
        from scipy.sparse.csgraph import dijkstra

        steps, through = self._steps, self._through
        links = steps.matrix(len(self._nodes), through)
        self._cost, self._before, self._source = dijkstra(
            links,
            directed=False,
            indices=np.flatnonzero(self._sent),
            min_only=True,
            return_predecessors=True,
        )

    def candidates(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Pairs of sent nodes that a bridge may join.

        Returns:
            A spanning tree over the gaps; and for each node the pair of least variance to every
            other piece of an experience.
        """
        steps, through = self._steps, self._through
        self._border: dict[tuple[int, int], tuple[float, int]] = {}
        for at in np.flatnonzero(through):
            low, high = int(steps.low[at]), int(steps.high[at])
            sources = int(self._source[low]), int(self._source[high])
            if min(sources) < 0 or sources[0] == sources[1]:  # unreached, or inside one basin
                continue
            cost = float(self._cost[low] + steps.weight[at] + self._cost[high])
            pair = (min(sources), max(sources))
            if pair not in self._border or cost < self._border[pair][0]:
                self._border[pair] = (cost, int(at))
        ordered = sorted(self._border, key=lambda pair: (self._border[pair][0], pair))
        return self._spanning(ordered), self._nearest(ordered)

    def _spanning(self, ordered: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Kruskal's tree over the components of the sent nodes."""
        root = {int(label): int(label) for label in np.unique(self._joined)}

        def find(label: int) -> int:
            while root[label] != label:
                root[label] = root[root[label]]
                label = root[label]
            return label

        needed = []
        for pair in ordered:
            a, b = (find(int(self._joined[node])) for node in pair)
            if a != b:
                root[max(a, b)] = min(a, b)
                needed.append(pair)
        return needed

    def _nearest(self, ordered: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Candidates of least variance from either end to the other's piece."""
        taken: dict[int, set[int]] = defaultdict(set)
        kept = []
        for a, b in ordered:
            pieces = int(self._pieces[a]), int(self._pieces[b])
            if pieces[0] == pieces[1]:
                continue
            if pieces[1] not in taken[a] or pieces[0] not in taken[b]:
                kept.append((a, b))
            taken[a].add(pieces[1])
            taken[b].add(pieces[0])
        return kept

    def bridge(self, a: int, b: int) -> Edge:
        """The chain between two sent nodes as one edge."""
        _, at = self._border[a, b]
        ends = [int(self._steps.low[at]), int(self._steps.high[at])]
        if int(self._source[ends[0]]) != a:
            ends.reverse()
        chain = [*reversed(self._back(ends[0])), *self._back(ends[1])]
        a_from_end, covariance = SE3.identity(), np.zeros((6, 6))
        for near, far in pairwise(chain):
            near_from_far, step = self._step(near, far)
            covariance = propagate_covariance(a_from_end, covariance, step)
            a_from_end = a_from_end @ near_from_far
        covariance = (covariance + covariance.T) / 2
        return Edge(self._nodes[a], self._nodes[b], EdgeKind.BRIDGE, a_from_end, covariance)

    def _back(self, node: int) -> list[int]:
        """From a node to the sent node whose basin it is in."""
        chain = [node]
        while not self._sent[chain[-1]]:
            chain.append(int(self._before[chain[-1]]))
        return chain

    def _step(self, near: int, far: int) -> tuple[SE3, Array]:
        """``near_from_far`` and its covariance."""
        at = self._edge_of[min(near, far), max(near, far)]
        edge = self._edges[at]
        if int(self._ends[at, 0]) == near:
            return edge.a_from_b, edge.covariance
        b_from_a = edge.a_from_b.inverse()
        adjoint = b_from_a.adjoint()
        return b_from_a, adjoint @ edge.covariance @ adjoint.T
