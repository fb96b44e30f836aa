"""The plan of the town, its buildings and the way through it."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.errors import ConfigError
from engram_lab.town.conditions import WEATHERS, Conditions, sun_direction
from engram_lab.town.drive import driving_line
from engram_lab.town.furniture import wall_pieces
from engram_lab.town.streets import (
    AlterationKind,
    Fronts,
    Unique,
    alterations_on,
    crossing_loops,
    equal_rings,
    loop_of_length,
)
from engram_lab.town.textures import NoiseFields, Style, facade
from engram_lab.town.town import Today, Town, _Side, _slide_m, _TileBuilder


@given(st.floats(100, 8000), st.integers(0, 2**31 - 1))
def test_a_loop_has_about_its_length_and_goes_from_junction_to_junction(
    length_m: float, seed: int
) -> None:
    plan, route = loop_of_length(length_m, seed)
    assert plan.spacing_m * len(route.junctions) == pytest.approx(length_m)
    assert len(set(route.junctions)) == len(route.junctions)
    for (i, j), (k, m) in route.streets():
        assert abs(i - k) + abs(j - m) == 1


def test_the_drive_is_as_long_as_asked_within_what_corners_and_bends_take() -> None:
    for length_m, tolerance in ((150, 0.2), (700, 0.12), (3000, 0.12)):
        plan, route = loop_of_length(length_m, 1)
        for reverse in (False, True):
            line = driving_line(plan, route, reverse)
            assert line.length_m == pytest.approx(length_m, rel=tolerance)


def test_crossing_loops_pass_streets_more_than_once() -> None:
    plan, route = crossing_loops(2200, 1)
    streets = list(route.streets())
    assert len(set(streets)) < len(streets)
    assert driving_line(plan, route, False).length_m == pytest.approx(2200, rel=0.12)


def test_lengths_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="100 to 8000"):
        loop_of_length(20, 1)
    with pytest.raises(ConfigError, match="600 to 8000"):
        crossing_loops(300, 1)


def test_the_line_stays_between_the_kerbs_and_turns_gently() -> None:
    plan, route = loop_of_length(700, 5)
    line = driving_line(plan, route, False)
    headings = np.unwrap([line.at(s)[1] for s in np.arange(0, line.length_m, 0.7)])
    assert np.abs(np.diff(headings)).max() < np.radians(12)
    kerbs = [plan.block_outline(block, 0.0) for block in {(0, 0), (0, -1), (-1, 0), (-1, -1)}]
    for s in np.arange(0, line.length_m, 2.0):
        assert not any(_inside(line.at(s)[0], outline) for outline in kerbs)


def _inside(point: np.ndarray, outline: np.ndarray) -> bool:
    """Even-odd rule."""
    a, b = outline, np.roll(outline, -1, axis=0)
    crosses = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = a[:, 0] + (point[1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool((crosses & (x > point[0])).sum() % 2)


@given(st.integers(0, 10_000))
def test_wall_pieces_and_openings_cover_a_front_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    front = facade(rng, _NOISE, Style(), rng.uniform(5, 10), rng.uniform(7.5, 14), per_m=8)
    pieces = wall_pieces(front.width_m, front.height_m, front.openings)
    pieces += [(o.left_m, o.right_m, o.bottom_m, o.top_m) for o in front.openings]
    for _ in range(50):
        u, z = rng.uniform(0, front.width_m), rng.uniform(0, front.height_m)
        assert sum(a <= u < b and c <= z < d for a, b, c, d in pieces) == 1


_NOISE = NoiseFields.of_seed(0)


@pytest.mark.parametrize(
    ("when", "azimuth_deg", "elevation_deg"),
    [  # NOAA's solar calculator for Oxford, 51.75 N 1.26 W
        (datetime(2025, 6, 21, 12, 7, tzinfo=UTC), 180.0, 61.7),
        (datetime(2025, 3, 20, 12, 12, tzinfo=UTC), 180.0, 38.2),
        (datetime(2025, 12, 21, 12, 3, tzinfo=UTC), 180.0, 14.8),
    ],
)
def test_the_sun_stands_south_at_noon_at_the_height_of_the_season(
    when: datetime, azimuth_deg: float, elevation_deg: float
) -> None:
    east, north, up = sun_direction(when, 51.75, -1.26)
    assert np.degrees(np.arctan2(east, north)) % 360 == pytest.approx(azimuth_deg, abs=1.0)
    assert np.degrees(np.arcsin(up)) == pytest.approx(elevation_deg, abs=0.4)


def test_the_sun_rises_in_the_east_and_sets_in_the_west() -> None:
    day = datetime(2025, 7, 1, tzinfo=UTC)
    assert sun_direction(day + timedelta(hours=6), 51.75, -1.26)[0] > 0.5
    assert sun_direction(day + timedelta(hours=18), 51.75, -1.26)[0] < -0.5


def test_clouds_open_and_close_along_the_way() -> None:
    conditions = Conditions(datetime(2025, 7, 1, 12, tzinfo=UTC), "broken", 4)
    power = np.array([conditions.at(s, s / 5).sun_power for s in range(0, 700, 5)])
    assert (power == 0).any()
    assert (power > 0.9 * power.max()).any()
    changes = int((np.abs(np.diff(power > power.max() / 2))).sum())
    assert 2 <= changes <= 20


@given(seed=st.integers(0, 2**31 - 1), weather=st.sampled_from(sorted(WEATHERS)))
@settings(max_examples=50)
@pytest.mark.long
def test_the_sky_does_not_jump_along_the_way(seed: int, weather: str) -> None:
    conditions = Conditions(datetime(2025, 7, 1, 12, tzinfo=UTC), weather, seed)
    sky = np.array([conditions.at(0.7 * k, 0.14 * k).sky_power for k in range(600)])
    assert np.abs(np.diff(np.log(sky))).max() < 0.05


def test_lamps_are_on_by_night_and_off_by_day() -> None:
    for hour, expected in ((1, True), (5, False), (12, False), (22, True)):
        moment = Conditions(datetime(2025, 7, 1, hour, tzinfo=UTC), "clear", 0).at(0.0, 0.0)
        assert moment.lamps_on is expected
        assert (moment.sun_power > 0) is not expected


def test_unknown_weather_is_refused() -> None:
    with pytest.raises(ConfigError, match="known are: clear"):
        Conditions(datetime(2025, 7, 1, tzinfo=UTC), "hail", 0)
    assert all(0 <= weather.cloud <= 1 for weather in WEATHERS.values())


def test_what_was_changed_for_good_stays_changed() -> None:
    before, after = alterations_on(1, 120), alterations_on(1, 240)
    lasting = {a for a in before if a.kind is not AlterationKind.SCAFFOLD}
    assert lasting <= after
    assert len(after) > len(before)
    assert any(a.kind is AlterationKind.SCAFFOLD for a in before - after)
    assert not alterations_on(1, 0)


@pytest.mark.parametrize("block", [(0, 0), (1, 0), (2, 1), (5, 3)])
def test_no_end_wall_stands_before_the_fronts_round_the_corner(block: tuple[int, int]) -> None:
    plan, _ = loop_of_length(700, 2)
    front = plan.block_outline(block, 2.4)
    sides = [
        _Side((0, 0), (0, 0), (a, b), (a, b))
        for a, b in zip(front, np.roll(front, -1, axis=0), strict=True)
    ]
    for number, side in enumerate(sides):
        before, after = sides[number - 1], sides[(number + 1) % 12]
        for other, end in ((before, side.front[0]), (after, side.front[1])):
            back = end - 8.5 * side.outwards + _slide_m(side, other, 8.5) * side.along
            # A pane lies 0.16 m behind its wall: the end wall is farther back from 0.6 m on.
            assert (back - end) @ other.outwards / 8.5 < -0.25


def estate_tile(fronts: Fronts, block: tuple[int, int]) -> _TileBuilder:
    plan, route = equal_rings(fronts, 5)
    builder = _TileBuilder(Town(plan, route, Style()), block, Today(1, 9.0, 0, 0.5))
    builder.build()
    return builder


@pytest.mark.parametrize(
    ("fronts", "same_fronts", "same_things"),
    [
        (Fronts(30.0, unique=frozenset({Unique.THINGS, Unique.CARS})), True, False),
        pytest.param(
            Fronts(30.0, unique=frozenset({Unique.CARS})), True, True, marks=pytest.mark.long
        ),
        (Fronts(30.0, equal=0.0, unique=frozenset()), False, True),
    ],
)
def test_fronts_of_an_estate_are_the_same_around_each_block_and_the_rest_as_asked(
    fronts: Fronts, same_fronts: bool, same_things: bool
) -> None:
    meshes = []
    for block in ((0, 0), (0, 2)):
        tile = estate_tile(fronts, block)
        offset = [*(np.array(block) * fronts.spacing_m), 0.0]
        meshes.append([part.build().vertices - offset for part in (tile.solid, tile.green)])
    (walls, trees), (other_walls, other_trees) = meshes
    assert (len(trees) == len(other_trees) and np.allclose(trees, other_trees, atol=1e-3)) is (
        same_things
    )
    shared = {tuple(row) for row in np.round(walls.reshape(len(walls), -1), 2).tolist()}
    other = {tuple(row) for row in np.round(other_walls.reshape(len(other_walls), -1), 2).tolist()}
    assert (len(shared & other) > 0.8 * min(len(shared), len(other))) is same_fronts


def test_the_rings_of_an_estate_share_no_street_and_are_whole_periods_apart() -> None:
    for period_m in (20.0, 30.0, 37.5):
        plan, route = equal_rings(Fronts(period_m), 5)
        assert route.beside is not None
        assert not set(route.beside.streets()) & (
            set(route.streets()) - set(route.beside.streets())
        )
        assert plan.spacing_m % period_m == 0
        assert driving_line(plan, route, reverse=False).length_m == pytest.approx(
            driving_line(plan, route.beside, reverse=False).length_m
        )


def test_estates_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError, match="period is 5"):
        Fronts(5.0)
    with pytest.raises(ConfigError, match=r"share of equal fronts is 1\.5"):
        Fronts(20.0, 1.5)
    with pytest.raises(ConfigError, match="'lamps' is unknown; known: road, things, cars"):
        Unique.named("road,lamps")
