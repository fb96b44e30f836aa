"""Proximity edges: what joins experiences that run side by side without matching (SPEC §3.1).

Two experiences that cannot be matched with each other may run in parallel for hundreds of metres. A
robot that is localised in one of them must see the nodes of the other. So while a robot saves nodes
on odometry alone beside known ones, each is joined to them where the dead reckoning puts it, as
uncertain as that is; and when the far end of the chain is tied by a match, the closure is
distributed along the chain.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.geometry import SE3, propagate_covariance
from engram.graph.chain_error import ChainError
from engram.graph.graph import ChainTree, ExperienceGraph
from engram.graph.model import Edge, EdgeKind
from engram.graph.neighbourhood import Neighbourhood, Search

Array = NDArray[np.float64]

_LINKS = frozenset({EdgeKind.PROXIMITY, EdgeKind.MATCH, EdgeKind.TIE})


@dataclass(frozen=True, slots=True)
class ProximityConfig:
    """Settings of `lay_proximity_edges` and `tighten_chain`.

    Raises:
        ConfigError: one is out of its bounds.
    """

    reach_m: Annotated[
        float,
        Meta(
            ge=0,
            description="nodes within this predicted distance are beside, plus two standard "
            "deviations, m: the search radius, so that what a localiser should see is joined",
        ),
    ] = 8.0
    spacing_m: Annotated[
        float,
        Meta(
            ge=0,
            description="a chain is joined to the same experience no more often than this, m; the "
            "margin of the neighbourhood search leaps it",
        ),
    ] = 4.0
    greatest_sigma_m: Annotated[
        float,
        Meta(
            ge=0,
            description="dead reckoning vaguer than this, m, joins nothing: the chain's far end "
            "will tell where it was",
        ),
    ] = 15.0
    pass_gap_m: Annotated[
        float,
        Meta(
            ge=0,
            description="nodes of one experience further apart than this along the drive, m, are "
            "different passes, each joined for itself; own nodes nearer behind are no neighbours. "
            "Source: SPEC §3.1",
        ),
    ] = 30.0
    consistent_chi2: Annotated[
        float,
        Meta(
            gt=0,
            description="two estimates of a transform further apart contradict each other: 99.9 % "
            "of χ² with six degrees of freedom",
        ),
    ] = 22.5

    def __post_init__(self) -> None:
        check_bounds(self)


DEFAULT_CONFIG = ProximityConfig()


def lay_proximity_edges(
    graph: ExperienceGraph, node: int, config: ProximityConfig = DEFAULT_CONFIG
) -> list[Edge]:
    """Join a node to the nearest node of each experience beside it.

    Call it once the node and the edge that chains it to the one before (or ties it) are in the
    graph. The prediction and its uncertainty are the graph's own: they grow along the chain.

    Returns:
        The edges, each from the known node to the given one. They are in the graph already, and
        are to be stored.
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
    """Make use of the tie at the far end of a chain: sharpen its proximity edges, lay the missing.

    Each proximity edge that the chain laid was predicted from its near end. The far end predicts
    the same transform along other edges, so the two errors are independent, and fusing them by
    covariance distributes the closure along the chain: little where one end is near. Then the chain
    is walked from its far end, and what was out of reach of the dead reckoning is joined: all of
    it, where the robot was lost from the start.

    Args:
        graph: with the tie in it.
        chain: dense indices of the nodes saved since the robot was last localised, in order; the
            last one is tied by a `TIE` or `MATCH` edge.
        config: settings.

    Returns:
        The new and the superseding edges. They are in the graph already, and are to be stored.
    """
    edges = list(_sharpened(graph, chain, config.consistent_chi2))
    graph.add_edges(edges)
    for node in reversed(chain):
        edges += lay_proximity_edges(graph, node, config)
    return edges


