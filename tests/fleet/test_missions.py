"""Missions combine hours with routes and regions; hours without data widen, and say so."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.csgraph import dijkstra
from tests.builders import map_simulated

from engram.errors import ConfigError, InputError
from engram.fleet.download.coverage import (
    BINS,
    INTERVALS,
    LEVEL,
    MOST_DRIVES,
    Forecast,
    Light,
    Weather,
)
from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.download.part import Stock
from engram.fleet.download.selections import SELECTIONS
from engram.graph.model import path_id
from engram.maps.map import Map
from engram.maps.map_files import check_file

from .test_download import DRIVES, steps_of

WITH, WITHOUT = 9.0, 3.5  # an hour with data; one three hours from any
PLACES = ("anywhere", "route", "region", "both")
BY_TIME = ("tod", "paths", "tod+paths")
# Half of those of `budget`, the slowest by far, wait for the long tests.
MISSIONS = [
    pytest.param(
        policy, place, hour, marks=[pytest.mark.long] * (policy == "budget" and hour != WITHOUT)
    )
    for policy in SELECTIONS
    for place in PLACES
    for hour in (None, WITH, WITHOUT)
]


def refusal(policy: str, place: str, hour: float | None) -> str | None:
    """What a mission is refused with that a policy cannot serve; None if it is served."""
    if policy in {"copy", "route"} and place in {"region", "both"}:
        return "does not use --near"
    if policy in {"copy", "region"} and place in {"route", "both"}:
        return "does not use --route"
    if place == "both":
        return "give only one of them"
    if policy in {"route", "region"} and place == "anywhere":
        return f"needs --{'near' if policy == 'region' else policy}"
    return "needs --depart" if policy in {"tod", "tod+paths"} and hour is None else None


@pytest.fixture(scope="module")
def centre(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("missions") / "centre.engram"
    for day, (name, hour, *way) in enumerate(DRIVES[:3], start=1):
        map_simulated(path, steps_of(hour, *way, day=day), name, longitude_deg=0.0)
    return path


@pytest.fixture(scope="module")
def stock(centre) -> Iterator[Stock]:
    with Map.open(centre) as store:
        yield Stock(store)


def options_of(stock: Stock, policy: str, place: str, hour: float | None, **more):
    given: dict = {"depart_h": hour, "window_min": 60.0, "radius_m": 2.0} | more
    if policy == "budget":
        given["budget_percent"] = 60.0
    if place in {"route", "both"}:
        given["route"] = str(stock.sessions[1].id)  # the short evening drive
    if place in {"region", "both"}:
        given["near"] = (str(stock.nodes[5].id), str(stock.nodes[-1].id))
    return DownloadOptions(policy, **given)


@pytest.mark.parametrize(("policy", "place", "hour"), MISSIONS)
def test_every_mission_is_as_connected_as_the_fleet_map_and_says_what_it_did(
    centre, stock, tmp_path, policy, place, hour
):
    options, out = options_of(stock, policy, place, hour), tmp_path / "out.engram"
    if refused := refusal(policy, place, hour):
        with pytest.raises(ConfigError, match=refused):
            download(centre, out, options)
        assert not out.exists()
        return
    report = download(centre, out, options)
    labels = dict(zip(stock.node_ids, stock.graph.components().tolist(), strict=True))
    with Map.open(centre) as store:
        around = Stock(store, options)
    allowed = {around.node_ids[at] for at in np.flatnonzero(around.area)}
    with Map.open(out) as sent:
        nodes = {node.id for node in sent.load().nodes}
        components = int(sent.graph.components().max()) + 1
    assert nodes
    assert components == report.components == len({labels[node] for node in nodes})
    assert nodes <= allowed or policy == "budget"  # which fills its bytes with what is near in time
    assert report.text().startswith(f"{policy}: ")
    widened, told = report.why.get("widened"), report.text()
    assert widened is None or (policy in BY_TIME and widened in told)
    if hour == WITHOUT and policy in BY_TIME:  # `paths` begins with the first epoch with data
        assert widened or (policy == "paths" and f"epochs {report.why['epochs'][0]}" in told)
    elif place == "anywhere":
        assert widened is None
    assert check_file(out).problems == ()


@pytest.mark.parametrize("margin_m", [0.1, 30.0])
@pytest.mark.parametrize("place", ["route", "region"])
def test_an_area_is_what_a_search_of_the_whole_map_finds_and_as_connected(
    stock, monkeypatch, place, margin_m
):
    monkeypatch.setattr("engram.fleet.download.surroundings.MARGIN_M", margin_m)
    options = options_of(stock, place, place, None)
    links = stock.graph.lightest(lambda edge: max(edge.a_from_b.distance_m, 1e-3))
    seeds = stock.on_path[path_id(stock.sessions[1].id)] if place == "route" else [5, -1]
    lengths_m = links.matrix(len(stock))
    starts = np.arange(len(stock))[seeds]
    found_m = dijkstra(lengths_m, directed=False, indices=starts, min_only=True, limit=2.0)
    around = Stock(stock.store, options)
    expected = {stock.node_ids[at] for at in np.flatnonzero(np.isfinite(found_m))}
    assert {around.node_ids[at] for at in np.flatnonzero(around.area)} == expected
    assert len(around) < len(stock) or margin_m > 1 or place == "region"
    labels, whole = around.graph.components(), stock.graph.components()
    pairs = {
        (int(labels[at]), int(whole[stock.index[around.node_ids[at]]]))
        for at in np.flatnonzero(around.area)
    }
    assert len(pairs) == len({there for _, there in pairs})


@pytest.mark.parametrize("policy", BY_TIME)
def test_strict_refuses_an_hour_without_data(centre, stock, tmp_path, policy):
    options = options_of(stock, policy, "anywhere", WITHOUT, arrive_h=4.0, strict=True)
    with pytest.raises(InputError, match=r"window_min|buffer_min"):
        download(centre, tmp_path / "out.engram", options)


def test_widening_stops_at_the_nearest_hours(stock):
    """From 3:30 with an hour's window: 9:00 comes first, the evening's 18:00 does not."""
    found = SELECTIONS["tod"](stock, options_of(stock, "tod", "anywhere", WITHOUT))
    hours = stock.hours[found.sent]
    assert "widened to 360 minutes" in found.why["widened"]
    assert np.abs(hours - 9.25).max() < 0.5


def test_without_any_hour_near_everything_of_the_area_goes_along(stock, monkeypatch):
    monkeypatch.setattr("engram.fleet.download.selections._WIDEST_MIN", 100.0)
    options = options_of(stock, "tod", "route", WITHOUT)
    around = Stock(stock.store, options)
    found = SELECTIONS["tod"](around, options)
    assert 0 < found.sent.sum() < len(around)
    assert (found.sent == around.area).all()
    assert "all hours are sent" in found.why["widened"]


@pytest.mark.parametrize("alike", [True, False, None])
@pytest.mark.parametrize("drives", [1, 40])
def test_forecasts_are_intervals_or_say_that_they_cannot_know(drives, alike):
    for place in range(len(BINS) - 1):
        lost = (BINS[place] + BINS[place + 1]) / 2
        forecast = Forecast.of(lost, lost, drives, Light(alike))
        for weather, missed in forecast.missed.items():
            table = INTERVALS.get((weather, alike, drives < MOST_DRIVES))
            assert missed == (None if table is None or alike is None else table[place])
            assert missed is None or 0 <= missed[0] < missed[1] <= 1
        assert forecast.text().count("not known") == list(forecast.missed.values()).count(None)
        assert f"{LEVEL:.0%}" in forecast.text()
    assert (alike is not True) or forecast.missed.keys() == set(Weather)


def test_light_is_told_by_the_sun_where_the_latitude_is_known(stock):
    """Drives at 9:00 and 18:00 in January: at 60° north the sun is down by 18:00."""

    def alike(hour: float | None, latitude_deg: float | None) -> bool | None:
        return Light.of(stock, DownloadOptions(depart_h=hour, latitude_deg=latitude_deg)).alike

    assert alike(23.0, 60.0) is True  # as dark as 18:00
    assert alike(12.0, 0.0) is True
    assert alike(10.0, None) is True
    assert alike(3.5, None) is None  # far from all hours, and the sun is not known
    assert alike(None, 60.0) is None
