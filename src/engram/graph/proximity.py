"""Which nodes are near a position: breadth-first along edges, and by the error of chains.

Two experiences that do not match each other may run in parallel for hundreds of metres. A robot
localised in one of them needs the nodes of the other as candidates. So when a robot saves nodes on
odometry alone near known ones, each is joined to them by dead reckoning, with its uncertainty.
Once a match ties the far end of the chain, the closure is distributed along it.

The published neighbourhood: breadth-first search in a local graph neighbourhood ([G16] §III-A). It
differs from `ExperienceGraph.neighbourhood` in three ways. The chain with the fewest edges gives a
node's position, not the least uncertain one. The search stops at the radius, without room for
detours or for the uncertainty of a prediction. Proximity edges, which the papers do not have, do
not count: two experiences that never matched each other are not connected.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.basin import ChainError
from engram.graph.graph import ChainTree, ExperienceGraph, Passage
from engram.graph.model import Edge, EdgeKind
from engram.graph.neighbourhood import Neighbourhood, Search

Array = NDArray[np.float64]

_LINKS = frozenset({EdgeKind.PROXIMITY, EdgeKind.MATCH, EdgeKind.TIE})


@dataclass(frozen=True, slots=True)
class ProximityConfig:
    """Settings of `lay_proximity_edges` and `tighten_chain`.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    reach_m: Annotated[
        float,
        Meta(
            ge=0,
            description="largest predicted distance of nodes to join, plus two standard "
            "deviations, m: the search radius, so that all candidates of a localiser are joined",
        ),
    ] = 8.0
    spacing_m: Annotated[
        float,
        Meta(
            ge=0,
            description="least distance between joints of a chain to the same experience, m; "
            "below the margin of the neighbourhood search",
        ),
    ] = 4.0
    greatest_sigma_m: Annotated[
        float,
        Meta(
            ge=0,
            description="largest standard deviation of dead reckoning that joins nodes, m: beyond "
            "it the tie at the chain's far end decides",
        ),
    ] = 15.0
    pass_gap_m: Annotated[
        float,
        Meta(
            ge=0,
            description="distance along the drive from which nodes of one experience are separate "
            "passes, each joined for itself, m; nearer own nodes are not joined. Source: "
            "method §3.1",
        ),
    ] = 30.0
    consistent_chi2: Annotated[
        float,
        Meta(
            gt=0,
            description="squared distance from which two estimates of a transform contradict each "
            "other: 99.9 % of χ² with six degrees of freedom",
        ),
    ] = 22.5

    def __post_init__(self) -> None:
        check_bounds(self)


DEFAULT_CONFIG = ProximityConfig()


def lay_proximity_edges(
    graph: ExperienceGraph, node: int, config: ProximityConfig = DEFAULT_CONFIG
) -> list[Edge]:
    """Join a node to the nearest node of each experience around it.

    Call it after the node, and the edge that chains it to the previous one or ties it, are in the
    graph. The graph gives the prediction and its uncertainty, which grows along the chain.

    Returns:
        The edges, each from the known node to the given one. They are already in the graph; the
        caller stores them.
    """
    near = _beside(graph, node, config)
    linked = _linked_lately(graph, node, config.spacing_m)
    edges = []
    for rows in _passes(graph, near, config.pass_gap_m):
        if not linked.isdisjoint(near.nodes[rows].tolist()):
            continue
        row = int(rows[np.argmin(near.distance_m[rows])])
        pose = near.node_from_live[row]
        edges.append(
            Edge(
                a=graph.node(int(near.nodes[row])).id,
                b=graph.node(node).id,
                kind=EdgeKind.PROXIMITY,
                a_from_b=SE3(pose[:3, :3].copy(), pose[:3, 3].copy()),
                covariance=near.covariance(row),
            )
        )
    graph.add_edges(edges)
    return edges


def tighten_chain(
    graph: ExperienceGraph, chain: Sequence[int], config: ProximityConfig = DEFAULT_CONFIG
) -> list[Edge]:
    """Sharpen a chain's proximity edges by the tie at its far end, and lay the missing ones.

    Each proximity edge of the chain was predicted from its near end. The far end predicts the same
    transform along other edges, so the two errors are independent, and fusing them by covariance
    distributes the closure along the chain. Then, from the far end on, nodes that were too
    uncertain for dead reckoning are joined; if the robot was lost from the start, all of them.

    Args:
        graph: contains the tie.
        chain: dense indices of the nodes saved since the robot was last localised, in order; the
            last one is tied by a `TIE` or `MATCH` edge.
        config: settings.

    Returns:
        The new and the superseding edges. They are already in the graph; the caller stores them.
    """
    edges = list(_sharpened(graph, chain, config.consistent_chi2))
    graph.add_edges(edges)
    for node in reversed(chain):
        edges += lay_proximity_edges(graph, node, config)
    return edges


