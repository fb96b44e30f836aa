"""Runs of look-alikes are told by what matches on the mapped road usually have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as settings_of_tests
from hypothesis import strategies as st
from tests.builders import Copied, Sparse, World, drive, map_simulated

from engram.frontend.frame import Landmarks
from engram.localiser.yardstick import Likeness, LookalikeConfig, Run, unevenness
from engram.maps.map import Map
from engram.robot.front import Front
from engram.robot.localisers import localiser_in
from engram.robot.robot import Robot
from engram.robot.settings import Settings

STREET = Sparse(90.0)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "street.engram"
    map_simulated(path, drive(STREET, np.arange(0.0, 88.0, 0.7)))
    return path


def fixes(path: Path, world: World, **lookalikes: float) -> np.ndarray:
    """Which frames along a street are localised."""
    settings = Settings()
    config = replace(settings.localiser, lookalikes=LookalikeConfig(**lookalikes))
    settings = replace(settings, localiser=config)
    seen = drive(world, np.arange(5.0, 80.0, 0.7), seed=1)
    with (
        Map.open(path) as opened,
        localiser_in(opened, seen[0].frame.camera, settings) as localiser,
    ):
        robot = Robot(Front(settings), localiser)
        return np.array([robot.step(one.logged).localised for one in seen])


def test_a_street_that_shares_a_quarter_of_what_is_seen_is_not_the_mapped_one(
    mapped: Path,
) -> None:
    copy = Copied(STREET, 0.25)
    assert fixes(mapped, copy, doubt=0.0).mean() > 0.5  # they agree with each other
    assert fixes(mapped, copy).mean() < 0.05


def test_the_street_itself_is_localised_from_the_first_frame_on(mapped: Path) -> None:
    assert fixes(mapped, STREET).mean() > 0.97
    assert fixes(mapped, Copied(STREET, 0.8)).mean() > 0.97  # some of it has changed
    assert fixes(mapped, Copied(STREET, 0.35, evenly=True)).mean() > 0.97  # much, everywhere


LOOKALIKE = Likeness(share=float(np.log(0.25)), more_bits=3.0, unevenness=4.0)
USUAL = Likeness(share=float(np.log(0.7)), more_bits=3.0, unevenness=2.0)


def after(*found: Likeness, step_m: float = 2.0, run: Run | None = None, at_m: float = 0.0) -> Run:
    """A run after matches."""
    run = run or Run(LookalikeConfig())
    for number, one in enumerate(found):
        if run.due(at_m + number * step_m):
            run.add(one.alike(), at_m + number * step_m)
    return run


def test_one_lookalike_is_doubted_and_a_run_of_usual_matches_is_believed_again() -> None:
    assert not after(LOOKALIKE).believed
    assert not after(*[LOOKALIKE] * 20).believed
    assert after(USUAL).believed
    assert after(*[LOOKALIKE] * 3, *[USUAL] * 20).proved
    assert not after(*[USUAL] * 3, *[LOOKALIKE] * 40).believed


def test_edges_wait_for_more_than_a_first_match_shows() -> None:
    assert not after(USUAL).proved
    assert after(*[USUAL] * 4).proved
    assert not after(*[replace(USUAL, unevenness=2.8)] * 4).proved


def test_a_robot_that_measured_its_path_from_the_map_needs_no_other_proof() -> None:
    run = Run(LookalikeConfig())
    run.measured()
    assert after(LOOKALIKE, run=run).believed
    assert run.proved
    # Matches that show too little are doubted all the same, however often it measures again.
    assert not after(*[LOOKALIKE] * 20, run=run, at_m=2.0).believed
    run.measured()
    assert not after(USUAL, run=run, at_m=44.0).believed
    # After 31 m without a match it is a run like any other.
    assert after(USUAL, run=run, at_m=75.1).believed
    assert not run.proved


def test_a_run_that_has_shown_enough_is_judged_no_more_until_it_breaks() -> None:
    run = after(*[USUAL] * 12, *[LOOKALIKE] * 40)
    assert run.believed
    assert run.proved
    # Matches from 0 to 102 m, then none for 31 m.
    assert not after(LOOKALIKE, run=run, at_m=133.0).believed
    run = after(*[USUAL] * 12)
    run.begin()
    assert not after(LOOKALIKE, run=run, at_m=24.0).believed


def test_holes_beyond_those_of_copies_are_no_sign_of_one() -> None:
    van_ahead = Likeness(share=float(np.log(0.8)), more_bits=-0.5, unevenness=6.4)
    assert after(van_ahead).believed
    assert van_ahead.alike() == replace(van_ahead, unevenness=3.0).alike()


def test_few_inliers_that_differ_in_many_bits_or_lie_everywhere_are_no_lookalikes() -> None:
    night = replace(LOOKALIKE, more_bits=34.0, unevenness=2.0)
    rain = replace(LOOKALIKE, unevenness=1.0)
    assert after(*[night] * 20).proved
    assert after(*[rain] * 20).believed
    assert after(*[rain] * 60).proved


def landmarks(pixels: np.ndarray, depth_m: np.ndarray) -> Landmarks:
    points = np.column_stack([0 * depth_m, 0 * depth_m, depth_m])
    count = len(pixels)
    return Landmarks(
        pixels.astype(np.float32),
        np.ones(count, np.float32),
        np.ones(count, np.float32),
        points.astype(np.float32),
        np.zeros((count, 32), np.uint8),
        np.zeros(count, np.uint8),
    )


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 0.9))
@settings_of_tests(max_examples=30, deadline=None)
def test_unevenness_is_that_of_chance_where_every_place_loses_alike(
    seed: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    count = 2000
    seen = landmarks(rng.uniform(0, [512, 384], (count, 2)), rng.uniform(2, 60, count))
    usual = np.arange(count, dtype=np.int32)
    evenly = usual[rng.random(count) < share]
    whole_places = usual[seen.pixels[:, 0] < 512 * share]
    assert 0.8 < unevenness(seen, usual, evenly) < 1.2
    assert unevenness(seen, usual, whole_places) > 1.5
    assert unevenness(seen, usual, usual) < 1.2


def test_unevenness_does_not_grow_with_the_number_of_landmarks() -> None:
    rng = np.random.default_rng(5)
    seen = landmarks(rng.uniform(0, [512, 384], (4000, 2)), rng.uniform(2, 60, 4000))
    hits = rng.random(4000) < np.where(seen.pixels[:, 0] < 256, 0.7, 0.3)
    many, few = (
        np.mean([unevenness(seen, rows, rows[hits[rows]]) for rows in thinned])
        for thinned in (
            [rng.choice(4000, count, replace=False).astype(np.int32) for _ in range(60)]
            for count in (1200, 300)
        )
    )
    assert abs(many - few) < 0.15 * few


def test_unevenness_of_nothing_is_less_than_chance() -> None:
    none = np.zeros(0, np.int32)
    assert unevenness(landmarks(np.zeros((0, 2)), np.zeros(0)), none, none) <= 1.0


def test_a_believed_run_is_looked_at_again_after_some_metres_only() -> None:
    run = after(USUAL)
    assert not run.due(1.0)
    assert run.due(2.0)
    assert after(LOOKALIKE).due(0.1)


def test_a_robot_that_meets_a_node_where_it_was_saved_expects_no_more_than_usual_elsewhere(
    tmp_path: Path,
) -> None:
    """A frame shares all its landmarks with the node that it was saved as."""
    seen = drive(World(90.0), np.arange(0.0, 40.0, 1.2))
    path = tmp_path / "street.engram"
    map_simulated(path, seen)
    settings = Settings()
    with (
        Map.open(path) as opened,
        localiser_in(opened, seen[0].frame.camera, settings) as localiser,
    ):
        robot = Robot(Front(settings), localiser)
        inliers = [robot.step(one.logged).inliers for one in seen]
        usual = robot.outcomes[0].candidate.standing.usual_inliers
    assert 0 < usual < 0.9 * np.median(inliers)
