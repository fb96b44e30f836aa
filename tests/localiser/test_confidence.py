"""How sure a match is, and how fixes are checked by fixes."""

from __future__ import annotations

import math
from dataclasses import replace
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.frontend.features import NET
from engram.frontend.frame import BRIEF, DescriptorKind
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.acceptance import Spread
from engram.localiser.confidence import (
    ANYWHERE_TERMS,
    DOUBTED_TERMS,
    PREDICTED_TERMS,
    TOLD_TERMS,
    Evidence,
    Record,
    Standing,
    confidence_of,
)
from engram.localiser.fixes import FixChain
from engram.localiser.localisation import Position

MODEL = confidence_of(BRIEF)
WIDE = Spread(0.5, 0.9, 10.0)
SURE = 1e-6 * np.eye(6)


def evidence(inliers: int = 60, **other: object) -> Evidence:
    standing = Standing(agreed=5, usual_inliers=100.0)
    expected = {"standing": standing, "sigma_m": 0.1, "apart": 0.3}
    return Evidence(inliers, inliers / 500, 2.0, 0.05, **{**expected, **other})


@pytest.mark.parametrize("kind", [BRIEF, NET])
def test_there_is_a_weight_for_each_term(kind: DescriptorKind) -> None:
    model = confidence_of(kind)
    assert len(PREDICTED_TERMS) == len(model.predicted) == len(evidence().predicted_terms())
    assert len(DOUBTED_TERMS) == len(model.doubted) == len(evidence().doubted_terms())
    assert len(TOLD_TERMS) == len(model.told) == len(evidence().told_terms())
    assert len(ANYWHERE_TERMS) == len(model.anywhere) == len(evidence().anywhere_terms())


@given(st.integers(12, 500), st.integers(1, 100))
def test_more_inliers_are_never_less_sure(inliers: int, more: int) -> None:
    for known in (
        {},
        {"spread": WIDE},
        {"spread": WIDE, "standing": Standing()},
    ):
        few, many = (evidence(count, **known) for count in (inliers, inliers + more))
        assert MODEL.as_predicted(many) >= MODEL.as_predicted(few)
        assert MODEL.as_anywhere(many) >= MODEL.as_anywhere(few)


@pytest.mark.parametrize(
    "doubt",
    [
        {"sigma_m": 3.0},
        {"apart": 3.0},
        {"standing": Standing(agreed=5, missed=8.0, usual_inliers=100.0)},
        {"standing": Standing(agreed=5, usual_inliers=600.0)},
    ],
    ids=["vague position", "off the position", "fixes that did not come", "fewer than usual"],
)
def test_what_speaks_against_a_match_lowers_its_confidence(doubt: dict[str, object]) -> None:
    assert MODEL.as_predicted(evidence(**doubt)) < MODEL.as_predicted(evidence())


def test_few_inliers_count_more_where_odometry_tracks_few_too() -> None:
    """Drops on the lens hide landmarks of both; a look-alike far off does not touch odometry."""
    usual = Standing(agreed=5, usual_inliers=100.0)
    rain = replace(usual, tracked=0.4)
    for known in ({}, {"spread": WIDE}):
        dry, wet = (evidence(25, standing=standing, **known) for standing in (usual, rain))
        assert MODEL.as_predicted(wet) > MODEL.as_predicted(dry)


def test_what_odometry_tracks_is_compared_with_the_frames_of_fixes() -> None:
    record = Record()
    for tracked in (200, 300, 400):
        record.begin_frame(tracked)
        record.fixed(80, agrees=True)
    for tracked, share in ((150, 0.5), (900, 1.0), (0, 1.0)):
        record.begin_frame(tracked)
        assert record.standing.tracked == share


def test_a_match_has_only_the_readings_that_fit_it() -> None:
    assert MODEL.as_predicted(evidence(apart=math.inf)) == -math.inf
    assert MODEL.as_anywhere(evidence()) == -math.inf
    assert math.isfinite(MODEL.as_anywhere(evidence(spread=WIDE)))


def test_what_was_only_told_speaks_for_a_match_whose_inliers_spread() -> None:
    told = evidence(standing=Standing())
    low = replace(told, spread=Spread(0.5, 0.04, 10.0))
    assert MODEL.as_predicted(told) == -math.inf
    assert MODEL.as_predicted(low) < MODEL.as_predicted(replace(told, spread=WIDE))
    assert MODEL.as_predicted(low) < MODEL.as_predicted(evidence())


