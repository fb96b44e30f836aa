"""When a match is believed."""

import numpy as np
import pytest

from engram.frontend.matching import Match
from engram.geometry import SE3
from engram.localiser import AcceptanceConfig, Prediction, accept
from engram.localiser.acceptance import inlier_spread
from synthetic_world import World, see

CONFIG = AcceptanceConfig()


def match(pose: SE3 | None, inliers: int) -> Match:
    rows = np.arange(inliers, dtype=np.int32)
    return Match(pose, np.eye(6) * 1e-4 if pose else None, inliers, rows, rows)


def prediction(sigma_m: float = 0.0, sigma_yaw_rad: float = 0.0) -> Prediction:
    return Prediction(SE3.exp([0, 0, 5, 0, 0, 0]), sigma_m, sigma_yaw_rad)


def test_no_consensus_is_never_accepted() -> None:
    assert not accept(match(None, 0), None, CONFIG)
    assert not accept(match(None, 0), prediction(), CONFIG)


@pytest.mark.parametrize(("inliers", "accepted"), [(19, False), (20, True)])
def test_twenty_inliers_where_it_was_expected(inliers: int, accepted: bool) -> None:
    assert accept(match(SE3.exp([0, 0, 5, 0, 0, 0]), inliers), prediction(), CONFIG) is accepted


@pytest.mark.parametrize(("inliers", "accepted"), [(39, False), (40, True)])
def test_a_lost_robot_asks_for_more(inliers: int, accepted: bool) -> None:
    assert accept(match(SE3.identity(), inliers), None, CONFIG) is accepted


@pytest.mark.parametrize(
    ("offset_m", "sigma_m", "accepted"),
    [(0.99, 0.0, True), (1.01, 0.0, False), (3.9, 1.0, True), (4.1, 1.0, False)],
)
def test_position_must_agree_within_a_metre_and_three_sigma(offset_m, sigma_m, accepted) -> None:
    found = match(SE3.exp([offset_m, 0, 5, 0, 0, 0]), 100)
    assert accept(found, prediction(sigma_m), CONFIG) is accepted


@pytest.mark.parametrize(
    ("turn_deg", "sigma_deg", "accepted"),
    [(9.9, 0, True), (10.1, 0, False), (24.9, 5, True), (25.1, 5, False)],
)
def test_heading_must_agree_within_ten_degrees_and_three_sigma(
    turn_deg, sigma_deg, accepted
) -> None:
    turned = SE3.exp([0, 0, 5, 0, 0, 0]) @ SE3.exp([0, 0, 0, 0, np.deg2rad(turn_deg), 0])
    expected = prediction(sigma_yaw_rad=float(np.deg2rad(sigma_deg)))
    assert accept(match(turned, 100), expected, CONFIG) is accepted


def test_a_lost_robot_does_not_believe_a_cluster() -> None:
    found = match(SE3.identity(), 60)
    assert accept(found, None, CONFIG, spread=0.34)
    assert not accept(found, None, CONFIG, spread=0.32)


def test_a_lost_robot_is_found_only_near_a_node() -> None:
    assert accept(match(SE3.exp([0, 0, 7.9, 0, 0, 0]), 60), None, CONFIG)
    assert not accept(match(SE3.exp([0, 0, 8.1, 0, 0, 0]), 60), None, CONFIG)


def test_spread_is_that_of_the_inliers_alone_in_the_poorer_image() -> None:
    world = World(40.0)
    frame = see(world, world.pose_at(5.0), 1)
    everywhere = np.arange(len(frame.landmarks), dtype=np.int32)
    pixels = frame.landmarks.pixels
    near_one = np.flatnonzero(np.abs(pixels - pixels[0]).max(axis=1) < 60).astype(np.int32)
    whole = Match(SE3.identity(), None, len(everywhere), everywhere, everywhere)
    cluster = Match(SE3.identity(), None, len(near_one), near_one, near_one)
    assert inlier_spread(whole, frame, frame) > 0.45
    assert inlier_spread(cluster, frame, frame) <= 120 / 480
