"""Weak matches of a lost robot wait until another one agrees."""

from collections.abc import Sequence
from dataclasses import replace
from uuid import UUID

import numpy as np
import pytest

from engram.frontend.matching import Match
from engram.geometry.cameras import CameraId
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, NodeId, SessionId
from engram.graph.neighbourhood import Neighbourhood, Search
from engram.localiser.acceptance import AcceptanceConfig
from engram.localiser.attempts import Candidate, Outcome
from engram.localiser.fixes import Hypotheses
from engram.localiser.localisation import Position
from engram.localiser.settings import HypothesesConfig

SESSION = SessionId(UUID(int=1))
SURE = 1e-6 * np.eye(6)
NOTHING = np.zeros(0, np.int32)


def ahead(metres: float) -> SE3:
    return SE3(np.eye(3), np.array([0.0, 0.0, metres]))


def road(nodes: int) -> ExperienceGraph:
    """Nodes along a straight road, one every metre."""
    graph = ExperienceGraph()
    for at in range(nodes):
        graph.add_node(Node(NodeId(UUID(int=100 + at)), SESSION, at, CameraId("c"), float(at)))
    for a, b in zip(graph.nodes[:-1], graph.nodes[1:], strict=True):
        graph.add_edge(Edge(a.id, b.id, EdgeKind.ODOMETRY, ahead(1.0), SURE))
    return graph


GRAPH = road(60)


def near(position: Position) -> Neighbourhood:
    return GRAPH.neighbourhood(
        GRAPH.index(position.node),
        position.node_from_live,
        position.covariance,
        Search(radius_m=8.0, view_gate_rad=1.0),
    )


def waiting() -> Hypotheses:
    return Hypotheses(GRAPH, near, AcceptanceConfig())


def seen_from(node: int, metres: float, rank: int = 0, *, lost_long: bool = False) -> Outcome:
    """A plausible match with a node, from so far beyond it."""
    candidate = Candidate(
        node, GRAPH.node(node).id, None, guided=False, row=None, lost_long=lost_long
    )
    match = Match(ahead(metres), SURE, 40, NOTHING, NOTHING)
    return Outcome(candidate, rank, match, accepted=False, plausible=True)


def drive(hypotheses: Hypotheses, metres: float) -> None:
    hypotheses.carry_on(ahead(metres), SURE)


def accepted(outcomes: Sequence[Outcome]) -> list[int]:
    return [outcome.candidate.index for outcome in outcomes if outcome.accepted]


def test_one_weak_match_is_not_believed_and_a_second_one_further_on_is() -> None:
    hypotheses = waiting()
    assert accepted(hypotheses.judge([seen_from(10, 0.5)])) == []
    drive(hypotheses, 5.0)
    assert accepted(hypotheses.judge([seen_from(14, 1.4), seen_from(40, 0.0, rank=1)])) == [14]


def test_what_is_seen_from_the_same_spot_confirms_nothing() -> None:
    hypotheses = waiting()
    hypotheses.judge([seen_from(10, 0.5), seen_from(11, -0.5, rank=1)])
    drive(hypotheses, 1.0)
    assert accepted(hypotheses.judge([seen_from(11, 0.5)])) == []
    drive(hypotheses, 3.5)
    assert accepted(hypotheses.judge([seen_from(14, 1.0)])) == [14]


@pytest.mark.parametrize("node", [12, 40], ids=["too far along", "elsewhere"])
def test_a_match_that_disagrees_waits_itself(node: int) -> None:
    hypotheses = waiting()
    hypotheses.judge([seen_from(10, 0.5)])
    drive(hypotheses, 5.0)
    assert accepted(hypotheses.judge([seen_from(node + 2, 3.9)])) == []
    drive(hypotheses, 5.0)
    assert accepted(hypotheses.judge([seen_from(node + 10, 0.9)])) == [node + 10]


def test_the_nodes_that_would_confirm_it_are_told_nearest_first() -> None:
    hypotheses = waiting()
    assert hypotheses.nodes_near(3) == []
    hypotheses.judge([seen_from(10, 0.2)])
    drive(hypotheses, 3.0)
    assert hypotheses.nodes_near(3) == [13, 14, 12]


@pytest.mark.parametrize(("sigma_m", "believed"), [(0.4, [15]), (1.2, [])])
def test_it_outlives_a_short_gap_and_ends_where_agreement_would_say_nothing(
    sigma_m: float, believed: list[int]
) -> None:
    hypotheses = waiting()
    hypotheses.judge([seen_from(10, 0.5)])
    hypotheses.carry_on(ahead(1.0), np.diag([sigma_m**2] * 3 + [1e-4] * 3))
    drive(hypotheses, 4.0)
    assert accepted(hypotheses.judge([seen_from(15, 0.5)])) == believed


def test_it_is_forgotten_in_time() -> None:
    hypotheses = waiting()
    hypotheses.judge([seen_from(10, 0.5)])
    for _ in range(20):
        drive(hypotheses, 1.0)
    assert hypotheses.nodes_near(3) == []
    assert accepted(hypotheses.judge([seen_from(30, 0.5)])) == []


def test_where_a_match_was_accepted_by_itself_nothing_is_to_do() -> None:
    outcomes = [replace(seen_from(10, 0.5), accepted=True), seen_from(40, 0.0, rank=1)]
    assert waiting().judge(outcomes) is outcomes


def long_lost(every_m: int, length_m: int) -> int | None:
    """The node at which a robot that has long been lost is believed, by a match every so often."""
    hypotheses = waiting()
    for metres in range(0, length_m, every_m):
        if metres:
            drive(hypotheses, float(every_m))
        if found := accepted(hypotheses.judge([seen_from(metres, 0.0, lost_long=True)])):
            return found[0]
    return None


def test_a_robot_that_is_long_lost_is_found_where_matches_agree_along_the_way() -> None:
    needed_m = HypothesesConfig().long_base_line_m
    for every_m in (1, 5, 10):
        found = long_lost(every_m, 59)
        assert found is not None
        assert needed_m <= found < needed_m + every_m
    assert long_lost(5, int(needed_m)) is None
    assert long_lost(20, 59) is None  # each was forgotten before the next


def test_one_sure_match_is_enough_for_it_even_so() -> None:
    sure = replace(seen_from(10, 0.5, lost_long=True), accepted=True)
    assert accepted(waiting().judge([sure])) == [10]
