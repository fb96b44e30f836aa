"""The town stays about as hard as it was calibrated to be."""

import numpy as np
import pytest
from tests.opencv import needs_contrib

from engram_lab.fits import calibration
from engram_lab.fits.calibration import (
    Appearance,
    appearance,
    appearance_table,
    falloff_table,
    inliers_of,
    reference_frames,
    world_hash,
)
from engram_lab.town import textures
from engram_lab.town.rendering import VISITS, Places


@pytest.fixture(scope="module")
def seen() -> Appearance:
    """Five places of a town that the knobs were set on, and the visits that tell most."""
    visits = ("next morning", "an hour later", "night", "overcast")
    return appearance(Places(1, every_m=30.0), visits=visits)


@pytest.mark.long
@needs_contrib
def test_light_costs_inliers_as_it_was_calibrated_to(seen: Appearance) -> None:
    means = {name: counts.mean() for name, counts in seen.inliers.items()}
    # Five places scatter by a fifth around the table of all; a knob that is turned shows.
    assert 450 < seen.corners.mean() < 750
    assert means["next morning"] > 80
    assert 0.45 < means["an hour later"] / means["next morning"] < 0.9
    assert means["overcast"] < 0.35 * means["next morning"]
    assert means["night"] < 5


@pytest.mark.long
@needs_contrib
def test_a_visit_matches_itself_at_every_place() -> None:
    places = Places(1, every_m=75.0)
    frames = reference_frames(places, VISITS["morning"])
    # About half of the corners get a disparity, and each is its own best match.
    assert inliers_of(frames, frames).min() > 150


def test_the_table_pools_places_and_not_towns() -> None:
    names = [name for name in VISITS if name != "morning"]

    def town(places: int, inliers: int) -> Appearance:
        return Appearance(np.full(places, 600), {name: np.full(places, inliers) for name in names})

    rows = appearance_table(Appearance.pooled([town(3, 100), town(1, 0)]))
    by_what = {row.what: row.value for row in rows}
    assert by_what["same hour, next day"] == 75.0
    assert by_what["morning map, overcast"] == 75.0


def test_inliers_ahead_are_compared_with_the_clip() -> None:
    rows = falloff_table({1: 80.0, 6: 40.0}, {1: 100.0, 6: 20.0})
    assert [row.value for row in rows] == [0.8, 2.0]
    assert [row.what for row in rows] == ["1.2 m ahead", "7.2 m ahead"]


def test_the_worlds_hash_follows_what_sets_its_difficulty(monkeypatch) -> None:
    before = world_hash()
    assert world_hash() == before
    monkeypatch.setattr(calibration, "Style", lambda: textures.Style(relief=1.0))
    assert world_hash() != before