def _beside(graph: ExperienceGraph, node: int, config: ProximityConfig) -> Neighbourhood:
    """What is beside a node, whichever way it looks: one that looks back is a way on as well."""
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
    """Rows of each experience, parted where it came by more than once."""
    driven = graph.driven_m[near.nodes]
    experiences = graph.experiences[near.nodes]
    order = np.lexsort((driven, experiences))
    if len(order) == 0:
        return
    parted = (np.diff(experiences[order]) != 0) | (np.diff(driven[order]) > gap_m)
    yield from np.split(order, np.flatnonzero(parted) + 1)


def _linked_lately(graph: ExperienceGraph, node: int, spacing_m: float) -> set[int]:
    """Nodes near the far ends of links that the chain has within the spacing before and after.

    A link to one node of a pass counts for the pass's nodes around it.
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
    """The nodes of a node's experience within a distance driven, itself included."""
    driven = graph.driven_m
    members, frontier = {node}, [node]
    while frontier:
        here = frontier.pop()
        for edge in graph.edges_of(here):
            if edge.kind is not EdgeKind.ODOMETRY:
                continue
            a, b = graph.index(edge.a), graph.index(edge.b)
            there = b if a == here else a
            if there not in members and abs(driven[there] - driven[node]) < within_m:
                members.add(there)
                frontier.append(there)
    return list(members)


def _sharpened(
    graph: ExperienceGraph, chain: Sequence[int], consistent_chi2: float
) -> Iterator[Edge]:
    """Each proximity edge that the chain laid, as both of its ends together predict it."""
    laid = [
        (edge, graph.index(edge.a), node)
        for node in chain
        for edge in graph.edges_of(node)
        if edge.kind is EdgeKind.PROXIMITY and graph.index(edge.b) == node
    ]
    if not laid:
        return
    # What was saved before the first of them is on the known side, if the chain met itself.
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
    """What one end of a chain predicts: through its tie into the map, and along the chain."""

    outward: ChainTree
    inward: ChainTree

    def sees(self, a: int, b: int) -> bool:
        return a in self.outward.row_of and b in self.inward.row_of

    def predict(self, a: int, b: int) -> tuple[SE3, Array]:
        """``a_from_b`` by way of the chain's end, and its covariance."""
        a_from_end = self.outward.pose(a).inverse()
        end_from_b = self.inward.pose(b)
        error = (self.outward.error(a) + self.inward.error(b)).pivoted(end_from_b.translation)
        return a_from_end @ end_from_b, error.seen_from(a_from_end).covariance()


def _view_from_end(
    graph: ExperienceGraph, end: int, chain: set[int], known: Sequence[int]
) -> _EndView:
    """The view to the known nodes, no further: the cost follows the chain, not the map."""
    members = np.array(sorted(chain), dtype=np.int32)
    in_chain = np.zeros(len(graph), dtype=bool)
    in_chain[members] = True
    inside = in_chain[graph.edge_ends].sum(axis=1)
    outer = (inside == 0).astype(np.uint8)
    inner = np.zeros_like(outer)
    # An odometry edge at the end joins it to the older part of the same chain.
    for edge, number in graph.numbered_edges_of(end):
        if inside[number] == 1 and edge.kind is not EdgeKind.PROXIMITY:
            outer[number] = 1
    for node in chain:
        for edge, number in graph.numbered_edges_of(node):
            if inside[number] == 2 and edge.kind is EdgeKind.ODOMETRY:
                inner[number] = 1
    outward = [node for node in known if not in_chain[node]]
    return _EndView(
        graph.chains_from(end, goals=outward or [end], usable=outer),
        graph.chains_from(end, usable=inner),
    )


def _fused_at_junction(
    edge: Edge, ends: tuple[int, int], near: _EndView, far: _EndView, consistent_chi2: float
) -> Edge:
    """Fuse where the two ends' chains to node a come together, and go on to a from there.

    From there on they share their edges, and so their errors: fused at a, the two would pass for
    independent and the result for surer than it is.
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
    """Where the chains of two trees to a node come together; the node itself at the latest."""
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
    """The edge moved towards another estimate of it, as far as that is the surer one.

    Estimates that contradict each other are not averaged: somewhere a chain is worse than it
    thinks, and what lies between two wrong places is a third. The surer one stands.
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
