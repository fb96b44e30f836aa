"""Fits of constants, on cases worked by hand."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import write_campaign

from engram.errors import SequenceError
from engram.fleet.download.coverage import BINS, INTERVALS, Weather
from engram.localiser.acceptance import Spread
from engram.localiser.confidence import Evidence, Standing
from engram.ranking.context import Foreseen
from engram.ranking.policies import policy_named
from engram.ranking.recall import RECALL
from engram.testing.contracts import make_context
from engram_lab.fits import recall
from engram_lab.fits.confidence import Row, Rows, fitted, judged, judged_lookalikes, logistic
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
from engram_lab.fits.months import LAPS, measure_laps, month
from engram_lab.studies.drives import campaign_logs
from engram_lab.town.campaigns import Size, campaign_named

RNG = np.random.default_rng(3)


def made(count: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    terms = np.column_stack([np.ones(count), RNG.normal(size=(count, 2))])
    odds = terms @ np.array([1.0, 2.0, -0.5])
    return terms, (RNG.random(count) < 1 / (1 + np.exp(-odds))).astype(float)


def test_weights_of_a_known_law_are_found() -> None:
    assert logistic(*made(), (0, 0, 0)) == pytest.approx([1.0, 2.0, -0.5], abs=0.1)


def test_a_weight_of_the_wrong_sign_is_none() -> None:
    weights = logistic(*made(), (0, 1, 1))
    assert weights[2] == 0
    assert weights[1] > 1.5


def test_a_row_that_counts_twice_is_two_rows() -> None:
    terms, right = made(400)
    twice = logistic(np.vstack([terms, terms[:100]]), np.append(right, right[:100]), (0, 0, 0))
    counts = np.where(np.arange(400) < 100, 2.0, 1.0)
    # The scale by which the prior holds weights back is that of the rows, however often they count.
    assert logistic(terms, right, (0, 0, 0), counts) == pytest.approx(twice, abs=0.02)


def rows(count: int, kind: str, *, right: bool) -> list[Row]:
    """Matches that are read as `kind`; right ones have three times the inliers."""
    made = []
    for inliers in RNG.gamma(9.0, (80 if right else 25) / 9.0, count).astype(int) + 12:
        near, far, sigma_m, off, height = RNG.uniform(0.1, 1.0, 5)
        fixes = {"told": 0, "anywhere": 0}.get(kind, 1 + int(RNG.integers(9)))
        evidence = Evidence(
            int(inliers), inliers / 600, 8 * far, 0.3 * near,
            Standing(fixes, float(RNG.uniform(0, 2)), 60.0),
            math.inf if kind == "anywhere" else sigma_m,
            math.inf if kind == "anywhere" else 2 * off,
            None if kind == "predicted" else Spread(0.5 * near, height, 10.0),
        )  # fmt: skip
        made.append(Row(evidence, 0.1 if right else 30.0, 0.0))
    return made


def test_look_alikes_do_not_make_every_match_less_likely() -> None:
    """Ten times the wrong matches of the same kind: the weights see them, the constant does not."""
    met = []
    for kind in ("predicted", "doubted", "told", "anywhere"):
        met += rows(600, kind, right=True) + rows(200, kind, right=False)
    alike = rows(2_000, "anywhere", right=False) + rows(2_000, "told", right=False)
    plain, with_them = fitted(Rows(met, []), 35), fitted(Rows(met, alike), 35)
    found = rows(20, "anywhere", right=True) + rows(20, "told", right=True)
    for row in found:
        before = max(plain.as_anywhere(row.evidence), plain.as_predicted(row.evidence))
        after = max(with_them.as_anywhere(row.evidence), with_them.as_predicted(row.evidence))
        assert after == pytest.approx(before, abs=2.0)


def test_wrong_matches_are_counted_against_what_is_claimed() -> None:
    """Rows of which a known share is wrong, all of one claim: the report counts them."""
    kinds = ("predicted", "doubted", "told", "anywhere")
    met = [row for kind in kinds for row in rows(300, kind, right=True)]
    met += [row for kind in kinds for row in rows(100, kind, right=False)]
    known = fitted(Rows(met, []), 45)
    same = [Row(met[0].evidence, 30.0 if number < 25 else 0.1, 0.0) for number in range(500)]
    figures = {one.name: one.value for one in judged(known, same, met)}
    claimed = known.as_predicted(met[0].evidence)
    assert figures["  of them wrong"] == 25
    assert figures["  by what is claimed"] == pytest.approx(500 / (1 + math.exp(claimed)))


def test_look_alikes_are_counted_by_what_is_claimed_of_them_and_right_ones_are_not() -> None:
    kinds = ("predicted", "doubted", "told", "anywhere")
    met = [row for kind in kinds for row in rows(300, kind, right=True)]
    met += [row for kind in kinds for row in rows(100, kind, right=False)]
    known = fitted(Rows(met, []), 45)
    strong = max(met, key=lambda row: known.as_predicted(row.evidence)).evidence
    weak = min(met[-100:], key=lambda row: known.as_anywhere(row.evidence)).evidence
    assert known.as_predicted(strong) > 7
    alike = [Row(strong, 80.0, 0.0)] * 3 + [Row(weak, 80.0, 0.0)] * 2 + [Row(strong, 0.1, 0.0)] * 9
    figures = {one.name: one.value for one in judged_lookalikes(known, alike)}
    assert figures["look-alikes judged"] == 5
    assert figures["  believed where fixes lead to expect them"] == 3
    assert figures["  claimed with more than 7"] == 3


def frame(accepted, driven_m: float = 0.0, step_m: float = 1.0, **situation) -> recall.Seen:
    context = make_context(sessions=2, **situation)
    accepted = np.array(accepted)
    return recall.Seen(context, Foreseen(accepted, np.where(accepted, 50, 0)), driven_m, step_m)


def drive(*frames: recall.Seen) -> recall.Recorded:
    return recall.Recorded("made up", frames, sum(one.step_m for one in frames))


def test_the_route_is_missed_where_all_first_picks_fail_and_something_would_match() -> None:
    whole = drive(
        frame([False, False, True], candidates=[0, 1, 2], step_m=3.0),
        frame([False, True, False], candidates=[0, 1, 2]),
        frame([False, False, False], candidates=[0, 1, 2]),
    )
    distance = policy_named("distance")
    assert recall.missed(whole, distance) == pytest.approx(3 / 5)
    assert recall.missed(whole, distance, lanes=1) == pytest.approx(4 / 5)
    assert recall.missed(whole, distance, lanes=3) == 0


def test_a_replayed_policy_learns_from_its_own_picks_alone() -> None:
    ahead = {"candidates": [0, 1], "along_m": [0.0, 0.3]}
    whole = drive(*(frame([False, True], float(k), **ahead) for k in range(4)))
    steps = list(recall.replay(whole, policy_named("bandit"), lanes=1))
    picks = [int(one[2][0]) for one in steps]
    assert picks[0] == 0
    assert picks[-1] == 1
    for number, (_, context, _) in enumerate(steps):
        assert context.run.nodes.tolist() == picks[:number]
        assert context.run.accepted.tolist() == [pick == 1 for pick in picks[:number]]
        assert set(context.observations.nodes.tolist()) == set(picks[:number])
        assert context.reference == (1 if 1 in picks[:number] else None)


def test_the_search_finds_the_least_on_its_grid() -> None:
    target = {name: values[0] for name, values in recall.SEARCHED.items()}

    def cost(constants) -> float:
        return sum((getattr(constants, name) - value) ** 2 for name, value in target.items())

    found = recall.search(cost)
    assert {name: getattr(found, name) for name in target} == target


def test_of_equally_good_constants_those_that_stand_are_kept() -> None:
    assert recall.search(lambda constants: 0.0) == RECALL


def test_chances_come_from_the_odds_that_made_the_outcomes() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(0, 1, 20_000)
    y = rng.random(20_000) < 1 / (1 + np.exp(-(0.6 + 1.8 * x)))
    # Standard errors of about 0.02 at 20,000 outcomes.
    assert recall.logistic(x, y) == pytest.approx((0.6, 1.8), abs=0.08)


def test_the_search_leaves_no_constant_out() -> None:
    fields = {one.name for one in dataclasses.fields(RECALL)}
    assert {*recall.SEARCHED, *recall.CHANCES, *recall.WHEN_LOST, *recall.COUNTED} == fields


REPORTS = Path(__file__).parents[2] / "reports"


def test_the_table_that_ships_is_that_of_the_kept_rows():
    rows = read([REPORTS / "forecast_missions.csv", REPORTS / "forecast_fleet.csv"])
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


def test_the_month_is_begbroke_in_small() -> None:
    campaign = month()
    assert (len(campaign.sessions), campaign.length_m) == (LAPS, 150)
    starts = [plan.start for plan in campaign.sessions]
    assert starts == sorted(set(starts))
    assert 25 < (starts[-1] - starts[0]).days <= 30
    assert len({start.hour for start in starts}) > 12
    assert [plan.number for plan in campaign.sessions] == list(range(LAPS))


@pytest.mark.parametrize("seed", range(1, 6))
def test_the_month_has_every_weather_in_its_share(seed: int) -> None:
    whole = Counter(
        plan.weather for plan in campaign_named("begbroke24h", seed, Size.FULL).sessions
    )
    some = Counter(plan.weather for plan in month(seed).sessions)
    for weather, count in whole.items():
        assert abs(some[weather] - count * LAPS / 140) <= 1.0


@pytest.mark.long
def test_laps_that_look_alike_are_saved_once_and_fail_nowhere(tmp_path: Path) -> None:
    drives = write_campaign(tmp_path, looks=(0,) * 5).drives
    found = measure_laps([drive.path for drive in drives], tmp_path / "work")
    assert found.saved == pytest.approx(0.25, abs=0.05)  # the first of four
    assert found.fails < 0.05
    # 8 m ahead and behind of a road of 24 m, with a node every 1.4 m.
    assert 4 < found.candidates < 13
    assert found.can_succeed > 0.2


@pytest.mark.long
def test_laps_that_all_look_different_are_all_saved_and_fail_everywhere(tmp_path: Path) -> None:
    drives = write_campaign(tmp_path, looks=(0, 1, 2, 3, 4)).drives
    found = measure_laps([drive.path for drive in drives], tmp_path / "work")
    assert found.saved > 0.9
    assert found.fails > 0.9


def test_a_lap_that_is_not_rendered_is_named(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="40 laps are not rendered"):
        measure_laps(campaign_logs(month(), tmp_path), tmp_path)
