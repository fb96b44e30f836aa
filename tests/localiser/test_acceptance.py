"""When a match is believed."""

import numpy as np
import pytest
from tests.builders import World, see

from engram.frontend.matching import Match
from engram.geometry.se3 import SE3
from engram.localiser.acceptance import (
    AcceptanceConfig,
    Prediction,
    Spread,
    _extent,
    _median,
    accept,
    accept_lost,
    inlier_spread,
    plausible,
)

CONFIG = AcceptanceConfig()
WIDE = Spread(0.5, 0.9, 10.0)


def match(pose: SE3 | None, inliers: int, variance: float = 1e-4) -> Match:
    rows = np.arange(inliers, dtype=np.int32)
    return Match(pose, np.eye(6) * variance if pose else None, inliers, rows, rows)


def prediction(sigma_m: float = 0.0, sigma_yaw_rad: float = 0.0) -> Prediction:
    return Prediction(SE3.exp([0, 0, 5, 0, 0, 0]), sigma_m, sigma_yaw_rad)


def test_no_consensus_is_never_accepted() -> None:
    assert not accept_lost(match(None, 0), lambda: WIDE, CONFIG)
    assert not plausible(match(None, 0), lambda: WIDE, CONFIG)
    assert not accept(match(None, 0), prediction(), CONFIG)


@pytest.mark.parametrize(("inliers", "accepted"), [(19, False), (20, True)])
def test_twenty_inliers_where_it_was_expected(inliers: int, accepted: bool) -> None:
    assert accept(match(SE3.exp([0, 0, 5, 0, 0, 0]), inliers), prediction(), CONFIG) is accepted


@pytest.mark.parametrize(
    ("inliers", "accepted", "waits"),
    [(34, False, False), (35, False, True), (59, False, True), (60, True, True)],
)
def test_a_lost_robot_asks_for_more(inliers: int, accepted: bool, waits: bool) -> None:
    found = match(SE3.identity(), inliers)
    assert accept_lost(found, lambda: WIDE, CONFIG) is accepted
    assert plausible(found, lambda: WIDE, CONFIG) is waits


@pytest.mark.parametrize(
    ("offset_m", "sigma_m", "accepted"),
    [(0.49, 0.0, True), (0.51, 0.0, False), (3.4, 1.0, True), (3.6, 1.0, False)],
)
def test_position_must_agree_within_half_a_metre_and_three_sigma(
    offset_m, sigma_m, accepted
) -> None:
    found = match(SE3.exp([offset_m, 0, 5, 0, 0, 0]), 100)
    assert accept(found, prediction(sigma_m), CONFIG) is accepted


@pytest.mark.parametrize(("sigma_m", "accepted"), [(0.49, True), (0.51, False)])
def test_a_match_that_does_not_know_where_it_is_is_none(sigma_m: float, accepted: bool) -> None:
    found = match(SE3.exp([0, 0, 5, 0, 0, 0]), 100, variance=sigma_m**2 / 3)
    assert accept(found, prediction(10.0), CONFIG) is accepted
    assert accept_lost(found, lambda: WIDE, CONFIG) is accepted
    assert plausible(found, lambda: WIDE, CONFIG) is accepted


@pytest.mark.parametrize(
    ("turn_deg", "sigma_deg", "accepted"),
    [(4.9, 0, True), (5.1, 0, False), (19.9, 5, True), (20.1, 5, False)],
)
def test_heading_must_agree_within_five_degrees_and_three_sigma(
    turn_deg, sigma_deg, accepted
) -> None:
    turned = SE3.exp([0, 0, 5, 0, 0, 0]) @ SE3.exp([0, 0, 0, 0, np.deg2rad(turn_deg), 0])
    expected = prediction(sigma_yaw_rad=float(np.deg2rad(sigma_deg)))
    assert accept(match(turned, 100), expected, CONFIG) is accepted


@pytest.mark.parametrize(
    ("spread", "accepted"),
    [
        (Spread(0.26, 0.41, 10.0), True),
        (Spread(0.24, 0.9, 10.0), False),  # the windows of one house
        (Spread(0.5, 0.39, 10.0), False),  # two parked cars, or the road
    ],
)
def test_a_lost_robot_does_not_believe_a_cluster_nor_what_is_low(spread, accepted) -> None:
    found = match(SE3.identity(), 100)
    assert accept_lost(found, lambda: spread, CONFIG) is accepted
    assert plausible(found, lambda: spread, CONFIG) is accepted


@pytest.mark.parametrize(("distance_m", "accepted"), [(7.9, True), (8.1, False)])
def test_a_lost_robot_is_found_only_near_a_node(distance_m: float, accepted: bool) -> None:
    found = match(SE3.exp([0, 0, distance_m, 0, 0, 0]), 100)
    assert accept_lost(found, lambda: WIDE, CONFIG) is accepted


def test_spread_is_that_of_the_inliers_alone_in_the_poorer_image() -> None:
    world = World(40.0)
    frame = see(world, world.pose_at(5.0), 1)
    everywhere = np.arange(len(frame.landmarks), dtype=np.int32)
    pixels, heights_m = frame.landmarks.pixels, frame.landmarks.points_in_cam[:, 1]
    near_one = np.flatnonzero(np.abs(pixels - pixels[0]).max(axis=1) < 40).astype(np.int32)
    level = np.flatnonzero(np.abs(heights_m - np.median(heights_m)) < 0.3).astype(np.int32)

    def spread(rows: np.ndarray) -> Spread:
        return inlier_spread(Match(SE3.identity(), None, len(rows), rows, rows), frame, frame)

    assert spread(everywhere).image > 0.25
    # At most two sides of 80 px in an image of 480 by 360.
    assert spread(near_one).image <= 80 / np.sqrt(480 * 360)
    assert spread(everywhere).height == pytest.approx(1.0)
    assert spread(level).height <= 0.6 / np.ptp(np.percentile(heights_m, [10, 90]))
    assert inlier_spread(match(None, 0), frame, frame) == Spread(0.0, 0.0, 0.0)


@pytest.mark.parametrize("count", [1, 2, 11, 12, 57, 400])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_extents_and_medians_are_numpys_to_the_bit(count: int, kind: type) -> None:
    rng = np.random.default_rng(count)
    for values in (rng.normal(size=count).astype(kind), rng.normal(size=(count, 2)).astype(kind)):
        low, high = np.percentile(values, [10, 90], axis=0)
        assert np.asarray(_extent(values)).tobytes() == np.asarray(high - low).tobytes()
    assert _median(values[:, 0]) == float(np.median(values[:, 0]))
