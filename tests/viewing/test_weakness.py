"""Weak spots from above: which nodes lie at them, and in which colours they are drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.test_weak_spots import drive, map_street, remember

from engram.maps.map import Map
from engram.viewing.drawings import GOOD, LOST, map_above
from engram.viewing.weakness import (
    draw_weakness,
    nodes_along,
    places_above,
    verdict,
    weakness_labels,
)
from engram.weak_spots import WeakSpotsConfig, find_weak_spots

_DARK = range(40, 60)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street that ten mornings match whole, and nights but for 20 m of it."""
    path = tmp_path_factory.mktemp("street") / "street.engram"
    with Map.create(path) as store:
        nodes = map_street(store, drive(0, 9.0))
        lit = [at for at in range(len(nodes)) if at not in _DARK]
        for day in range(1, 11):
            remember(store, drive(day, 9.0), nodes, range(len(nodes)))
            remember(store, drive(day, 22.0), nodes, lit)
    return path


def test_the_nodes_of_a_spot_are_those_at_its_places(street: Path) -> None:
    with Map.open(street) as opened:
        found, above = find_weak_spots(opened), map_above(opened)
        places = places_above(found, opened, above)
        along = nodes_along(found.spots[0], found, opened, places)
        driven_m = opened.graph.driven_m[along]
    np.testing.assert_array_equal(np.sort(driven_m), np.array(_DARK))


def test_what_is_missed_most_has_the_colour_of_the_lost(street: Path) -> None:
    with Map.open(street) as opened:
        found, above = find_weak_spots(opened), map_above(opened)
        labels = weakness_labels(found, places_above(found, opened, above))
        figure = draw_weakness(found, opened)
    colours = np.array(labels.colours)[labels.of_node]
    assert set(colours[_DARK]) == {LOST}
    assert GOOD not in colours[_DARK]
    assert LOST not in np.delete(colours, _DARK)
    lost = [line for line in figure.axes[0].lines if line.get_color() == LOST]
    assert sum(len(line.get_xdata()) for line in lost) == len(_DARK)


def test_a_map_without_weak_spots_says_so(street: Path) -> None:
    with Map.open(street) as opened:
        found = find_weak_spots(opened, WeakSpotsConfig(least_percent=100.0))
    assert found.spots == []
    assert verdict(found).startswith("no weak spot is known; ")
