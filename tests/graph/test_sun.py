"""How high the sun stands, against the almanac's formulae of the simulator."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from engram.graph.clock import day_of_year, sun_height_deg
from engram_lab.town.conditions import sun_direction


@pytest.mark.parametrize("latitude_deg", [-50.0, 0.0, 23.4, 51.8, 70.0])
def test_the_height_is_that_of_the_almanac_within_the_equation_of_time(latitude_deg):
    for month in range(1, 13):
        for hour in range(24):
            when = datetime(2026, month, 11, hour, tzinfo=UTC)
            true_deg = np.rad2deg(np.arcsin(sun_direction(when, latitude_deg, 0.0)[2]))
            stamp_ns = int(when.timestamp()) * 1_000_000_000
            found_deg = sun_height_deg(day_of_year(stamp_ns), hour, latitude_deg)
            # The equation of time is up to 16 minutes, 4.1 degrees of the sun's way; the
            # declination is within 1.
            assert found_deg == pytest.approx(true_deg, abs=5.2)


def test_days_of_all_years_are_alike():
    for year in (1970, 2026, 2040):
        when = datetime(year, 1, 1, 12, tzinfo=UTC)
        assert day_of_year(int(when.timestamp()) * 1_000_000_000) == pytest.approx(0.5, abs=1.0)


def test_a_summer_evening_is_day_and_a_winter_evening_night():
    assert sun_height_deg(170, 17.2, 51.8) > 20
    assert sun_height_deg(320, 17.2, 51.8) < -5
