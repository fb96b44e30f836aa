"""The published neighbourhood: breadth-first search in a local graph neighbourhood ([G16] §III-A).

It differs from `ExperienceGraph.neighbourhood` in three ways. The chain with the fewest edges gives
a node's position, not the least uncertain one. The search stops at the radius, without room for
detours or for the uncertainty of a prediction. Proximity edges, which the papers do not have, do
not count: two experiences that never matched each other are not connected.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.geometry import SE3
from engram.graph.chain_error import ChainError
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind
from engram.graph.neighbourhood import Neighbourhood, Search

Array = NDArray[np.float64]


def breadth_first(
    graph: ExperienceGraph,
    reference: int,
    reference_from_live: SE3,
    covariance: Array,
    search: Search,
) -> Neighbourhood:
    """The candidates Y near the live camera, fewest edges first.

    Args:
        graph: the experience graph.
        reference: dense index of the node that the position refers to.
        reference_from_live: pose of the live camera in that node.
        covariance: (6, 6) float64 of that pose, left perturbation, [translation, rotation].
        search: radius and gates; its `config` is not used.
    """
    live_m = reference_from_live.translation
    own = _moments(_core.pivoted_error(np.ascontiguousarray(covariance)), SE3.identity())
    reached = {reference: (SE3.identity(), ChainError(np.zeros(6)))}
    queue, rows = deque([reference]), []
    while queue:
        node = queue.popleft()
        reference_from_node, chain = reached[node]
        near = np.linalg.norm(reference_from_node.translation - live_m) <= search.radius_m
        if near:
            rows.append(node)
        elif node != reference:
            continue
        for edge, number in reversed(graph.numbered_edges_of(node)):
            if edge.kind is EdgeKind.PROXIMITY:
                continue
            other, node_from_other = _across(graph, edge, node)
            if other not in reached:
                step = _moments(graph.edge_errors[number][:5], _a_pose(graph, edge, node, reached))
                reached[other] = (reference_from_node @ node_from_other, chain + step)
                queue.append(other)
    chains = [(node, *reached[node]) for node in rows if not _is_own(graph, node, search)]
    return _neighbourhood(chains, own, reference_from_live, search)


def _across(graph: ExperienceGraph, edge: Edge, node: int) -> tuple[int, SE3]:
    """The other end of an edge, and ``node_from_other``."""
    a = graph.index(edge.a)
    if node == a:
        return graph.index(edge.b), edge.a_from_b
    return a, edge.a_from_b.inverse()


def _a_pose(
    graph: ExperienceGraph, edge: Edge, node: int, reached: dict[int, tuple[SE3, ChainError]]
) -> SE3:
    """``reference_from_a`` of an edge that leads on from a reached node."""
    reference_from_node = reached[node][0]
    if node == graph.index(edge.a):
        return reference_from_node
    return reference_from_node @ edge.a_from_b.inverse()


def _moments(error: Array, reference_from_a: SE3) -> ChainError:
    """The error (5,) of a transform, τ, v and pivot in a, as moments in the reference's frame."""
    tau, v, pivot = float(error[0]), float(error[1]), reference_from_a @ np.asarray(error[2:5])
    return ChainError(np.array([tau, v, *(v * pivot), v * (pivot @ pivot)]))


def _is_own(graph: ExperienceGraph, node: int, search: Search) -> bool:
    """Whether the live session saved a node within the last metres."""
    record = graph.node(node)
    return (
        record.session == search.own_session
        and record.driven_m > search.own_driven_m - search.own_exclusion_m
    )


def _neighbourhood(
    chains: list[tuple[int, SE3, ChainError]],
    own: ChainError,
    reference_from_live: SE3,
    search: Search,
) -> Neighbourhood:
    """The candidates whose viewing direction passes the gate, as a struct of arrays."""
    live_m = reference_from_live.translation
    columns = []
    for node, reference_from_node, chain in chains:
        node_from_reference = reference_from_node.inverse()
        node_from_live = node_from_reference @ reference_from_live
        yaw_rad = node_from_live.yaw_rad
        if abs(yaw_rad) > search.view_gate_rad:
            continue
        error = (chain + own).pivoted(live_m)
        lever_m = live_m - error.pivot_in_a
        variance = error.translation_var + error.rotation_var * float(lever_m @ lever_m)
        across_m, _, along_m = node_from_live.translation.tolist()
        columns.append(
            (
                node,
                node_from_live.matrix(),
                node_from_live.distance_m,
                along_m,
                across_m,
                yaw_rad,
                np.sqrt(variance),
                np.sqrt(error.rotation_var),
                node_from_reference @ error.pivot_in_a,
            )
        )
    shapes: tuple[tuple[int, ...], ...] = ((), (4, 4), (), (), (), (), (), (), (3,))
    kinds = (np.int32, *(np.float64,) * 8)
    return Neighbourhood(
        *(
            np.array([row[at] for row in columns], kind).reshape(len(columns), *shape)
            for at, (kind, shape) in enumerate(zip(kinds, shapes, strict=True))
        )
    )
