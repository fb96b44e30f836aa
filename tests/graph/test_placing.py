"""The map frame: right to the truth, kept from one revision to the next, robust to wrong edges."""

import numpy as np
import pytest
from tests.builders import covariance_of

from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind
from engram.graph.placing import (
    AdjustConfig,
    Anchored,
    Measured,
    PlacingConfig,
    Poses,
    adjust,
    anchor,
    fit_level,
    place,
    replace_after_removal,
)
from engram.testing.contracts import make_node

SIGMA_M, SIGMA_RAD = 0.01, 0.001


def loop(count: int, radius_m: float = 30.0) -> list[SE3]:
    """Poses of a camera that drives around a circle to the left, in a frame with z up."""
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    poses = []
    for angle in 2 * np.pi * np.arange(count) / count:
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        poses.append(SE3(turn @ level, radius_m * np.array([s, 1 - c, 0.0])))
    return poses


def edge(nodes, truth, a, b, rng, kind=EdgeKind.ODOMETRY) -> Edge:
    noise = SE3.exp(rng.normal(size=6) * ([SIGMA_M] * 3 + [SIGMA_RAD] * 3))
    a_from_b = noise @ truth[a].inverse() @ truth[b]
    return Edge(nodes[a].id, nodes[b].id, kind, a_from_b, covariance_of(SIGMA_M, SIGMA_RAD))


def town(count: int = 60, session: int = 0, closes: bool = True):
    """A circle's truth, its nodes, and the edges that a drive around it measures."""
    rng = np.random.default_rng(session)
    truth, nodes = loop(count), [make_node(session, index) for index in range(count)]
    edges = [edge(nodes, truth, k, k + 1, rng) for k in range(count - 1)]
    if closes:
        edges.append(edge(nodes, truth, count - 1, 0, rng, EdgeKind.MATCH))
    return truth, nodes, edges


def graph_of(nodes, edges) -> ExperienceGraph:
    graph = ExperienceGraph()
    for node in nodes:
        graph.add_node(node)
    graph.add_edges(edges)
    return graph


def placed_by(nodes, poses: Poses):
    return {node.id: poses.pose(at) for at, node in enumerate(nodes)}


def worst_m(poses: Poses, truth) -> float:
    """Largest error after the best turn about the vertical and shift."""
    true = np.array([pose.translation for pose in truth])
    fitted = fit_level(poses.translations, true)
    return float(np.linalg.norm(fitted @ poses.translations - true, axis=1).max())


def test_a_circle_comes_out_round_level_and_along_x():
    truth, nodes, edges = town()
    poses = place(graph_of(nodes, edges), {})
    assert worst_m(poses, truth) < 0.3
    assert np.ptp(poses.translations[:, 2]) < 0.3
    np.testing.assert_allclose(poses.translations[0], 0, atol=1e-9)
    ahead = poses.rotations[0][:, 2]
    assert ahead[0] > 0.99


def test_nodes_keep_their_place_and_new_ones_come_around_them():
    truth, nodes, edges = town(closes=False)
    first = place(graph_of(nodes[:40], edges[:39]), {})
    before = placed_by(nodes[:40], first)
    whole = place(graph_of(nodes, edges), before)
    np.testing.assert_array_equal(whole.translations[:40], first.translations)
    assert worst_m(whole, truth) < 0.5


def test_a_wrong_edge_moves_nothing_that_many_right_ones_hold():
    truth, nodes, edges = town()
    rng = np.random.default_rng(5)
    right = [edge(nodes, truth, k, (k + 7) % 60, rng, EdgeKind.MATCH) for k in range(60)]
    wrong = Edge(nodes[3].id, nodes[33].id, EdgeKind.MATCH, SE3.identity(),
                 covariance_of(SIGMA_M, SIGMA_RAD))  # fmt: skip
    assert worst_m(place(graph_of(nodes, [*edges, *right, wrong]), {}), truth) < 0.3


def test_parts_that_an_edge_joins_come_together_and_the_larger_stays():
    truth, nodes, edges = town(closes=False)
    apart = [one for at, one in enumerate(edges) if at != 39]  # 40 nodes and 20
    first = place(graph_of(nodes, apart), {})
    assert first.translations[40:, 0].min() > first.translations[:40, 0].max()
    joined = place(graph_of(nodes, edges), placed_by(nodes, first))
    np.testing.assert_array_equal(joined.translations[:40], first.translations[:40])
    assert worst_m(joined, truth) < 0.5


def test_a_repair_moves_what_a_wrong_edge_had_misplaced_and_nothing_else():
    truth, nodes, edges = town(closes=False)
    rng = np.random.default_rng(6)
    apart = [one for at, one in enumerate(edges) if at != 39]
    wrong = Edge(nodes[5].id, nodes[45].id, EdgeKind.MATCH, SE3.identity(),
                 covariance_of(SIGMA_M, SIGMA_RAD))  # fmt: skip
    folded = place(graph_of(nodes, [*apart, wrong]), {})
    assert worst_m(folded, truth) > 5
    right = [edge(nodes, truth, 39 - k, 40 + k, rng, EdgeKind.MATCH) for k in range(3)]
    mended = replace_after_removal(graph_of(nodes, [*apart, *right]), placed_by(nodes, folded))
    assert worst_m(mended, truth) < 0.5
    np.testing.assert_array_equal(mended.translations[:40], folded.translations[:40])


