"""Edges added all at once, by arrays, give the same graph as edges added one by one."""

from uuid import UUID

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.geometry import SE3, CameraId
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, SessionId, node_id

ARRAYS = ("_first_half", "_next_half", "_target", "_a_from_b", "_errors", "_experiences")


def nodes() -> list[Node]:
    sessions = [SessionId(UUID(int=k + 1)) for k in range(3)]
    return [
        Node(node_id(session, at), session, at, CameraId("0" * 32), float(at))
        for session in sessions
        for at in range(5)
    ]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**20), st.integers(0, 60), st.booleans())
def test_all_at_once_is_one_by_one(seed: int, count: int, again: bool) -> None:
    rng, known = np.random.default_rng(seed), nodes()
    edges = []
    for _ in range(count):
        a, b = rng.choice(len(known), 2, replace=False)
        root = rng.normal(size=(6, 6))
        covariance = root @ root.T if rng.random() < 0.8 else np.diag([1.0, 0, 0, 1, 1, 1])
        kind = list(EdgeKind)[rng.integers(len(EdgeKind))]
        pose = SE3.exp(rng.normal(size=6))
        edges.append(Edge(known[a].id, known[b].id, kind, pose, covariance))
    if not again:  # each key once: these are linked by arrays
        edges = list({(edge.a, edge.b, edge.kind): edge for edge in edges}.values())
    together, singly = ExperienceGraph(), ExperienceGraph()
    for graph in (together, singly):
        for node in known:
            graph.add_node(node)
    together.add_edges(edges)
    for edge in edges:
        singly.add_edge(edge)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(together, name).rows, getattr(singly, name).rows)
    assert list(together.edges) == list(singly.edges)
    for node in range(len(known)):
        assert together.numbered_edges_of(node) == singly.numbered_edges_of(node)
