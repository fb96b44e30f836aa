"""When it rains, and what else conditions are made of."""

from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest

from engram_lab.town.campaigns import Size, campaign_named
from engram_lab.town.conditions import LAMP_POWER, Conditions, Moment
from engram_lab.town.drive import Residual, robot_named
from engram_lab.town.rainfall import Rainfall, rates_exceeded


def test_it_rains_as_often_and_as_hard_as_in_oxford() -> None:
    """ITU-R P.837-7: 5.66 % of the time at all, 1.8 % harder than 1 mm/h, 0.37 % than 4 mm/h."""
    rates = Rainfall(1).rates_mm_h(12 * 100_000)
    for above, share in ((0.0, 0.0566), (1.0, 0.018), (4.0, 0.0037)):
        assert (rates > above).mean() == pytest.approx(share, rel=0.1)
    assert rates_exceeded(np.array([0.018, 0.001, 0.06])) == pytest.approx([1, 9, 0])
    # It comes in spells: five wet minutes are mostly followed by others.
    wet = rates > 0
    assert wet[1:][wet[:-1]].mean() > 0.7


@pytest.mark.parametrize(("size", "fewest", "most"), [(Size.STANDARD, 1, 2), (Size.FULL, 2, 3)])
def test_the_papers_month_is_as_dry_as_theirs(size: Size, fewest: int, most: int) -> None:
    for seed in (1, 4):
        campaign = campaign_named("begbroke24h", seed, size)
        rates = [plan.rain_mm_h for plan in campaign.sessions if plan.rain_mm_h]
        assert fewest <= len(rates) <= most
        assert {plan.weather for plan in campaign.sessions} & {"showers"} == set()
        wet = [plan for plan in campaign.sessions if plan.weather == "rain"]
        assert [plan.rain_mm_h for plan in wet] == rates


def test_a_part_of_a_campaign_has_the_rain_of_the_whole() -> None:
    whole = campaign_named("begbroke24h", 2).sessions
    for plan in campaign_named("begbroke", 2).sessions:
        assert whole[plan.number] == plan


def test_stress_campaigns_are_wet() -> None:
    wet, covered = campaign_named("wet"), campaign_named("covered")
    rates = sorted(plan.rain_mm_h or 0.0 for plan in wet.sessions)
    assert rates[:6] == [0] * 6
    assert rates[6] > 1
    assert rates[-1] > 9
    assert [plan.rain_mm_h for plan in covered.sessions] == [p.rain_mm_h for p in wet.sessions]
    assert all(plan.lens.glass.distance_mm == 40 for plan in covered.sessions)


def moment(hour: float, weather: str = "clear", rate: float | None = None) -> Moment:
    start = datetime(2025, 7, 20, int(hour), round(60 * (hour % 1)), tzinfo=UTC)
    return Conditions(start, weather, 3, rain_mm_h=rate).at(0.0, 0.0)


def test_at_dusk_the_sky_still_outshines_the_lamps_and_at_night_they_it() -> None:
    for hour, sun_deg, brighter in ((20.55, -3, True), (23.0, -16, False)):
        now = moment(hour)
        assert now.lamps_on
        assert now.sun_deg == pytest.approx(sun_deg, abs=0.7)
        below_a_lamp = LAMP_POWER / 5.5**2
        assert (now.sky_power > below_a_lamp) is brighter


def test_an_overcast_sky_has_no_sun_and_rain_is_a_rate() -> None:
    for start_m in range(0, 700, 20):
        conditions = Conditions(datetime(2025, 7, 20, 11, tzinfo=UTC), "overcast", 5)
        assert conditions.at(float(start_m), 0.0).sun_power == 0
    rain = moment(11, "rain", 7.0)
    assert 4 < rain.rain_mm_h < 10
    assert rain.wet == 1
    assert moment(11, "overcast").rain_mm_h == 0


def test_leaves_come_in_spring_and_fall_in_autumn() -> None:
    days = [datetime(2025, month, 25, 12, tzinfo=UTC) for month in range(1, 13)]
    leaves = [Conditions(day, "clear", 0).leaves for day in days]
    seasons = [Conditions(day, "clear", 0).season for day in days]
    assert leaves[0] == leaves[11] == 0 < leaves[3] < leaves[4] == 1 > leaves[9] > 0
    assert seasons == [2, 2, 2, 0, 0, 0, 0, 0, 0, 1, 2, 2]


def test_what_calibration_leaves_is_the_rigs_own_and_small() -> None:
    rigs = [Residual.of_rig("wildcat", seed) for seed in range(200)]
    assert rigs[3] == Residual.of_rig("wildcat", 3) != Residual.of_rig("courier", 3)
    assert np.std([rig.disparity_px for rig in rigs]) == pytest.approx(0.2, rel=0.2)
    assert max(abs(rig.focal - 1) for rig in rigs) < 0.005
    camera = robot_named("wildcat").camera
    for rig, _ in pairwise(rigs):
        assert rig.turn(camera)[1] * camera.fx == pytest.approx(rig.disparity_px)