def _beside(graph: ExperienceGraph, node: int, config: ProximityConfig) -> Neighbourhood:
    """Nodes near a node, of any heading: chains lead through them too."""
    record = graph.node(node)
    near = graph.neighbourhood(
        node,
        SE3.identity(),
        np.zeros((6, 6)),
        Search(config.reach_m, np.pi, record.session, record.driven_m, config.pass_gap_m),
    )
    return near.rows(np.flatnonzero(near.sigma_m <= config.greatest_sigma_m))


def _passes(
    graph: ExperienceGraph, near: Neighbourhood, gap_m: float
) -> Iterator[NDArray[np.intp]]:
    """Rows of each experience, split by pass."""
    driven, experiences = graph.driven_m_of(near.nodes), graph.experiences_of(near.nodes)
    order = np.lexsort((driven, experiences))
    if len(order) == 0:
        return
    parted = (np.diff(experiences[order]) != 0) | (np.diff(driven[order]) > gap_m)
    yield from np.split(order, np.flatnonzero(parted) + 1)


def _linked_lately(graph: ExperienceGraph, node: int, spacing_m: float) -> set[int]:
    """Nodes near the far ends of the chain's links within the spacing before and after.

    A link to one node of a pass counts for the nodes around it.
    """
    linked: set[int] = set()
    for member in _along_chain(graph, node, spacing_m):
        for edge in graph.edges_of(member):
            if edge.kind in _LINKS:
                a, b = graph.index(edge.a), graph.index(edge.b)
                far = b if a == member else a
                linked.update(_along_chain(graph, far, 2 * spacing_m))
    return linked


def _along_chain(graph: ExperienceGraph, node: int, within_m: float) -> list[int]:
    """The nodes of a node's experience within a driven distance, including itself."""
    from_m = graph.node(node).driven_m
    members, frontier = {node}, [node]
    while frontier:
        here = frontier.pop()
        for edge in graph.edges_of(here):
            if edge.kind is not EdgeKind.ODOMETRY:
                continue
            a, b = graph.index(edge.a), graph.index(edge.b)
            there = b if a == here else a
            if there not in members and abs(graph.node(there).driven_m - from_m) < within_m:
                members.add(there)
                frontier.append(there)
    return list(members)


def _sharpened(
    graph: ExperienceGraph, chain: Sequence[int], consistent_chi2: float
) -> Iterator[Edge]:
    """Each proximity edge of the chain, fused from the predictions of both ends."""
    laid = [
        (edge, graph.index(edge.a), node)
        for node in chain
        for edge in graph.edges_of(node)
        if edge.kind is EdgeKind.PROXIMITY and graph.index(edge.b) == node
    ]
    if not laid:
        return
    # If the chain met itself, nodes before the first of them are on the known side.
    first = min(chain.index(node) for _, _, node in laid)
    newer = set(chain[first:])
    known = [a for _, a, _ in laid]
    near_end = _view_from_end(graph, chain[first], newer, known)
    far_end = _view_from_end(graph, chain[-1], newer, known)
    for edge, a, b in laid:
        if a in newer or not far_end.sees(a, b):
            continue
        if near_end.sees(a, b):
            yield _fused_at_junction(edge, (a, b), near_end, far_end, consistent_chi2)
        else:
            yield _fused(edge, *far_end.predict(a, b), consistent_chi2)


@dataclass(frozen=True, slots=True, eq=False)
class _EndView:
    """Predictions of one end of a chain: through its tie into the map, and along the chain."""

    outward: ChainTree
    inward: ChainTree

    def sees(self, a: int, b: int) -> bool:
        return a in self.outward.row_of and b in self.inward.row_of

    def predict(self, a: int, b: int) -> tuple[SE3, Array]:
        """``a_from_b`` through the chain's end, and its (6, 6) covariance."""
        a_from_end = self.outward.pose(a).inverse()
        end_from_b = self.inward.pose(b)
        error = (self.outward.error(a) + self.inward.error(b)).pivoted(end_from_b.translation)
        return a_from_end @ end_from_b, error.seen_from(a_from_end).covariance()


