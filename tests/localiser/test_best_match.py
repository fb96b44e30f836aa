"""Which of a frame's matches a result is of."""

from uuid import UUID

import numpy as np

from engram.frontend.matching import Match
from engram.geometry import SE3
from engram.graph.model import NodeId
from engram.localiser import Rule
from engram.localiser.attempts import Candidate, Outcome, best_success, outcome_at

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
