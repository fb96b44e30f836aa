"""Missions combine hours with routes and regions; hours without data widen, and say so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.mapping_rig import map_simulated

from engram.errors import InputError
from engram.fleet.download import DownloadOptions, download
from engram.fleet.download.forecast import BINS, FARTHEST_H, INTERVALS, LEVEL, Forecast
from engram.fleet.download.selections import SELECTIONS, along_route, select_region
from engram.fleet.download.stock import Stock
from engram.maps import Map, check_file

from .test_download import DRIVES, steps_of

WITH, WITHOUT = 9.0, 3.5  # an hour with data; one three hours from any
PLACES = ("anywhere", "route", "region")


@pytest.fixture(scope="module")
def centre(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("missions") / "centre.engram"
    for day, (name, hour, *way) in enumerate(DRIVES[:3], start=1):
        map_simulated(path, steps_of(hour, *way, day=day), name, longitude_deg=0.0)
    return path


def options_of(stock: Stock, policy: str, place: str, hour: float, **more) -> DownloadOptions:
    given: dict = {"start_h": hour, "window_min": 60.0, "radius_m": 2.0} | more
    if policy == "budget":
        given["budget_percent"] = 60.0
    if place == "route":
        given["route"] = str(stock.sessions[1].id)  # the short evening drive
    if place == "region":
        given["near"] = (str(stock.nodes[5].id), str(stock.nodes[-1].id))
    return DownloadOptions(policy, **given)


@pytest.mark.parametrize("hour", [WITH, WITHOUT])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("policy", ["tod", "paths", "tod+paths", "budget"])
def test_every_mission_is_as_connected_as_the_fleet_map_and_says_what_it_did(
    centre, tmp_path, policy, place, hour
):
    with Map.open(centre) as store:
        stock = Stock(store)
        options = options_of(stock, policy, place, hour)
        report = download(centre, tmp_path / "out.engram", options)
        labels = dict(zip(stock.node_ids, stock.graph.components().tolist(), strict=True))
        area = stock.everything()
        if place == "route":
            area = along_route(stock, options.route, 2.0)
        if place == "region":
            area = select_region(stock, options).sent
        allowed = {stock.node_ids[at] for at in np.flatnonzero(area)}
    with Map.open(tmp_path / "out.engram") as sent:
        nodes = {node.id for node in sent.load().nodes}
        components = int(sent.graph.components().max()) + 1
    assert nodes
    assert components == report.components == len({labels[node] for node in nodes})
    if policy != "budget":  # fills the rest of its bytes with what is near in time
        assert nodes <= allowed
        widened = report.why.get("widened")
        has_data = hour == WITH and (place != "route" or policy == "paths")
        assert (widened is None) is (hour == WITH) or not has_data
        assert widened is None or widened in report.text()
    assert check_file(tmp_path / "out.engram").problems == ()


@pytest.mark.parametrize("policy", ["tod", "paths", "tod+paths"])
def test_strict_refuses_an_hour_without_data(centre, tmp_path, policy):
    with Map.open(centre) as store:
        options = options_of(Stock(store), policy, "anywhere", WITHOUT, end_h=4.0, strict=True)
    with pytest.raises(InputError, match=r"window_min|buffer_min"):
        download(centre, tmp_path / "out.engram", options)


def test_widening_stops_at_the_nearest_hours(centre):
    """From 3:30 with an hour's window: 9:00 comes first, the evening's 18:00 does not."""
    with Map.open(centre) as store:
        stock = Stock(store)
        found = SELECTIONS["tod"](stock, options_of(stock, "tod", "anywhere", WITHOUT))
        hours = stock.hours[found.sent]
    assert "widened to 360 minutes" in found.why["widened"]
    assert np.abs(hours - 9.25).max() < 0.5


def test_without_any_hour_near_everything_of_the_area_goes_along(centre, monkeypatch):
    monkeypatch.setattr("engram.fleet.download.by_time._WIDEST_MIN", 100.0)
    with Map.open(centre) as store:
        stock = Stock(store)
        options = options_of(stock, "tod", "route", WITHOUT)
        found = SELECTIONS["tod"](stock, options)
        assert (found.sent == along_route(stock, options.route, 2.0)).all()
    assert "all hours are sent" in found.why["widened"]


def test_forecasts_are_intervals_or_say_that_they_cannot_know():
    for drives in (1, 40):
        for place, interval in enumerate(INTERVALS[drives == 1]):
            expected = (BINS[place] + BINS[place + 1]) / 2
            forecast = Forecast.of(expected, drives, apart_h=1.0)
            assert forecast.known is (interval is not None)
            assert 0 <= forecast.low <= forecast.high <= 1
            assert ("not known for such" in forecast.text()) is not forecast.known
            assert f"{LEVEL:.0%}" in forecast.text() or not forecast.known
            assert not Forecast.of(expected, drives, apart_h=FARTHEST_H + 1).known
    assert any(INTERVALS[True])
    assert any(INTERVALS[False])
