"""A position is the mean of a match and of what those before it led to expect."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.builders import TOWN, TOWN_ROAD, drive
from tests.localiser.test_hypotheses import GRAPH, SURE, ahead

from engram.frontend.frame import BRIEF
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.acceptance import Rule
from engram.localiser.confidence import CONFIDENCES
from engram.localiser.localisation import Position
from engram.localiser.tracking import Track, fused
from engram.maps.map import Map
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings

NODE = GRAPH.node(10).id
SMALL = st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6).map(np.array)
SIGMAS = st.lists(st.floats(0.01, 0.5), min_size=6, max_size=6).map(np.array)


def at(metres: float, sigma_m: float = 0.1, node: NodeId = NODE) -> Position:
    return Position(node, ahead(metres), sigma_m**2 * np.eye(6))


def turned(sigmas: np.ndarray, seed: int) -> np.ndarray:
    """A covariance with these standard deviations along axes of its own."""
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(6, 6)))
    return axes @ np.diag(sigmas**2) @ axes.T


def test_what_is_expected_counts_by_half_of_what_it_claims() -> None:
    both = fused(at(1.0), at(1.3), doubt=2.0)
    np.testing.assert_allclose(both.node_from_live.translation, [0, 0, 1.2], atol=1e-12)
    np.testing.assert_allclose(both.covariance, 0.01 * 2 / 3 * np.eye(6), atol=1e-12)


@given(SMALL, SMALL, SIGMAS, SIGMAS, st.floats(1.0, 4.0))
def test_it_is_the_mean_by_information(
    expected: np.ndarray, moved: np.ndarray, p: np.ndarray, r: np.ndarray, doubt: float
) -> None:
    """Against the form in inverse covariances, in the tangent space of what was expected."""
    prior, measured = turned(p, 1), turned(r, 2)
    there = Position(NODE, SE3.exp(expected), prior)
    match = Position(NODE, SE3.exp(moved) @ there.node_from_live, measured)
    both = fused(there, match, doubt)
    covariance = np.linalg.inv(np.linalg.inv(doubt * prior) + np.linalg.inv(measured))
    np.testing.assert_allclose(both.covariance, covariance, rtol=1e-6, atol=1e-12)
    step = (both.node_from_live @ there.node_from_live.inverse()).log()
    np.testing.assert_allclose(step, covariance @ np.linalg.solve(measured, moved), atol=1e-8)


def test_a_robot_that_stands_claims_no_more_than_two_matches() -> None:
    track = Track(GRAPH, 2.0)
    for _ in range(50):
        track.fix(at(1.0), leans=True)
    assert track.best is not None
    np.testing.assert_allclose(track.best.covariance, 0.01 / 2 * np.eye(6), rtol=1e-6)


def test_both_positions_are_carried_on_and_the_measured_one_is_of_the_last_match() -> None:
    track = Track(GRAPH, 2.0)
    track.fix(at(1.0), leans=True)
    track.carry_on(ahead(0.5), SURE)
    track.fix(at(1.8), leans=True)
    track.carry_on(ahead(0.5), SURE)
    assert track.measured is not None
    assert track.best is not None
    assert track.measured.node_from_live.translation[2] == pytest.approx(2.3)
    assert track.best.node_from_live.translation[2] == pytest.approx(2.2, abs=1e-4)
    guess = track.best_after((ahead(1.0), np.eye(6)))
    assert guess is not None
    assert guess.node_from_live.translation[2] == pytest.approx(3.2, abs=1e-4)
    assert guess.sigma_m > track.best.sigma_m
    assert track.best_after(None) is track.best


def test_what_was_expected_is_seen_from_the_node_that_is_matched() -> None:
    track, beside = Track(GRAPH, 2.0), GRAPH.node(12).id
    track.fix(at(1.0), leans=True)
    track.fix(at(-0.7, node=beside), leans=True)
    assert track.best is not None
    assert track.best.node == beside
    assert track.best.node_from_live.translation[2] == pytest.approx(-0.8, abs=1e-3)


def test_what_contradicts_or_is_not_joined_or_not_asked_for_counts_alone() -> None:
    alone = at(5.0)
    for track, leans in ((Track(GRAPH, 2.0), False), (Track(GRAPH, 0.0), True)):
        track.fix(at(1.0), leans=True)
        track.fix(alone, leans=leans)
        assert track.best is alone
    apart = type(GRAPH)()
    for node in (GRAPH.node(9), GRAPH.node(10)):
        apart.add_node(node)
    track = Track(apart, 2.0)
    track.fix(at(1.0, node=GRAPH.node(9).id), leans=True)
    track.fix(alone, leans=True)
    assert track.best is alone
    track.set(None)
    track.carry_on(ahead(1.0), SURE)
    assert track.measured is None
    assert track.best is None


def test_the_mean_is_nearer_to_the_truth_where_errors_are_as_claimed() -> None:
    rng = np.random.default_rng(0)
    track, off = Track(GRAPH, 2.0), []
    moved, drift_m = ahead(0.01), 0.03
    for step in range(1, 400):
        drifted = SE3(np.eye(3), moved.translation + drift_m * rng.normal(size=3))
        track.carry_on(drifted, drift_m**2 * np.eye(6))
        truth = np.array([0.0, 0.0, 0.01 * step])
        match = SE3(np.eye(3), truth + 0.1 * rng.normal(size=3))
        track.fix(Position(NODE, match, 0.1**2 * np.eye(6)), leans=True)
        assert track.best is not None
        off.append([match.translation - truth, track.best.node_from_live.translation - truth])
    alone, both = np.sqrt((np.array(off) ** 2).mean(axis=(0, 2)))
    assert both < 0.8 * alone


@pytest.mark.parametrize(
    ("rule", "weak", "means"),
    [(Rule.CONFIDENCE, True, True), (Rule.CONFIDENCE, False, False), (Rule.INLIERS, True, False)],
)
def test_a_robot_is_told_the_mean_where_matches_are_weak_but_by_the_published_rule(
    town: Path, monkeypatch: pytest.MonkeyPatch, rule: Rule, *, weak: bool, means: bool
) -> None:
    if weak:
        model = replace(CONFIDENCES[BRIEF], weak_inliers=10**6)
        monkeypatch.setitem(CONFIDENCES, BRIEF, model)
    live = drive(TOWN, TOWN_ROAD, seed=1, start_ns=10**15)
    localising = Settings().localiser
    acceptance = replace(localising.acceptance, rule=rule)
    settings = replace(Settings(), localiser=replace(localising, acceptance=acceptance))
    fused_at = []
    with (
        Map.open(town) as opened,
        localiser_in(
            opened, live[0].frame.camera, settings, policy="distance", relocaliser=None
        ) as localiser,
    ):
        localiser.place_at(Position.at(opened.graph.node(0).id))
        robot = Robot(Front(settings), localiser)
        for seen in live:
            found = robot.step(seen.logged)
            assert found.position is not None
            assert found.measured is not None
            matched = [one.position.node_from_live for one in localiser.outcomes if one.accepted]
            assert any(found.measured.node_from_live is pose for pose in matched)
            assert found.node_from_live is found.position.node_from_live
            fused_at.append(found.node_from_live is not found.measured.node_from_live)
    # The first fix confirms what somebody said.
    assert not fused_at[0]
    assert all(fused_at[1:]) if means else not any(fused_at)
