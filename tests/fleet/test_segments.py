"""Segments are the chains of odometry, whatever the order of edges ([G16] Algorithm 1)."""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from engram.fleet.merge.replay import string_segments
from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, Node, node_id
from engram.testing.contracts import CAMERA, session_uuid


def make_node(session: int, stamp_ns: int) -> Node:
    drive = session_uuid(session)
    return Node(node_id(drive, stamp_ns), drive, stamp_ns, CAMERA, stamp_ns / 1e9)


def make_edge(a: Node, b: Node, kind: EdgeKind = EdgeKind.ODOMETRY) -> Edge:
    return Edge(a.id, b.id, kind, SE3.identity(), np.eye(6))


@st.composite
def small_graphs(draw) -> tuple[list[Node], list[Edge]]:
    """Nodes of up to three sessions, joined anyhow: branches, loops, against time, twice."""
    nodes = [
        make_node(session, stamp)
        for session in range(draw(st.integers(1, 3)))
        for stamp in draw(st.sets(st.integers(0, 30), min_size=1, max_size=8))
    ]
    pairs = st.tuples(st.integers(0, len(nodes) - 1), st.integers(0, len(nodes) - 1))
    kinds = st.sampled_from([EdgeKind.ODOMETRY] * 4 + list(EdgeKind))
    joined = draw(st.lists(st.tuples(pairs, kinds), max_size=20))
    edges = {(i, j, kind): make_edge(nodes[i], nodes[j], kind) for (i, j), kind in joined if i != j}
    return nodes, list(edges.values())


def brute_force(nodes: list[Node], edges: list[Edge]) -> set[tuple]:
    """Again and again the shortest step that still fits; then chains by walking on."""
    by_id = {node.id: node for node in nodes}
    following: dict = {}
    while True:
        fitting = []
        for edge in edges:
            a, b = sorted((by_id[edge.a], by_id[edge.b]), key=lambda n: (n.stamp_ns, n.id))
            if edge.kind is not EdgeKind.ODOMETRY or a.session != b.session:
                continue
            if a.id not in following and b.id not in following.values():
                fitting.append((b.stamp_ns - a.stamp_ns, a.id, b.id))
        if not fitting:
            break
        _, a_id, b_id = min(fitting)
        following[a_id] = b_id
    chains = set()
    for node in nodes:
        if node.id in following.values():
            continue
        chain = [node.id]
        while chain[-1] in following:
            chain.append(following[chain[-1]])
        chains.add(tuple(chain))
    return chains


@given(small_graphs(), st.randoms(use_true_random=False))
def test_segments_are_those_of_the_brute_force_in_any_order_of_edges(graph, rng: random.Random):
    nodes, edges = graph
    found = string_segments(nodes, edges)
    chains = [tuple(node.id for node in segment.nodes) for segment in found]
    assert set(chains) == brute_force(nodes, edges)
    assert sorted(node for chain in chains for node in chain) == sorted(n.id for n in nodes)
    for segment in found:
        assert len({node.session for node in segment.nodes}) == 1
        stamps = [node.stamp_ns for node in segment.nodes]
        assert stamps == sorted(stamps)
        for edge, a, b in zip(segment.steps, segment.nodes, segment.nodes[1:], strict=False):
            assert {edge.a, edge.b} == {a.id, b.id}
    rng.shuffle(nodes)
    rng.shuffle(edges)
    again = string_segments(nodes, edges)
    assert [tuple(node.id for node in segment.nodes) for segment in again] == chains
    assert [segment.steps for segment in again] == [segment.steps for segment in found]


def test_where_edges_branch_the_smaller_time_step_goes_on():
    a, near, far = make_node(0, 0), make_node(0, 1), make_node(0, 5)
    found = string_segments([far, near, a], [make_edge(a, far), make_edge(a, near)])
    assert [[n.stamp_ns for n in segment.nodes] for segment in found] == [[0, 1], [5]]


def test_a_node_without_odometry_is_a_segment_and_ties_do_not_string():
    a, b = make_node(0, 0), make_node(0, 1)
    found = string_segments([a, b], [make_edge(a, b, EdgeKind.TIE)])
    assert [len(segment.nodes) for segment in found] == [1, 1]


def test_many_edges_in_any_order_take_no_quadratic_time():
    nodes = [make_node(0, stamp) for stamp in range(3000)]
    edges = [make_edge(a, b) for a, b in pairwise(nodes)]
    random.Random(0).shuffle(edges)
    (segment,) = string_segments(nodes, edges)
    assert segment.nodes == tuple(nodes)