def _view_from_end(
    graph: ExperienceGraph, end: int, chain: set[int], known: Sequence[int]
) -> _EndView:
    """The view to the known nodes only: the cost depends on the chain, not on the map."""
    outer, inner = [], []
    # An odometry edge at the end joins it to the older part of the same chain.
    for edge, number in graph.numbered_edges_of(end):
        if not _is_inside(graph, number, chain) and edge.kind is not EdgeKind.PROXIMITY:
            outer.append(number)
    for node in chain:
        for edge, number in graph.numbered_edges_of(node):
            if _is_inside(graph, number, chain) and edge.kind is EdgeKind.ODOMETRY:
                inner.append(number)
    members = np.array(sorted(chain), np.int32)
    outward = [node for node in known if node not in chain]
    return _EndView(
        graph.chains_from(
            end,
            goals=outward or [end],
            passage=Passage(np.array(sorted(outer), np.int32), closed=members),
        ),
        graph.chains_from(end, passage=Passage(np.array(sorted(inner), np.int32))),
    )


def _is_inside(graph: ExperienceGraph, edge: int, chain: set[int]) -> bool:
    """Whether both ends of an edge belong to the chain."""
    return chain.issuperset(graph.edge_ends[edge].tolist())


def _fused_at_junction(
    edge: Edge, ends: tuple[int, int], near: _EndView, far: _EndView, consistent_chi2: float
) -> Edge:
    """Fuse where the two ends' chains to node a meet, and continue to a from there.

    Beyond that point they share edges and errors: fused at a, they would wrongly count as
    independent, and the result as too certain.
    """
    a, b = ends
    junction = _junction(near.outward, far.outward, a)
    x_from_b, covariance = near.predict(junction, b)
    at_junction = _fused(
        Edge(edge.a, edge.b, edge.kind, x_from_b, covariance),
        *far.predict(junction, b),
        consistent_chi2,
    )
    if junction == a:
        return at_junction
    a_from_x = near.outward.pose(a).inverse() @ near.outward.pose(junction)
    tail = ChainError(near.outward.error(a).moments - near.outward.error(junction).moments)
    tail_covariance = (
        tail.pivoted(near.outward.pose(a).translation)
        .seen_from(near.outward.pose(a).inverse())
        .covariance()
    )
    return Edge(
        edge.a,
        edge.b,
        edge.kind,
        a_from_x @ at_junction.a_from_b,
        propagate_covariance(a_from_x, tail_covariance, at_junction.covariance),
    )


def _junction(one: ChainTree, other: ChainTree, node: int) -> int:
    """Where the chains of two trees to a node meet; the node itself at the latest."""
    row, other_row = one.row_of[node], other.row_of[node]
    while one.parents[row] >= 0 and other.parents[other_row] >= 0:
        if one.half_edges[row] != other.half_edges[other_row]:
            break
        row, other_row = int(one.parents[row]), int(other.parents[other_row])
    return int(one.nodes[row])


def _fused(
    edge: Edge,
    a_from_b: SE3,
    covariance: Array,
    consistent_chi2: float = DEFAULT_CONFIG.consistent_chi2,
) -> Edge:
    """The edge fused with another estimate, weighted by certainty.

    Contradicting estimates are not averaged, as the average of a right and a wrong pose is wrong:
    the more certain one is kept.
    """
    difference = (a_from_b @ edge.a_from_b.inverse()).log()
    both = edge.covariance + covariance
    try:
        weighted = np.linalg.solve(both, np.column_stack([difference, edge.covariance]))
    except np.linalg.LinAlgError:  # two edges without any uncertainty
        return edge
    if not difference @ weighted[:, 0] <= consistent_chi2:
        surer = np.trace(covariance[:3, :3]) < np.trace(edge.covariance[:3, :3])
        return Edge(edge.a, edge.b, edge.kind, a_from_b, covariance) if surer else edge
    fused = edge.covariance - edge.covariance @ weighted[:, 1:]
    return Edge(
        edge.a,
        edge.b,
        edge.kind,
        SE3.exp(edge.covariance @ weighted[:, 0]) @ edge.a_from_b,
        (fused + fused.T) / 2,
    )


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
