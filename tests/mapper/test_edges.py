"""Edges that a live camera measures between nodes."""

import dataclasses

import numpy as np
import pytest
from tests.builders import forward, make_edge

from engram.frontend.matching import Match
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind
from engram.localiser.acceptance import AcceptanceConfig
from engram.localiser.attempts import Candidate, Outcome
from engram.mapper.mapper import match_edges
from engram.testing.contracts import flat_graph


def chain(nodes: int, step_m: float, sigma_m: float, *, broken_at: int = -1) -> ExperienceGraph:
    """Nodes one behind another, each `step_m` ahead of the one before."""
    graph = flat_graph(nodes, 1)
    ids = [node.id for node in graph.nodes]
    for k in range(1, nodes):
        if k != broken_at:
            step = make_edge(ids[k - 1], ids[k], forward(step_m), sigma=(sigma_m, 0.001))
            graph.add_edge(step)
    return graph


def matched(graph: ExperienceGraph, index: int, ahead_m: float, inliers: int) -> Outcome:
    """A match that sees the live camera so far ahead of a node."""
    rows = np.arange(inliers)
    match = Match(forward(ahead_m), np.eye(6) * 0.02**2, inliers, rows, rows)
    candidate = Candidate(index, graph.node(index).id, None, guided=False, row=None)
    return Outcome(candidate, 0, match, accepted=True)


def test_nodes_that_one_frame_matched_are_joined_to_the_best_of_them() -> None:
    graph = chain(5, 1.0, 0.02)
    outcomes = [matched(graph, 1, 1.1, 25), matched(graph, 2, 0.1, 90), matched(graph, 3, -0.9, 40)]
    edges = match_edges(graph, outcomes, AcceptanceConfig())
    ends = [(graph.index(edge.a), graph.index(edge.b)) for edge in edges]
    assert ends == [(2, 3), (2, 1)]
    assert {edge.kind for edge in edges} == {EdgeKind.MATCH}
    np.testing.assert_allclose(edges[0].a_from_b.translation, forward(1.0).translation, atol=1e-12)


@pytest.mark.parametrize(("sigma_m", "laid"), [(0.02, 0), (3.0, 1)])
def test_two_places_that_look_alike_are_not_folded_together(sigma_m: float, laid: int) -> None:
    """Nodes 20 m apart, seen as if 2 m apart: too far, unless nobody knows the way between them."""
    graph = chain(21, 1.0, sigma_m)
    outcomes = [matched(graph, 0, 1.0, 60), matched(graph, 20, -1.0, 30)]
    assert len(match_edges(graph, outcomes, AcceptanceConfig())) == laid


def test_a_match_at_the_same_place_that_looks_the_other_way_is_of_something_else() -> None:
    graph = chain(3, 0.5, 0.02)
    turned = SE3.exp([0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0])
    wrong = matched(graph, 2, 0.0, 30)
    match = dataclasses.replace(wrong.match, reference_from_live=turned)
    wrong = dataclasses.replace(wrong, match=match)
    assert not match_edges(graph, [matched(graph, 0, 1.0, 60), wrong], AcceptanceConfig())


def test_parts_of_the_map_that_nothing_joined_are_joined() -> None:
    graph = chain(10, 1.0, 0.02, broken_at=5)
    outcomes = [matched(graph, 2, 1.0, 60), matched(graph, 7, 1.0, 30)]
    assert len(match_edges(graph, outcomes, AcceptanceConfig())) == 1
