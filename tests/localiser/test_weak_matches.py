"""Weak matches near a position that fixes confirmed: a robot may have been carried elsewhere."""

from __future__ import annotations

from dataclasses import replace
from uuid import UUID

import numpy as np
import pytest
from tests.builders import World, see

from engram.frontend.frame import BRIEF, Frame
from engram.frontend.matching import Match
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.acceptance import AcceptanceConfig, Prediction, Rule, Spread
from engram.localiser.attempts import Attempter, Candidate, Outcome, one_by_one
from engram.localiser.confidence import Standing, confidence_of
from engram.localiser.fixes import LEAST_WEIGHED
from engram.localiser.settings import LocaliserConfig

WORLD = World(40.0)
LIVE, NODE = NodeId(UUID(int=1)), NodeId(UUID(int=2))
WIDE, LOW = Spread(0.5, 0.9, 10.0), Spread(0.2, 0.08, 10.0)
CONFIRMED = Standing(agreed=20, usual_inliers=80.0)


class Matches:
    """One match of so many inliers, where it was expected."""

    def __init__(self, inliers: int, extent: Spread) -> None:
        self._inliers, self._extent = inliers, extent
        self.asked = 0

    matches = one_by_one

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        rows = np.arange(self._inliers, dtype=np.int32)
        return Match(SE3.identity(), 1e-4 * np.eye(6), self._inliers, rows, rows)

    def spread(self, live: Frame, live_id: NodeId, node: NodeId, match: Match) -> Spread:
        self.asked += 1
        return self._extent

    def prefetch(self, nodes: list[NodeId]) -> None:
        raise AssertionError("nothing is announced here")


NEAR = Candidate(
    0, NODE, Prediction(SE3.identity(), 0.1, 0.01), guided=True, row=0, standing=CONFIRMED
)
LOST = Candidate(0, NODE, None, guided=False, row=None)


def attempted(
    matches: Matches, candidate: Candidate = NEAR, config: LocaliserConfig | None = None
) -> Outcome:
    frame = see(WORLD, WORLD.pose_at(5.0), 1)
    attempter = Attempter(None, config or LocaliserConfig(), matches)  # type: ignore[arg-type]
    return attempter.attempt(frame, LIVE, 0, candidate)


@pytest.mark.parametrize("inliers", [20, 25])
def test_a_weak_match_that_lies_low_is_no_fix_even_where_fixes_were(inliers: int) -> None:
    low, wide = (attempted(Matches(inliers, extent)) for extent in (LOW, WIDE))
    assert wide.accepted
    assert not low.accepted
    assert low.confidence < wide.confidence


def test_the_spread_of_a_strong_match_is_not_asked_for() -> None:
    weak = confidence_of(BRIEF).weak_inliers
    for inliers, asked in ((weak - 1, 1), (weak, 0)):
        matches = Matches(inliers, WIDE)
        assert attempted(matches).accepted
        assert matches.asked == asked


def test_a_robot_that_is_lost_for_long_believes_one_match_only_if_it_is_sure() -> None:
    acceptance = LocaliserConfig().acceptance
    found = {}
    for inliers in range(30, 400, 5):
        soon = attempted(Matches(inliers, WIDE), LOST)
        late = attempted(Matches(inliers, WIDE), replace(LOST, lost_long=True))
        assert soon.confidence == late.confidence
        assert soon.accepted == (soon.confidence >= acceptance.min_confidence_lost)
        assert late.accepted == (late.confidence >= acceptance.sure_confidence)
        found[inliers] = soon.accepted, late.accepted
    assert (True, False) in found.values()
    assert (True, True) in found.values()


@pytest.mark.parametrize(("rule", "least"), [(Rule.CONFIDENCE, LEAST_WEIGHED), (Rule.INLIERS, 20)])
def test_fewer_inliers_than_the_rule_weighs_are_no_fix(rule: Rule, least: int) -> None:
    config = LocaliserConfig(acceptance=AcceptanceConfig(rule=rule))
    candidate = replace(NEAR, standing=replace(CONFIRMED, usual_inliers=16.0))
    for inliers, accepted in ((least - 1, False), (least, True)):
        outcome = attempted(Matches(inliers, WIDE), candidate, config)
        assert outcome.accepted is accepted
