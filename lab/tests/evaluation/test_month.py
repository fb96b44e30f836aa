"""A fleet's month: what a cap leaves, what is counted, and that a run continues."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from lab.tests.evaluation.campaigns import LOOKS, write_campaign

from engram.maps.map import Map
from engram.robot.settings import RobotOptions, Settings
from engram_lab.studies.month import UNCAPPED, Month, cap_bytes, compared
from engram_lab.studies.plan import Row
from engram_lab.town.campaigns import campaign_named

OPTIONS = RobotOptions(lanes=1, rounds=2, relocaliser="exhaustive", threads=5)


@pytest.fixture(scope="module")
def month(tmp_path_factory) -> Month:
    drives = write_campaign(tmp_path_factory.mktemp("logs"), LOOKS[:3]).drives
    return Month(drives, tmp_path_factory.mktemp("month"), Settings(), OPTIONS, a_day=2)


@pytest.fixture(scope="module")
def whole(month: Month) -> list[Row]:
    return month.rows(UNCAPPED, None)


def test_robots_of_a_day_have_the_map_of_its_morning(month: Month, whole) -> None:
    assert [row["drive"] for row in whole] == [drive.name for drive in month.drives]
    assert [row["day"] for row in whole] == [1, 1, 2]
    first, other, again = whole
    # The second robot's copy was empty, too; in the evening both looks are there.
    assert first["share_not_localised"] > 0.9
    assert other["share_not_localised"] > 0.9
    assert first["nodes"] == other["nodes"] == first["saved"] + other["saved"]
    assert again["share_not_localised"] < 0.5


def test_a_run_continues_where_another_stopped(month: Month, whole, tmp_path: Path) -> None:
    Month(month.drives[:2], tmp_path, month.settings, OPTIONS, a_day=2).rows(UNCAPPED, None)
    resumed = Month(month.drives, tmp_path, month.settings, OPTIONS, a_day=2)
    assert resumed.rows(UNCAPPED, None) == whole


def test_a_record_ahead_of_its_map_does_the_day_again(month: Month, whole, tmp_path: Path) -> None:
    one = Month(month.drives[:2], tmp_path, month.settings, OPTIONS, a_day=2)
    one.rows(UNCAPPED, None)
    evening = (tmp_path / "no-cap.engram").read_bytes()
    both = Month(month.drives, tmp_path, month.settings, OPTIONS, a_day=2)
    both.rows(UNCAPPED, None)
    (tmp_path / "no-cap.engram").write_bytes(evening)
    assert both.rows(UNCAPPED, None) == whole


def test_a_capped_map_keeps_what_it_may_and_erases_the_rest(
    month: Month, whole, tmp_path: Path
) -> None:
    capped = Month(month.drives, tmp_path, month.settings, OPTIONS, a_day=2)
    most_bytes = whole[0]["node_bytes"] // 2
    rows = capped.rows("capped to half of it", most_bytes)
    assert 0 < rows[0]["nodes"] < whole[0]["nodes"]
    assert all(row["node_bytes"] <= most_bytes for row in rows)
    with Map.open(tmp_path / "capped-to-half-of-it.engram") as store:
        assert len(store.load().nodes) == rows[-1]["nodes"]


def row(day: int, nodes: int, arm: str = UNCAPPED, **others: float) -> Row:
    return {
        "arm": arm, "day": day, "nodes": nodes, "node_bytes": 1000 * nodes, "file_bytes": 2e6,
        "driven_m": 100.0, "far_m": 1.0, "share_not_localised": 0.1, "saved": 3,
        **others,
    }  # fmt: skip


def test_the_last_day_is_compared_with_the_tenth_and_what_was_missed_after_it() -> None:
    rows = [
        row(10, 100, share_not_localised=0.9),
        row(11, 110, share_not_localised=0.0),
        row(12, 150, driven_m=300.0, share_not_localised=0.2),
    ]
    (found,) = compared(rows)
    assert (found["nodes after day 10"], found["after day 12"]) == (100, 150)
    assert found["ratio"] == pytest.approx(1.5)
    assert found["route missed after day 10, %"] == pytest.approx(15)
    assert found["P(> 10 m), %"] == pytest.approx(0.5)
    assert cap_bytes(rows, 0.5) == 50_000


def test_a_month_has_ten_robots_a_day_at_all_hours_by_two_cameras() -> None:
    plans = campaign_named("month", seed=7).sessions
    assert set(Counter(plan.start.date() for plan in plans).values()) == {10}
    assert {plan.start.hour for plan in plans} == set(range(24))
    assert Counter(plan.robot for plan in plans) == {"wildcat": 210, "courier": 90}
    assert any(plan.rain_mm_h for plan in plans)
