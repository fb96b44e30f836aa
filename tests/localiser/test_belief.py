"""Several ambiguous frames together tell where a robot is."""

from itertools import pairwise, product
from uuid import UUID

import numpy as np
import pytest

from engram.geometry.cameras import CameraId
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, NodeId, SessionId
from engram.localiser.relocalisation import BeliefConfig, PlaceBelief

AHEAD = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
SESSION = SessionId(UUID(int=1))


def chains(*lengths: int) -> ExperienceGraph:
    """Straight chains of nodes, one every metre."""
    graph = ExperienceGraph()
    for length in lengths:
        first = len(graph)
        for index in range(first, first + length):
            graph.add_node(node(index))
            if index > first:
                graph.add_edge(edge(index - 1, index))
    return graph


def node(index: int) -> Node:
    return Node(NodeId(UUID(int=100 + index)), SESSION, index, CameraId("c"), float(index))


def edge(a: int, b: int, a_from_b: SE3 = AHEAD) -> Edge:
    return Edge(node(a).id, node(b).id, EdgeKind.ODOMETRY, a_from_b, 1e-4 * np.eye(6))


def looks(places: str, seen: str) -> np.ndarray:
    """Evidence of a frame that looks like all places of one letter."""
    return np.array([1.0 if place == seen else 0.0 for place in places])


def test_frames_that_are_ambiguous_one_by_one_decide_together() -> None:
    #         0    5    10   15
    places = "abcdexbxdcxaxbcxcbax"
    belief = PlaceBelief(chains(len(places)))
    for at in (1, 2, 3):  # b, c, d: each stands elsewhere too, in this order only here
        now = belief.observe(looks(places, places[at]))
        belief.carry_on(AHEAD)
    assert int(now.argmax()) == 3


def test_the_order_of_the_places_counts_not_only_that_they_were_seen() -> None:
    places = "abcxxxxcba"
    belief = PlaceBelief(chains(3, 4, 3))
    for seen in "cba":
        now = belief.observe(looks(places, seen))
        belief.carry_on(AHEAD)
    assert int(now.argmax()) == 9


def test_it_is_the_best_of_all_ways_through_the_graph() -> None:
    graph = chains(4, 3)
    graph.add_edge(edge(1, 5, SE3(np.eye(3), np.array([0.5, 0.0, 0.4]))))
    config = BeliefConfig(leap=1e9)
    rng = np.random.default_rng(0)
    frames = rng.normal(size=(4, len(graph)))
    belief = PlaceBelief(graph, config)
    for evidence in frames:
        now = belief.observe(evidence)
        belief.carry_on(AHEAD)
    scaled = (frames - frames.mean(axis=1, keepdims=True)) / frames.std(axis=1, keepdims=True)
    cost = np.full((len(graph), len(graph)), np.inf)
    np.fill_diagonal(cost, 0.5)  # stayed, though the robot moved a metre
    for one in graph.edges:
        a, b = graph.index(one.a), graph.index(one.b)
        for source, target, offset in (
            (a, b, one.a_from_b.translation),
            (b, a, one.a_from_b.inverse().translation),
        ):
            cost[source, target] = ((offset - AHEAD.translation) ** 2).sum() / 2
    best = np.full(len(graph), -np.inf)
    for way in product(range(len(graph)), repeat=len(frames)):
        score = sum(scaled[t, place] for t, place in enumerate(way))
        score -= sum(cost[a, b] for a, b in pairwise(way))
        best[way[-1]] = max(best[way[-1]], score)
    assert now == pytest.approx(best, abs=1e-9)  # rounding of sums in another order


def test_standing_still_is_no_new_evidence() -> None:
    places = "abcabc"
    once, often = PlaceBelief(chains(6)), PlaceBelief(chains(6))
    first = once.observe(looks(places, "b"))
    for _ in range(5):
        often.observe(looks(places, "b"))
        often.carry_on(SE3.identity())
    once.carry_on(AHEAD)
    often.carry_on(AHEAD)
    flat = np.zeros(6)
    assert often.observe(flat) == pytest.approx(once.observe(flat))
    assert first.argmax() == 1


def test_where_nobody_knows_how_the_robot_moved_only_the_last_frame_counts() -> None:
    belief, fresh = PlaceBelief(chains(6)), PlaceBelief(chains(6))
    belief.observe(looks("abcabc", "a"))
    belief.carry_on(None)
    last = looks("abcabc", "c")
    assert belief.observe(last) == pytest.approx(fresh.observe(last))


def test_a_failed_attempt_speaks_against_its_place() -> None:
    belief = PlaceBelief(chains(3, 3))
    assert belief.observe(looks("abcabc", "b")).argmax() == 1
    belief.refute([1])
    assert belief.observe(looks("abcabc", "b")).argmax() == 4


def test_a_robot_that_was_carried_away_is_believed_elsewhere_in_time() -> None:
    places = "abcdefghijklmnop"
    belief = PlaceBelief(chains(8, 8))
    for seen in "abcdefgh":
        belief.observe(looks(places, seen))
        belief.carry_on(AHEAD)
    for seen in "klmno":
        now = belief.observe(looks(places, seen))
        belief.carry_on(AHEAD)
    assert int(now.argmax()) == places.index("o")


def test_nodes_may_join_the_graph_meanwhile() -> None:
    graph = chains(4)
    belief = PlaceBelief(graph)
    belief.observe(looks("abcd", "b"))
    graph.add_node(node(4))
    graph.add_edge(edge(3, 4))
    belief.carry_on(AHEAD)
    assert belief.observe(looks("abcde", "c")).argmax() == 2
    belief.carry_on(AHEAD)
    assert len(belief.observe(np.zeros(5))) == 5


def test_an_empty_map_is_no_error() -> None:
    belief = PlaceBelief(chains())
    assert len(belief.observe(np.zeros(0))) == 0
    belief.carry_on(AHEAD)
    belief.refute([])


@pytest.mark.parametrize("carried", [5, 100])
def test_of_a_large_graph_the_likeliest_nodes_are_carried(carried: int) -> None:
    graph = chains(30, 20)
    graph.add_edge(edge(3, 40, SE3(np.eye(3), np.array([0.5, 0.0, 0.4]))))
    whole = PlaceBelief(graph)
    large = PlaceBelief(graph, BeliefConfig(most_nodes=10, most_carried=carried))
    rng = np.random.default_rng(1)
    for at in range(4):
        evidence = rng.normal(size=len(graph))
        evidence[7 + at] = 6.0
        expected, found = whole.observe(evidence), large.observe(evidence)
        assert int(found.argmax()) == int(expected.argmax()) == 7 + at
        assert (found <= expected).all()
        if carried > len(graph):
            assert np.array_equal(found, expected)
        whole.carry_on(AHEAD)
        large.carry_on(AHEAD)
