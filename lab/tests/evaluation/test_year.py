"""A year in one map: what is forgotten, what is counted, and that a run continues."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from lab.tests.evaluation.campaigns import LOOKS, write_campaign

from engram.maps.map import Map
from engram.robot.settings import RobotOptions, Settings
from engram_lab.studies.year import ARMS, Year, forget_down_to, growth_a_month, quarters
from engram_lab.town.campaigns import campaign_named

OPTIONS = RobotOptions(lanes=1, rounds=2, relocaliser="exhaustive", threads=5)


@pytest.fixture(scope="module")
def year(tmp_path_factory) -> Year:
    drives = write_campaign(tmp_path_factory.mktemp("logs"), LOOKS[:3]).drives
    return Year(drives, tmp_path_factory.mktemp("year"), Settings(), OPTIONS)


@pytest.fixture(scope="module")
def whole(year: Year) -> list:
    return year.rows("everything kept", None)


def test_each_drive_is_mapped_into_the_map_of_those_before_it(year: Year, whole) -> None:
    assert [row["drive"] for row in whole] == [drive.name for drive in year.drives]
    first, other, again = whole
    assert first["saved"] == first["nodes"] > 0
    # Another look is saved; the first one, met again, matches.
    assert other["share_not_localised"] > 0.5 > again["share_not_localised"]
    assert again["nodes"] == first["saved"] + other["saved"] + again["saved"]


def test_a_run_continues_where_another_stopped(year: Year, whole, tmp_path: Path) -> None:
    begun = Year(year.drives[:2], tmp_path, year.settings, OPTIONS)
    assert begun.rows("everything kept", None) == whole[:2]
    resumed = Year(year.drives, tmp_path, year.settings, OPTIONS)
    assert resumed.rows("everything kept", None) == whole


@pytest.mark.parametrize("arm", [name for name, one in ARMS.items() if one is not None])
def test_a_map_that_forgets_holds_what_it_may(year: Year, whole, tmp_path: Path, arm: str) -> None:
    rows = Year(year.drives[:2], tmp_path, year.settings, OPTIONS).rows(arm, 6)
    assert [row["nodes"] for row in rows] == [6, 6]
    assert rows[0]["forgotten"] == whole[0]["saved"] - 6


def test_the_oldest_go_first(year: Year, whole, tmp_path: Path) -> None:
    path = shutil.copy(year.folder / "everything-kept.engram", tmp_path / "m.engram")
    arm = ARMS["half forgotten, oldest"]
    assert arm is not None
    assert forget_down_to(path, 5, arm.kept_first) == whole[-1]["nodes"] - 5
    with Map.open(path) as left, Map.open(year.folder / "everything-kept.engram") as before:
        kept, all_of_them = (
            [one.stamp_ns for one in store.load().nodes] for store in (left, before)
        )
    assert sorted(kept) == sorted(all_of_them)[-5:]


def test_growth_and_quarters_are_of_the_rows() -> None:
    rows = [
        {
            "arm": "everything kept", "driven_m": 100.0, "far_m": 1.0, "share_not_localised": 0.1,
            "saved": 10, "nodes": 100 * 2 ** (week // 13), "size_bytes": 1e6, "forgotten": 0,
            "attempts_per_frame": 2.0,
        }
        for week in range(26)
    ]  # fmt: skip
    first, second = quarters(rows)
    assert (first["weeks"], second["weeks"]) == ("1 to 13", "14 to 26")
    assert first["nodes saved a km"] == pytest.approx(100)
    assert (first["nodes"], second["nodes"]) == (100, 200)
    assert second["P(> 10 m), %"] == pytest.approx(1)
    # Doubled in 13 weeks, which are three months.
    assert growth_a_month(rows) == pytest.approx(100 * (2 ** (1 / 3) - 1))


def test_a_year_meets_every_hour_in_every_season_and_snow_in_winter_alone() -> None:
    plans = campaign_named("year", seed=7).sessions
    assert len(plans) == 52
    for first in range(0, 52, 13):
        assert len({plan.start.hour for plan in plans[first : first + 13]}) == 8
    snowy = {plan.start.month for plan in plans if plan.weather == "snow"}
    assert snowy
    assert snowy <= {12, 1, 2}
