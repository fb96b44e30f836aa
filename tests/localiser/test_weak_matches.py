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


class Searches(Matches):
    """What a wide search finds, and what a narrow one: so many inliers, so far off."""

    def __init__(self, wide: tuple[int, float], narrow: tuple[int, float]) -> None:
        super().__init__(wide[0], WIDE)
        self._found = {"wide": wide, "narrow": narrow}
        self.made: list[str] = []

    def match(self, live: Frame, live_id: NodeId, node: NodeId, guide: Prediction | None) -> Match:
        config = LocaliserConfig()
        sigmas = None if guide is None else (guide.sigma_m, guide.sigma_yaw_rad)
        narrow = sigmas == (config.narrow_m, config.narrow_rad)
        self.made.append("narrow" if narrow else "wide")
        inliers, off_m = self._found[self.made[-1]]
        rows = np.arange(inliers, dtype=np.int32)
        pose = SE3(np.eye(3), np.array([off_m, 0.0, 0.0]))
        return Match(pose, 1e-4 * np.eye(6), inliers, rows, rows)


EXPECTED = replace(NEAR, prediction=Prediction(SE3.identity(), 0.4, 0.02))


def found(
    searches: Searches, candidate: Candidate = EXPECTED, config: LocaliserConfig | None = None
) -> tuple[int, float]:
    match = attempted(searches, candidate, config).match
    assert match.reference_from_live is not None
    return match.inliers, float(match.reference_from_live.translation[0])


@pytest.mark.parametrize(
    ("wide", "narrow", "better"),
    [
        ((25, 1.2), (25, 0.1), True),
        ((25, 1.2), (31, 0.1), True),
        ((25, 1.2), (24, 0.1), False),
        ((25, 1.2), (40, 1.3), False),
        ((15, 0.2), (21, 0.1), True),
        ((15, 0.2), (14, 0.1), False),
        ((15, 0.9), (21, 0.1), False),
    ],
    ids=["as many", "more", "fewer", "no nearer", "weak: more", "weak: fewer", "weak: elsewhere"],
)
def test_what_is_weak_or_far_from_its_prediction_is_sought_near_it(
    wide: tuple[int, float], narrow: tuple[int, float], better: bool
) -> None:
    searches = Searches(wide, narrow)
    assert found(searches) == (narrow if better else wide)
    assert searches.made == ["wide", "narrow"]


PUBLISHED = LocaliserConfig(acceptance=AcceptanceConfig(rule=Rule.INLIERS))


@pytest.mark.parametrize("config", [PUBLISHED, LocaliserConfig(narrow_m=0.0)], ids=["[L15]", "off"])
def test_the_published_rule_makes_one_search(config: LocaliserConfig) -> None:
    searches = Searches((25, 1.2), (90, 0.0))
    assert found(searches, config=config) == (25, 1.2)
    assert searches.made == ["wide"]


@pytest.mark.parametrize(
    ("wide", "candidate"),
    [
        ((25, 0.4), EXPECTED),
        ((11, 0.4), EXPECTED),
        ((25, 1.2), replace(EXPECTED, standing=Standing())),
        ((25, 1.2), LOST),
    ],
    ids=["near and strong", "of no worth", "unconfirmed", "lost"],
)
def test_one_search_is_enough(wide: tuple[int, float], candidate: Candidate) -> None:
    searches = Searches(wide, (90, 0.0))
    assert found(searches, candidate) == wide
    assert searches.made == ["wide"]
