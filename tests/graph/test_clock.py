"""Hour of day (method §2.8)."""

from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import ConfigError
from engram.graph.clock import check_longitude, check_zone, hour_of_day, zone_note
from engram.graph.model import Clock
from engram.sequences.sequence import SequenceInfo


def info(longitude_deg=None, zone=None, clock=Clock.UTC) -> SequenceInfo:
    return SequenceInfo("x", "kitti-raw", clock, None, longitude_deg, zone)


def at(*parts: int) -> int:
    return int(datetime(*parts, tzinfo=UTC).timestamp()) * 10**9


@pytest.mark.parametrize(
    ("longitude_deg", "hour"), [(0, 12.5), (15, 13.5), (-15, 11.5), (180, 0.5), (-180, 0.5)]
)
def test_mean_solar_time_follows_the_longitude(longitude_deg: float, hour: float) -> None:
    noon_thirty_ns = at(2011, 9, 26, 12, 30)
    assert hour_of_day(info(longitude_deg), noon_thirty_ns) == pytest.approx(hour, abs=1e-6)


@pytest.mark.parametrize(
    ("month", "hour"),
    [(7, 14.0), (1, 13.0)],  # summer time, winter time
)
def test_civil_time_follows_the_zone(month: int, hour: float) -> None:
    noon_ns = at(2011, month, 1, 12)
    assert hour_of_day(info(zone="Europe/Berlin"), noon_ns) == hour


def test_longitude_goes_before_zone() -> None:
    noon_ns = at(2011, 7, 1, 12)
    assert hour_of_day(info(15.0, "Europe/Berlin"), noon_ns) == pytest.approx(13.0, abs=1e-6)


@pytest.mark.parametrize("clock", [Clock.RELATIVE, Clock.UNKNOWN])
def test_without_utc_there_is_no_hour(clock: Clock) -> None:
    assert hour_of_day(info(8.4, "Europe/Berlin", clock), at(2011, 7, 1)) is None


def test_without_a_place_there_is_no_hour() -> None:
    assert hour_of_day(info(), at(2011, 7, 1)) is None


@given(stamp_ns=st.integers(0, 2**62), longitude_deg=st.floats(-180, 180))
def test_hours_lie_in_the_day(stamp_ns: int, longitude_deg: float) -> None:
    for source in (info(longitude_deg), info(zone="America/St_Johns")):
        hour = hour_of_day(source, stamp_ns)
        assert hour is not None
        assert 0 <= hour < 24


@pytest.mark.parametrize("longitude_deg", [181, -181, float("nan"), float("inf")])
def test_what_is_no_longitude_is_refused(longitude_deg: float) -> None:
    with pytest.raises(ConfigError, match="longitude"):
        check_longitude(longitude_deg)


@pytest.mark.parametrize(
    "zone", ["", "Nowhere/Town", "../../etc/passwd", "/etc/passwd", "a\0b", "."]
)
def test_what_is_no_zone_is_refused(zone: str) -> None:
    with pytest.raises(ConfigError, match="zone"):
        check_zone(zone)


STRANGE = ["Mars/Olympus_Mons", "../../etc/passwd", "", "x" * 10_000, "Europe", "zone.tab", "a\0b"]


@pytest.mark.parametrize("zone", STRANGE)
def test_in_a_zone_that_this_machine_does_not_know_no_hour_is_known(zone: str) -> None:
    source = info(zone=zone)
    assert hour_of_day(source, at(2011, 7, 1, 12)) is None
    assert "is unknown to this machine: update its time zone database" in zone_note(source)
    with pytest.raises(ConfigError) as told:
        check_zone(zone)
    assert len(str(told.value)) < 150


def test_where_the_longitude_says_the_hour_the_zone_is_not_asked() -> None:
    source = info(15.0, "Mars/Olympus_Mons")
    assert hour_of_day(source, at(2011, 7, 1, 12)) == pytest.approx(13.0, abs=1e-6)
    assert zone_note(source) == ""
    assert zone_note(info(zone="Europe/Berlin")) == ""