def test_anchors_bring_the_map_to_where_it_is_known_to_be():
    truth, nodes, edges = town()
    graph = graph_of(nodes, edges)
    moved = SE3.exp([0, 0, 0, 0, 0, 0.8])
    known = [moved @ pose for pose in truth]
    at = np.arange(0, 60, 6)
    positions = np.array([known[k].translation + np.array([400, 900, np.nan]) for k in at])
    positions[3, :2] += 50  # one is wrong
    anchored = Anchored(at, positions, np.full(len(at), 0.5))
    poses = anchor(graph, placed_by(nodes, place(graph, {})), anchored)
    expected = np.array([pose.translation[:2] + np.array([400, 900]) for pose in known])
    assert np.linalg.norm(poses.translations[:, :2] - expected, axis=1).max() < 0.3


@pytest.mark.parametrize("k", range(6))
def test_jacobians_by_finite_differences(k):
    rng = np.random.default_rng(k)
    poses = Poses.identity(2)
    for at in range(2):
        poses.set(at, SE3.exp(rng.normal(size=6)))
    almost = poses.pose(0).inverse() @ poses.pose(1) @ SE3.exp(1e-4 * rng.normal(size=6))
    one = Edge(make_node(0, 0).id, make_node(0, 1).id, EdgeKind.MATCH, almost, np.eye(6))
    measured = Measured.of([one], np.array([[0, 1]]), AdjustConfig())
    _, by_a, by_b = measured.linearised(poses)
    for end, jacobian in enumerate((by_a, by_b)):
        step = np.zeros((2, 6))
        step[end, k] = 1e-6
        change = (measured.residuals(poses.moved(step)) - measured.residuals(poses)) / 1e-6
        np.testing.assert_allclose(change[0], jacobian[0][:, k], atol=1e-3)


def test_half_of_the_loops_may_be_wrong():
    truth, nodes, edges = town()
    rng = np.random.default_rng(9)
    right = [edge(nodes, truth, k, (k + 5) % 60, rng, EdgeKind.MATCH) for k in range(0, 60, 2)]
    wrong = [
        Edge(nodes[a].id, nodes[(a + 20) % 60].id, EdgeKind.MATCH,
             SE3.exp(rng.normal(size=6) * 0.3), covariance_of(SIGMA_M, SIGMA_RAD))
        for a in range(0, 60, 2)
    ]  # fmt: skip
    graph = graph_of(nodes, [*edges, *right, *wrong])
    start = place(graph_of(nodes, edges), {})
    measured = Measured.of(graph.edges, graph.edge_ends[:, ::-1], AdjustConfig())
    free = np.ones(60, np.bool_)
    free[0] = False
    found = adjust(start, measured, free, AdjustConfig())
    assert (found.weights[:90] > 0.25).all()
    assert (found.weights[90:] < 0.01).all()


def test_nodes_that_nothing_joins_stand_in_a_row_beside_the_rest():
    _, nodes, edges = town()
    alone = [town(session=number)[1][0] for number in (1, 2, 3)]
    graph = graph_of([*nodes, *alone], edges)
    poses = place(graph, {})
    first = len(nodes)
    right_m = poses.translations[:first, 0].max()
    apart_m = PlacingConfig().apart_m
    expected = right_m + apart_m * np.arange(1, 4)
    np.testing.assert_allclose(poses.translations[first:, 0], expected)
    assert not poses.translations[first:, 1:].any()
    # The camera's motion shows that it pitches by a milliradian.
    np.testing.assert_allclose(poses.rotations[first:, :, 2], [[1.0, 0.0, 0.0]] * 3, atol=0.01)


def test_of_many_components_each_is_laid_out_as_if_alone():
    towns = [town(5, session, closes=session % 2 == 0) for session in range(40)]
    nodes = [node for _, some, _ in towns for node in some]
    edges = [one for _, _, some in towns for one in some]
    whole, at = place(graph_of(nodes, edges), {}), 0
    for _, some, own in towns:
        alone = place(graph_of(some, own), {})
        part = whole.some(np.arange(at, at + len(some)))
        # What is up in a camera follows from all of its drives, to the noise of their motion.
        np.testing.assert_allclose(part.rotations, alone.rotations, atol=1e-6)
        shift = part.translations - alone.translations
        np.testing.assert_allclose(shift, np.tile(shift[0], (len(some), 1)), atol=1e-3)
        at += len(some)
    across = whole.translations[:, 0].reshape(40, 5)
    order = np.argsort(across.min(axis=1))
    assert (across.min(axis=1)[order][1:] > across.max(axis=1)[order][:-1]).all()
