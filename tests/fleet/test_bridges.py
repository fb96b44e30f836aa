"""Bridges keep a download in one piece, and tell the truth about where things are."""

from __future__ import annotations

from itertools import pairwise
from uuid import UUID

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from engram.fleet.download.part import close_gaps
from engram.geometry.se3 import SE3, propagate_covariance
from engram.graph.model import Edge, EdgeKind, NodeId


def node_id(number: int) -> NodeId:
    return NodeId(UUID(int=number + 1))


def random_graph(rng: np.random.Generator) -> tuple[list[SE3], list[Edge]]:
    """Up to 14 nodes at true poses; chains, parallel edges, loose ends, several components."""
    count = int(rng.integers(1, 15))
    poses = [SE3.exp(rng.normal(0, [5, 1, 5, 0.1, 1, 0.1])) for _ in range(count)]
    edges = []
    for _ in range(int(rng.integers(0, 2 * count + 1))):
        a, b = (int(one) for one in rng.integers(0, count, 2))
        if a != b:
            edges.append(true_edge(poses, a, b, rng.choice(list(EdgeKind)), rng))
    return poses, edges


def true_edge(poses, a, b, kind, rng) -> Edge:
    root = rng.normal(0, 0.1, (6, 6))
    return Edge(
        node_id(a), node_id(b), EdgeKind(kind), poses[a].inverse() @ poses[b], root @ root.T
    )


def labels(count: int, edges: list[Edge], numbers: dict[NodeId, int]) -> np.ndarray:
    ends = np.array([(numbers[e.a], numbers[e.b]) for e in edges]).reshape(-1, 2)
    links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    return connected_components(links, directed=False)[1]


def assert_whole(seed: int) -> int:
    """Sent nodes are joined with bridges exactly where the whole graph joins them."""
    rng = np.random.default_rng([7, seed])
    poses, edges = random_graph(rng)
    sent = rng.random(len(poses)) < rng.uniform(0.1, 0.9)
    numbers = {node_id(at): at for at in range(len(poses))}
    bridges = close_gaps(list(numbers), edges, sent)
    kept = [e for e in edges if sent[numbers[e.a]] and sent[numbers[e.b]]]
    whole = labels(len(poses), edges, numbers)[sent]
    part = labels(len(poses), [*kept, *bridges], numbers)[sent]
    assert len(set(zip(whole, part, strict=True))) == len(set(whole)) == len(set(part))
    for bridge in bridges:
        a, b = numbers[bridge.a], numbers[bridge.b]
        assert sent[a]
        assert sent[b]
        assert a != b
        assert bridge.kind is EdgeKind.BRIDGE
        truth = poses[a].inverse() @ poses[b]
        np.testing.assert_allclose(bridge.a_from_b.matrix(), truth.matrix(), atol=1e-9)
        assert np.linalg.eigvalsh(bridge.covariance).min() > -1e-9
    keys = [(b.a, b.b) for b in bridges]
    assert keys == sorted(set(keys))
    return len(bridges)


def test_no_download_falls_into_more_pieces_than_the_centre():
    # With so many graphs some need several bridges, and some none.
    counts = [assert_whole(seed) for seed in range(400)]
    assert min(counts) == 0
    assert max(counts) > 3


@pytest.mark.long
def test_no_download_of_ten_thousand_falls_into_more_pieces():
    for seed in range(10_000):
        assert_whole(seed)


def test_a_bridge_adds_up_the_covariances_of_its_chain():
    rng = np.random.default_rng(0)
    poses = [SE3.exp(rng.normal(0, [2, 1, 2, 0.1, 1, 0.1])) for _ in range(4)]
    chain = [true_edge(poses, a, b, EdgeKind.ODOMETRY, rng) for a, b in ((0, 1), (1, 2), (2, 3))]
    sent = np.array([True, False, False, True])
    (bridge,) = close_gaps([node_id(at) for at in range(4)], chain, sent)
    assert (bridge.a, bridge.b) == (node_id(0), node_id(3))
    expected, a_from_end = chain[0].covariance, chain[0].a_from_b
    for _, edge in pairwise(chain):
        expected = propagate_covariance(a_from_end, expected, edge.covariance)
        a_from_end = a_from_end @ edge.a_from_b
    np.testing.assert_allclose(bridge.covariance, expected, atol=1e-12)
    # Turned round, the same edges say the same.
    turned = []
    for edge in chain:
        adjoint = edge.a_from_b.inverse().adjoint()
        covariance = adjoint @ edge.covariance @ adjoint.T
        turned.append(Edge(edge.b, edge.a, edge.kind, edge.a_from_b.inverse(), covariance))
    (same,) = close_gaps([node_id(at) for at in range(4)], turned, sent)
    np.testing.assert_allclose(same.covariance, expected, atol=1e-12)


def test_the_surer_of_two_ways_is_taken():
    rng = np.random.default_rng(1)
    poses = [SE3.exp(rng.normal(0, [2, 1, 2, 0.1, 1, 0.1])) for _ in range(4)]
    loose = [true_edge(poses, a, b, EdgeKind.PROXIMITY, rng) for a, b in ((0, 1), (1, 3))]
    tight = [
        Edge(e.a, e.b, e.kind, e.a_from_b, e.covariance * 1e-3)
        for e in (true_edge(poses, a, b, EdgeKind.MATCH, rng) for a, b in ((0, 2), (2, 3)))
    ]
    sent = np.array([True, False, False, True])
    (bridge,) = close_gaps([node_id(at) for at in range(4)], [*loose, *tight], sent)
    assert np.trace(bridge.covariance) < 0.1 * np.trace(loose[0].covariance)


def test_two_drives_tied_through_a_third_stay_tied_along_all_their_way():
    """Ladder: drives a and c each matched b, which is left out; b is 1 m beside both."""
    rng = np.random.default_rng(2)
    count = 30
    poses = [
        SE3(np.eye(3), np.array([float(drive), 0.0, float(step)]))
        for drive in range(3)
        for step in range(count)
    ]
    edges = [
        true_edge(poses, drive * count + at, drive * count + at + 1, EdgeKind.ODOMETRY, rng)
        for drive in range(3)
        for at in range(count - 1)
    ]
    edges += [
        true_edge(poses, drive * count + at, count + at, EdgeKind.MATCH, rng)
        for drive in (0, 2)
        for at in range(count)
    ]
    sent = np.repeat([True, False, True], count)
    bridges = close_gaps([node_id(at) for at in range(3 * count)], edges, sent)
    tied = {int(bridge.a) - 1 for bridge in bridges}
    assert max(np.diff(sorted(tied))) <= 3
    assert all(bridge.a_from_b.distance_m < 12 for bridge in bridges)


def test_nothing_left_out_needs_no_bridge():
    poses, edges = random_graph(np.random.default_rng(3))
    ids = [node_id(at) for at in range(len(poses))]
    assert close_gaps(ids, edges, np.ones(len(poses), bool)) == []
    assert close_gaps(ids, edges, np.zeros(len(poses), bool)) == []
