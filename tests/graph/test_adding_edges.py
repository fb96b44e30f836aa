"""Edges added all at once, by arrays, give the same graph as edges added one by one."""

from dataclasses import replace
from uuid import UUID, uuid5

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.errors import InputError
from engram.geometry.cameras import CameraId
from engram.geometry.se3 import SE3
from engram.graph.graph import EDGE_KINDS, EdgeTable, ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, SessionId, node_id

ARRAYS = ("_first_half", "_next_half", "_target", "_a_from_b", "_errors", "_experiences")


def test_the_uuid_of_a_node_is_by_name_in_its_session() -> None:
    session = SessionId(UUID(int=77))
    assert node_id(session, 123) == uuid5(session, "node:123")
    assert node_id(session, 123).version == 5


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


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**20), st.integers(0, 60))
def test_a_table_is_its_records_added_one_by_one(seed: int, count: int) -> None:
    rng, known = np.random.default_rng(seed), nodes()
    keys = {
        (int(a), int(b), int(rng.integers(len(EDGE_KINDS))))
        for a, b in (rng.choice(len(known), 2, replace=False) for _ in range(count))
    }
    ends = np.array([key[:2] for key in keys], np.int32).reshape(-1, 2)
    roots = rng.normal(size=(len(keys), 6, 6))
    poses = [SE3.exp(rng.normal(size=6)) for _ in keys]
    table = EdgeTable(
        known,
        ends,
        np.array([key[2] for key in keys], np.uint8),
        np.array([np.r_[pose.rotation.ravel(), pose.translation] for pose in poses]).reshape(
            -1, 12
        ),
        roots @ roots.transpose(0, 2, 1),
    )
    together, singly = ExperienceGraph(), ExperienceGraph()
    together.add_nodes(known)
    together.add_edges(table)
    for node in known:
        singly.add_node(node)
    for edge in table:
        singly.add_edge(edge)
    for name in (*ARRAYS, "_node_sessions", "_driven_m", "_uuid_words", "_experience_sizes"):
        np.testing.assert_array_equal(getattr(together, name).rows, getattr(singly, name).rows)
    assert [together.index(node.id) for node in known] == list(range(len(known)))
    for edge in table:
        found = together.find_edge(edge.a, edge.b, edge.kind)
        assert found is not None
        np.testing.assert_array_equal(found.a_from_b.matrix(), edge.a_from_b.matrix())
    if keys:  # a newer edge supersedes one of the table
        newer = replace(table[0], covariance=np.eye(6))
        together.add_edge(newer)
        assert len(together.edges) == len(keys)
        assert together.edges[0] is newer


def test_a_table_with_an_edge_of_one_node_is_refused() -> None:
    known = nodes()
    table = EdgeTable(
        known,
        np.zeros((1, 2), np.int32),
        np.zeros(1, np.uint8),
        np.r_[np.eye(3).ravel(), np.zeros(3)][None],
        np.eye(6)[None],
    )
    graph = ExperienceGraph()
    graph.add_nodes(known)
    with pytest.raises(InputError, match="both ends"):
        graph.add_edges(table)