def test_by_itself_a_match_is_not_surer_than_with_the_fixes_before_it() -> None:
    found = evidence(spread=WIDE)
    proved = max(MODEL.as_predicted(found), MODEL.as_anywhere(found))
    assert MODEL.alone(found) <= proved


def test_a_record_counts_agreeing_fixes_and_expects_as_many_as_usual() -> None:
    record = Record()
    for inliers in (80, 100, 120):
        record.fixed(inliers, agrees=True)
    assert record.standing == Standing(agreed=3, missed=0.0, usual_inliers=100.0)
    record.missed()
    before = record.standing.missed
    record.missed()
    assert 0.5 < before < record.standing.missed < 2
    record.fixed(90, agrees=False)
    assert replace(record.standing, usual_inliers=0.0) == Standing(agreed=1)
    record.forget()
    assert record.standing.agreed == 0
    assert record.standing.usual_inliers == 95.0


def at(metres: float) -> Position:
    ahead = SE3(np.eye(3), np.array([0.0, 0.0, metres]))
    return Position(NodeId(UUID(int=1)), ahead, SURE)


def drive(chain: FixChain, metres: float) -> None:
    chain.carry_on(at(metres).node_from_live, SURE)


def test_weak_fixes_are_on_trial_until_they_agree_along_some_way() -> None:
    chain = FixChain(sure_confidence=12.0, settle_after_m=10.0)
    assert chain.begin(1, at(0.0), 5.0) == ()
    drive(chain, 6.0)
    chain.join(2, at(6.0), 6.0)
    assert chain.on_trial
    drive(chain, 5.0)
    chain.join(3, at(11.0), 6.0)
    assert not chain.on_trial
    assert chain.begin(4, at(50.0), 5.0) == ()  # the robot was carried: what was proved stays


def test_what_contradicts_fixes_on_trial_names_them() -> None:
    chain = FixChain(sure_confidence=12.0, settle_after_m=10.0)
    chain.begin(1, at(0.0), 5.0)
    chain.join(2, at(0.5), 6.0)
    assert chain.begin(3, at(30.0), 13.0) == (1, 2)
    assert not chain.on_trial


def test_what_joins_two_parts_of_a_map_has_to_agree_for_longer_however_sure_it_is() -> None:
    chain = FixChain(sure_confidence=12.0, settle_after_m=10.0)
    chain.begin(1, at(0.0), 13.0, joins_after_m=60.0)
    drive(chain, 50.0)
    chain.join(2, at(50.0), 13.0)
    assert chain.on_trial
    drive(chain, 11.0)
    chain.join(3, at(61.0), 6.0)
    assert not chain.on_trial
    for soon in (0.0, 9.0):
        chain.begin(4, at(0.0), 13.0, joins_after_m=soon)
        assert not chain.on_trial


def test_a_trial_ends_where_nothing_comes() -> None:
    chain = FixChain(sure_confidence=12.0, settle_after_m=10.0)
    chain.begin(1, at(0.0), 5.0)
    drive(chain, 5.0)
    assert chain.position is not None
    assert chain.position.node_from_live.distance_m == pytest.approx(5.0)
    drive(chain, 26.0)
    assert not chain.on_trial


@given(st.floats(-30, 30), st.floats(0, 10))
def test_a_calibration_leaves_order_and_what_is_not_believed_as_they_are(
    total: float, more: float
) -> None:
    calibration = confidence_of(BRIEF).calibration
    assert calibration.log_odds(total) <= calibration.log_odds(total + more)
    assert calibration.log_odds(min(total, calibration.knee)) == min(total, calibration.knee)
    assert calibration.log_odds(-math.inf) == -math.inf


def test_beyond_the_limit_of_acceptance_claims_grow_more_slowly() -> None:
    claimed = confidence_of(BRIEF).calibration.log_odds
    assert claimed(5.0) == pytest.approx(4.74, abs=0.005)
    assert claimed(6.0) == pytest.approx(5.39, abs=0.005)
    assert claimed(8.5) == pytest.approx(7.01, abs=0.005)
