"""Which of a frame's matches a result is of."""

from uuid import UUID

import numpy as np
import pytest

from engram.frontend.matching import Match
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.acceptance import AcceptanceConfig, Prediction, Rule
from engram.localiser.attempts import Candidate, Outcome, outcome_at
from engram.localiser.fixes import best_success, uncontested

NOTHING = np.zeros(0, np.int32)


def node(at: int) -> NodeId:
    return NodeId(UUID(int=1 + at))


def outcome(at: int, inliers: int, confidence: float, *, accepted: bool = True) -> Outcome:
    candidate = Candidate(at, node(at), None, guided=False, row=None)
    match = Match(SE3.identity(), np.eye(6), inliers, NOTHING, NOTHING)
    return Outcome(candidate, at, match, accepted, confidence=confidence)


MANY, SURE = outcome(0, 35, 5.4), outcome(1, 34, 9.0)


def test_the_surest_match_counts_and_by_the_published_rule_the_one_of_most_inliers() -> None:
    assert best_success([MANY, SURE], Rule.CONFIDENCE) is SURE
    assert best_success([MANY, SURE], Rule.INLIERS) is MANY


def test_of_equals_the_best_ranked_counts() -> None:
    twin = outcome(2, 34, 9.0)
    for rule in Rule:
        assert best_success([twin, SURE], rule) is SURE


def test_what_was_not_accepted_never_counts() -> None:
    wrong = outcome(0, 90, 20.0, accepted=False)
    assert best_success([wrong], Rule.CONFIDENCE) is None
    assert best_success([wrong, SURE], Rule.INLIERS) is SURE
    assert outcome_at([wrong, SURE], node(0)) is None


def test_a_result_is_of_the_match_with_its_node() -> None:
    assert outcome_at([MANY, SURE], node(1)) is SURE
    assert outcome_at([MANY, SURE], None) is None


def seen(at: int, inliers: int, *, off_m: float, accepted: bool) -> Outcome:
    """A match of a node at which the robot is expected 2 m ahead; so far off that, sideways."""
    expected = SE3(np.eye(3), np.array([0.0, 0.0, 2.0]))
    candidate = Candidate(at, node(at), Prediction(expected, 0.2, 0.01), guided=True, row=at)
    pose = SE3(np.eye(3), np.array([off_m, 0.0, 2.0]))
    return Outcome(candidate, at, Match(pose, np.eye(6), inliers, NOTHING, NOTHING), accepted)


@pytest.mark.parametrize(
    ("inliers", "off_m", "stays"),
    [(15, 0.1, False), (14, 0.1, True), (15, 0.8, True), (15, -1.3, True)],
    ids=["contests", "too few inliers", "agrees", "further from the prediction"],
)
def test_a_match_falls_to_another_that_lies_nearer_to_the_prediction(
    inliers: int, off_m: float, stays: bool
) -> None:
    one = seen(0, 25, off_m=1.2, accepted=True)
    rival = seen(1, inliers, off_m=off_m, accepted=False)
    judged = uncontested([one, rival], AcceptanceConfig())
    assert [outcome.accepted for outcome in judged] == [stays, False]
    assert judged[1] is rival


def test_what_nothing_predicts_is_not_contested() -> None:
    lost = outcome(0, 25, 7.0)
    rival = seen(1, 25, off_m=0.0, accepted=False)
    assert uncontested([lost, rival], AcceptanceConfig()) == [lost, rival]
