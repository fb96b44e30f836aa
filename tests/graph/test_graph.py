"""The experience graph: building, superseding, searching; the kernel against plain Python."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.builders import covariance_of, forward, make_edge
from tests.reference import graph_search as oracle

from engram.errors import InputError
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import EdgeKind
from engram.graph.neighbourhood import Search, SearchConfig
from engram.testing.contracts import make_node, session_uuid

TIGHT = covariance_of(1e-3, 1e-4)


def chain_graph(count: int, session: int = 0, graph: ExperienceGraph | None = None):
    """Nodes one metre apart along a straight line."""
    graph = ExperienceGraph() if graph is None else graph
    nodes = [make_node(session, i) for i in range(count)]
    for node in nodes:
        graph.add_node(node)
    for a, b in itertools.pairwise(nodes):
        graph.add_edge(make_edge(a.id, b.id, forward(1.0)))
    return graph, nodes


def random_graph(seed: int, nodes: int = 60, extra: int = 60) -> ExperienceGraph:
    """Nodes in a 20 m square, true relative poses, random uncertainties with correlated blocks."""
    rng = np.random.default_rng(seed)
    graph = ExperienceGraph()
    records = [make_node(i % 3, i) for i in range(nodes)]
    poses = [
        SE3.exp([*rng.uniform(-10, 10, 3) * [1, 0.1, 1], 0, rng.uniform(-3, 3), 0]) for _ in records
    ]
    for record in records:
        graph.add_node(record)
    links = [(i, int(rng.integers(0, i))) for i in range(1, nodes - 3)]
    links += [tuple(rng.choice(nodes - 3, 2, replace=False)) for _ in range(extra)]
    for i, j in links:
        root = rng.normal(size=(6, 6)) * np.array([0.1] * 3 + [0.02] * 3)[:, None]
        kind = EdgeKind.ODOMETRY if abs(i - j) == 1 else EdgeKind.PROXIMITY
        edge = make_edge(records[i].id, records[j].id, poses[i].inverse() @ poses[j], kind)
        edge = type(edge)(edge.a, edge.b, kind, edge.a_from_b, root @ root.T)
        graph.add_edge(edge)
    return graph


@given(
    st.integers(0, 2**31),
    st.floats(2, 12),
    st.floats(0.3, 3.2),
    st.floats(0, 6),
    st.floats(0, 2),
    st.floats(0, 10),
)
def test_neighbourhood_equals_plain_python(
    seed, radius_m, gate_rad, margin_m, vague_m, detour_m
) -> None:
    graph = random_graph(seed)
    rng = np.random.default_rng(seed)
    reference_from_live = SE3.exp(rng.normal(size=6) * [1, 0.1, 1, 0.01, 0.3, 0.01])
    root = rng.normal(size=(6, 6)) * 0.03
    found = graph.neighbourhood(
        5, reference_from_live, root @ root.T,
        Search(radius_m, gate_rad, config=SearchConfig(
            margin_m=margin_m, slack_sigmas=0.0, vague_m=vague_m, detour_m=detour_m
        )),
    )  # fmt: skip
    expected = oracle.neighbourhood(
        graph, 5, reference_from_live, root @ root.T,
        radius_m, gate_rad, margin_m, vague_m, detour_m,
    )  # fmt: skip
    assert set(found.nodes.tolist()) == set(expected)
    for row, node in enumerate(found.nodes.tolist()):
        pose, sigma_m, sigma_yaw = expected[node]
        np.testing.assert_allclose(found.node_from_live[row], pose.matrix(), atol=1e-11)
        assert found.distance_m[row] == pytest.approx(pose.distance_m, abs=1e-11)
        assert found.yaw_rad[row] == pytest.approx(pose.yaw_rad, abs=1e-11)
        assert found.along_m[row] == pytest.approx(pose.translation[2], abs=1e-11)
        assert found.across_m[row] == pytest.approx(pose.translation[0], abs=1e-11)
        # Moments lose a few digits to cancellation far from the origin.
        assert found.sigma_m[row] == pytest.approx(sigma_m, rel=1e-6)
        assert found.sigma_yaw_rad[row] == pytest.approx(sigma_yaw, rel=1e-9)


@given(st.integers(0, 2**31))
@settings(max_examples=30)
def test_chains_equal_plain_python(seed) -> None:
    graph = random_graph(seed, nodes=30, extra=20)
    tree = graph.chains_from(3)
    expected = oracle.chains(graph, 3)
    assert tree.nodes.tolist() == list(expected)
    for node, (pose, errors, _) in expected.items():
        np.testing.assert_allclose(tree.pose(node).matrix(), pose.matrix(), atol=1e-11)
        np.testing.assert_allclose(
            tree.error(node).moments[:2],
            [sum(e[0] for e in errors), sum(e[1] for e in errors)],
            rtol=1e-9,
            atol=1e-15,
        )


@given(st.integers(0, 2**31), st.lists(st.integers(0, 29), min_size=1, max_size=6))
@settings(max_examples=30)
def test_a_search_with_goals_is_the_beginning_of_the_whole_search(seed, goals) -> None:
    graph = random_graph(seed, nodes=30, extra=20)
    whole, cut = graph.chains_from(3), graph.chains_from(3, goals=goals)
    reached = [whole.row_of[goal] for goal in goals if goal in whole.row_of]
    rows = len(whole.nodes) if len(reached) < len(goals) else max(reached) + 1
    assert cut.nodes.tolist() == whole.nodes[:rows].tolist()
    np.testing.assert_array_equal(cut.root_from_node, whole.root_from_node[:rows])


def test_shortest_chain_prefers_many_tight_edges_to_one_loose_edge() -> None:
    graph, nodes = chain_graph(10)
    loose = make_edge(nodes[0].id, nodes[9].id, forward(8.0), EdgeKind.PROXIMITY, (2.0, 0.1))
    graph.add_edge(loose)
    assert graph.chains_from(0, goals=[9]).nodes.tolist() == list(range(10))
    pose, _ = graph.predict(0, 9)
    np.testing.assert_allclose(pose.translation, [0, 0, 9], atol=1e-12)


def test_shortest_chain_runs_edges_backwards() -> None:
    graph, _ = chain_graph(5)
    pose, _ = graph.predict(4, 0)
    np.testing.assert_allclose(pose.translation, [0, 0, -4], atol=1e-12)


def test_no_chain_between_components() -> None:
    graph, _ = chain_graph(3)
    chain_graph(3, session=1, graph=graph)
    assert graph.predict(0, 4) is None
    assert graph.components().tolist() == [0, 0, 0, 1, 1, 1]


def test_heading_error_swings_what_lies_far_along_the_chain() -> None:
    # A heading error of 0.01 rad at each of 100 steps: the end is off by 0.01 · sqrt(Σ i²) m.
    graph = ExperienceGraph()
    nodes = [make_node(0, i) for i in range(101)]
    for node in nodes:
        graph.add_node(node)
    for a, b in itertools.pairwise(nodes):
        graph.add_edge(make_edge(a.id, b.id, forward(1.0), sigma=(1e-9, 0.01)))
    near = graph.neighbourhood(100, SE3.identity(), np.zeros((6, 6)), Search(200.0, 3.2))
    far = near.nodes.tolist().index(0)
    assert near.sigma_m[far] == pytest.approx(
        0.01 * np.sqrt(np.sum(np.arange(1, 101) ** 2)), rel=0.02
    )


def test_own_recent_nodes_are_gone_through_but_are_no_candidates() -> None:
    graph, _ = chain_graph(60)
    near = graph.neighbourhood(
        59,
        SE3.identity(),
        TIGHT,
        Search(40.0, 1.0, session_uuid(0), 59.0, config=SearchConfig(slack_sigmas=0.0)),
    )
    assert sorted(near.nodes.tolist()) == list(range(19, 30))


def test_reference_far_behind_does_not_cut_the_search_off() -> None:
    graph, _ = chain_graph(60)
    near = graph.neighbourhood(0, forward(50.0), TIGHT, Search(3.0, 1.0))
    assert {47, 50, 53} <= set(near.nodes.tolist())


def test_a_loop_out_of_the_radius_and_back_is_followed_within_the_margin() -> None:
    # Out 15 m, round, and back beside the start: only the chain joins the two.
    graph = ExperienceGraph()
    steps = [forward(1.0)] * 15 + [forward(1.0, yaw_rad=np.pi / 4)] * 4 + [forward(1.0)] * 15
    nodes = [make_node(0, i) for i in range(len(steps) + 1)]
    for node in nodes:
        graph.add_node(node)
    for (a, b), step in zip(itertools.pairwise(nodes), steps, strict=True):
        graph.add_edge(make_edge(a.id, b.id, step))
    near = graph.neighbourhood(0, SE3.identity(), TIGHT, Search(8.0, 3.2))
    assert len(steps) in near.nodes
    narrow = graph.neighbourhood(
        0, SE3.identity(), TIGHT, Search(8.0, 3.2, config=SearchConfig(margin_m=2.0))
    )
    assert len(steps) not in narrow.nodes


def test_uncertain_candidates_are_kept_though_predicted_just_outside() -> None:
    graph, nodes = chain_graph(2)
    other = make_node(1, 0)
    graph.add_node(other)
    graph.add_edge(make_edge(nodes[0].id, other.id, forward(9.0), EdgeKind.PROXIMITY, (1.0, 0.1)))
    query = {"radius_m": 8.0, "view_gate_rad": 1.0}
    loose = graph.neighbourhood(0, SE3.identity(), TIGHT, Search(**query))
    strictly = SearchConfig(slack_sigmas=0.0)
    strict = graph.neighbourhood(0, SE3.identity(), TIGHT, Search(**query, config=strictly))
    assert 2 in loose.nodes
    assert 2 not in strict.nodes


def test_a_vague_chain_does_not_bring_near_what_is_known_to_be_elsewhere() -> None:
    graph, nodes = chain_graph(40)
    gap = make_edge(nodes[0].id, nodes[35].id, forward(30.0), EdgeKind.PROXIMITY, (15.0, 0.1))
    graph.add_edge(gap)
    query = {"radius_m": 8.0, "view_gate_rad": 1.0}
    direct = SearchConfig(detour_m=0.0)
    taken_in = graph.neighbourhood(0, SE3.identity(), TIGHT, Search(**query, config=direct))
    assert {35, 36}.issubset(taken_in.nodes.tolist())
    near = graph.neighbourhood(0, SE3.identity(), TIGHT, Search(**query))
    assert sorted(near.nodes.tolist()) == list(range(9))


def test_newest_edge_with_the_same_key_counts() -> None:
    graph, nodes = chain_graph(2)
    better = make_edge(nodes[0].id, nodes[1].id, forward(1.25))
    graph.add_edge(better)
    assert list(graph.edges) == [better]
    assert graph.edges_of(0) == [better]
    pose, _ = graph.predict(1, 0)
    np.testing.assert_allclose(pose.translation, [0, 0, -1.25])


def test_experiences_are_chains_of_odometry_edges_within_a_session() -> None:
    graph, first = chain_graph(4)
    _, second = chain_graph(3, session=1, graph=graph)
    graph.add_edge(make_edge(first[3].id, second[0].id, forward(1.0), EdgeKind.TIE))
    labels = graph.experiences.tolist()
    assert len(set(labels[:4])) == 1
    assert len(set(labels[4:])) == 1
    assert labels[0] != labels[4]


@given(st.permutations(range(7)))
def test_experiences_do_not_depend_on_the_order_of_edges(order) -> None:
    graph = ExperienceGraph()
    nodes = [make_node(0, i) for i in range(9)]
    for node in nodes:
        graph.add_node(node)
    for i in order:
        if i != 4:
            graph.add_edge(make_edge(nodes[i].id, nodes[i + 1].id, forward(1.0)))
    labels = graph.experiences
    assert len(set(labels[:5].tolist())) == 1
    assert len(set(labels[5:8].tolist())) == 1
    assert len({int(labels[0]), int(labels[5]), int(labels[8])}) == 3


def test_adding_a_node_again_keeps_its_index() -> None:
    graph, nodes = chain_graph(3)
    assert graph.add_node(nodes[1]) == 1
    assert len(graph) == 3


def test_many_nodes_survive_the_growing_of_the_arrays() -> None:
    graph, nodes = chain_graph(100)
    assert [graph.index(node.id) for node in nodes] == list(range(100))
    assert graph.driven_m.tolist() == [float(i) for i in range(100)]
    words = graph.uuid_words_of(np.array([42], np.int32))[0].tolist()
    assert (words[0] << 64) | words[1] == nodes[42].id.int


def test_edges_to_strangers_and_to_itself_are_refused() -> None:
    graph, nodes = chain_graph(2)
    with pytest.raises(InputError, match="not in the graph"):
        graph.add_edge(make_edge(nodes[0].id, make_node(9, 9).id, forward(1.0)))
    with pytest.raises(InputError, match="both ends"):
        graph.add_edge(make_edge(nodes[0].id, nodes[0].id, forward(1.0)))
    assert len(graph.edges) == 1


def test_a_covariance_that_is_none_is_refused_and_changes_nothing() -> None:
    graph, nodes = chain_graph(2)
    edge = make_edge(nodes[0].id, nodes[1].id, forward(1.0), EdgeKind.MATCH)
    for bad in (np.full((6, 6), np.nan), -np.eye(6), np.eye(3)):
        with pytest.raises(InputError):
            graph.add_edge(type(edge)(edge.a, edge.b, edge.kind, edge.a_from_b, bad))
    assert len(graph.edges) == 1


def test_a_reference_that_is_not_there_is_refused() -> None:
    graph, _ = chain_graph(2)
    for reference in (-1, 2):
        with pytest.raises(ValueError, match="reference"):
            graph.neighbourhood(reference, SE3.identity(), TIGHT, Search(8.0, 1.0))
