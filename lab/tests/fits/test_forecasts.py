"""Forecasts: the table that ships is that of the kept rows; towns are judged by the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engram.fleet.download.coverage import BINS, INTERVALS, Weather
from engram_lab.fits.forecasts import (
    class_of,
    classes,
    interval,
    judge,
    judge_shipped,
    narrowest,
    read,
    sun_deg,
)

REPORTS = Path(__file__).parents[2] / "reports"


def test_the_table_that_ships_is_that_of_the_kept_rows():
    rows = read([REPORTS / "forecast_missions.csv", REPORTS / "fleet_sessions.csv"])
    found = classes(rows)
    assert len(found) > 10
    for (weather, alike, few, place), towns in found.items():
        shipped = INTERVALS.get((weather, alike, few), (None,) * (len(BINS) - 1))[place]
        ends = interval(towns, few=few)
        assert (shipped is None) is (ends is None), (weather, alike, few, place)
        assert ends is None or shipped == pytest.approx(ends), (weather, alike, few, place)


def test_a_town_is_judged_by_what_the_others_missed(capsys):
    row = {"weather": "fair", "apart_deg": "1.0", "drives": "3", "lost": "0.0"}
    missed = {"a": (0.1, 0.1, 0.1), "b": (0.1, 0.1, 0.1), "c": (0.1, 0.3, 0.3)}
    judge([row | {"town": town, "missed": str(one)} for town in missed for one in missed[town]])
    assert "9 missions, 9 with a promise: 7 of 9 within (77.8%" in capsys.readouterr().out


def test_a_new_town_is_held_against_the_table_that_ships(capsys):
    low, high = INTERVALS[(Weather.DRY, True, True)][1]
    row = {"weather": "fair", "apart_deg": "1.0", "drives": "3", "lost": "0.05", "town": "new"}
    missed = (low, high, high + 0.01, high - 0.01)
    unknown = [row | {"weather": "rain", "missed": "0.5"}]
    judge_shipped([row | {"missed": f"{one}"} for one in missed] + unknown)
    assert "5 missions, 4 with a promise: 3 of 4 within (75.0%" in capsys.readouterr().out
    judge_shipped(unknown)
    assert "1 missions, 0 with a promise: none" in capsys.readouterr().out


def test_towns_that_differ_widen_the_interval_and_one_town_stands_for_itself():
    assert interval({"a": [0.1] * 4}, few=False) is None  # too few missions
    assert interval({"a": [0.1] * 5}, few=True) is None  # too few towns
    assert interval({"a": [0.1] * 5}, few=False) == pytest.approx((0.095, 0.1))
    same, apart = (interval({"a": [0.5] * 3, "b": [other] * 3}, few=True) for other in (0.5, 0.54))
    assert same == pytest.approx((0.495, 0.5))
    assert apart == pytest.approx((0.46, 0.58))  # as far again as the towns lie apart
    assert interval({"a": [0.1] * 3, "b": [0.9] * 3}, few=True) is None


def test_the_narrowest_interval_holds_four_in_five_and_leaves_out_where_few_are():
    assert narrowest([np.array([0.0, 0.0, 0.0, 0.0, 0.3])]) == (0.0, 0.0)
    assert narrowest([np.array([0.0, 0.5, 0.51, 0.52, 0.53])]) == (0.5, 0.53)
    many, few = np.full(100, 0.2), np.array([0.4])  # towns count alike, however many missions
    assert narrowest([many, few]) == (0.2, 0.4)


def test_four_in_five_missions_of_towns_not_met_lie_within():
    """Towns that differ by as much as missions in them: coverage over 400 draws of five towns."""
    rng = np.random.default_rng(0)
    held = []
    for _ in range(400):
        missed = np.clip(0.5 + rng.normal(0, 0.03, (6, 1)) + rng.normal(0, 0.03, (6, 8)), 0, 1)
        ends = interval({str(at): one for at, one in enumerate(missed[:5])}, few=True)
        held.append(np.mean((ends[0] <= missed[5]) & (missed[5] <= ends[1])))
    assert 0.75 < np.mean(held) < 0.88


def test_a_missions_class_is_told_by_weather_light_size_and_loss():
    row = {"weather": "fair", "apart_deg": "1.0", "drives": "3", "lost": "0.2"}
    assert class_of(row) == (Weather.DRY, True, True, 2)
    assert class_of(row | {"weather": "rain", "drives": "28"}) == (Weather.RAIN, True, False, 0)
    assert not class_of(row | {"apart_deg": "16"})[1]


def test_the_sun_of_a_drive_is_told_by_its_name():
    assert sun_deg(Path("000-0714T1200-clear-wildcat.framelog")) == 10.0  # a low sun is enough
    assert sun_deg(Path("003-0715T2330-fair-wildcat.framelog")) == -6.0
