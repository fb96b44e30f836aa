"""Forecasts: the table that ships is that of the kept rows; towns of the fit are not judged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engram.fleet.download.forecast import BINS, INTERVALS, Weather
from engram_lab.fits.forecasts import class_of, interval, read, sun_deg

REPORTS = Path(__file__).parents[2] / "reports"
FITTED = ("trial-standard-seed301", "trial-standard-seed302", "begbroke24h")


def test_the_table_that_ships_is_that_of_the_kept_rows():
    rows = read([REPORTS / "forecast_missions.csv", REPORTS / "fleet_sessions.csv"])
    found: dict = {}
    for row in rows:
        if row["town"].startswith(FITTED):
            towns = found.setdefault(class_of(row), {})
            towns.setdefault(row["town"], []).append(float(row["missed"]))
    assert len(found) > 10
    for (weather, alike, few, place), towns in found.items():
        table = INTERVALS.get((weather, alike, few), (None,) * (len(BINS) - 1))
        expected = interval(towns, few=few)
        if expected is None:
            assert table[place] is None, (weather, alike, few, place)
        else:
            assert table[place] == pytest.approx(expected, abs=0.011), (weather, alike, few, place)


def test_towns_that_differ_widen_the_interval_and_one_town_stands_for_itself():
    assert interval({"a": [0.1] * 4}, few=False) is None  # too few missions
    assert interval({"a": [0.1] * 5}, few=True) is None  # too few towns
    assert interval({"a": [0.1] * 5}, few=False) == pytest.approx((0.1, 0.1))
    same, apart = (interval({"a": [0.5] * 3, "b": [other] * 3}, few=True) for other in (0.5, 0.54))
    assert same == pytest.approx((0.5, 0.5))
    assert apart is not None
    assert np.ptp(apart) > 0.15  # two towns say little about a third
    assert interval({"a": [0.1] * 3, "b": [0.9] * 3}, few=True) is None


def test_a_missions_class_is_told_by_weather_light_size_and_loss():
    row = {"weather": "fair", "apart_deg": "1.0", "drives": "3", "lost": "0.2"}
    assert class_of(row) == (Weather.DRY, True, True, 2)
    assert class_of(row | {"weather": "rain", "drives": "28"}) == (Weather.RAIN, True, False, 0)
    assert not class_of(row | {"apart_deg": "16"})[1]


def test_the_sun_of_a_drive_is_told_by_its_name():
    assert sun_deg(Path("000-0714T1200-clear-wildcat.framelog")) == 10.0  # a low sun is enough
    assert sun_deg(Path("003-0715T2330-fair-wildcat.framelog")) == -6.0
