"""What the study of conditions counts."""

from __future__ import annotations

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram_lab.studies.conditions import longest_gap_m, small_town


def straight(count: int) -> list[SE3]:
    return [SE3(np.eye(3), np.array([0.0, 0.0, 2.0 * k])) for k in range(count)]


@pytest.mark.parametrize(
    ("localised", "gap_m"), [([], 18.0), ([0, 9], 18.0), ([4], 10.0), (list(range(10)), 2.0)]
)
def test_the_longest_gap_counts_from_the_start_and_to_the_end(
    localised: list[int], gap_m: float
) -> None:
    assert longest_gap_m(straight(10), localised) == pytest.approx(gap_m)


def test_a_small_town_has_a_drive_in_each_condition_with_a_seed_of_its_own() -> None:
    town = small_town(22)
    assert {"clear", "overcast", "fair", "rain", "snow"} == {one.weather for one in town.sessions}
    assert len({one.seed for one in town.sessions}) == len(town.sessions)
    assert [one.start for one in town.sessions] == sorted(one.start for one in town.sessions)
