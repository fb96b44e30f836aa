"""Which past drives stand for a mission: by its hours and by the sun, in the north and south."""

from __future__ import annotations

from datetime import UTC, datetime
from types import SimpleNamespace
from uuid import UUID

import numpy as np
import pytest

from engram.errors import ConfigError
from engram.fleet.download import coverage
from engram.fleet.download.coverage import importance, learnt_latitude
from engram.fleet.download.mission import DownloadOptions
from engram.graph.clock import day_of_year, hour_of_day, sun_height_deg
from engram.graph.model import Clock, Session, SessionId

CAMERAS = {"camera": SimpleNamespace(fx=400.0)}


def session(number: int, when: datetime, **about) -> Session:
    start_ns = int(when.timestamp()) * 1_000_000_000
    given = {"clock": Clock.UTC, "longitude_deg": 0.0} | about
    return Session(SessionId(UUID(int=number)), "r1", "camera", start_ns, **given)


def stock(*sessions: Session) -> SimpleNamespace:
    store = SimpleNamespace(sessions={one.id: one for one in sessions})
    return SimpleNamespace(sessions=list(sessions), cameras=CAMERAS, store=store)


JUNE_EVENING = session(1, datetime(2026, 6, 20, 17, 12, tzinfo=UTC))
JUNE_NIGHT = session(2, datetime(2026, 6, 21, 23, 30, tzinfo=UTC))
DECEMBER_EVENING = session(3, datetime(2026, 12, 20, 18, 0, tzinfo=UTC))
DECEMBER_NOON = session(4, datetime(2026, 12, 20, 12, 0, tzinfo=UTC))


@pytest.fixture
def no_attempts(monkeypatch):
    monkeypatch.setattr(
        coverage, "tallies", lambda stock, basin: np.zeros((2, *[len(stock.sessions)] * 2))
    )


@pytest.fixture
def year(monkeypatch):
    """Drives of all seasons and hours that get on with each other as the sun's height says."""
    rng = np.random.default_rng(7)
    drives = [
        session(number, datetime(2026, month, 11, hour, tzinfo=UTC))
        for number, (month, hour) in enumerate(
            (month, int(hour)) for month in (1, 4, 6, 8, 11) for hour in rng.permutation(24)[:8]
        )
    ]
    hours = [hour_of_day(one, one.start_ns) for one in drives]
    days = [day_of_year(one.start_ns) for one in drives]

    def at(latitude_deg: float | None) -> SimpleNamespace:
        height = sun_height_deg(days, hours, latitude_deg or 0.0).clip(-6, 10)
        apart = np.abs(height[:, None] - height[None, :])
        rate = np.full(apart.shape, 0.6) if latitude_deg is None else 0.95 * np.exp(-apart / 5)
        tried = rng.integers(0, 30, rate.shape).astype(float)
        won = rng.binomial(tried.astype(int), rate).astype(float)
        monkeypatch.setattr(coverage, "tallies", lambda stock, basin: (won, tried.copy()))
        return stock(*drives)

    return at


@pytest.mark.parametrize(
    ("true_deg", "found_deg"),
    [
        (51.8, 52.5),
        pytest.param(-36.0, -37.5, marks=pytest.mark.long),
        pytest.param(3.0, 0.0, marks=pytest.mark.long),
    ],
)
def test_the_latitude_is_learnt_from_who_got_on_with_whom(year, true_deg, found_deg):
    assert learnt_latitude(year(true_deg)) == found_deg


def test_no_latitude_is_learnt_where_light_does_not_matter_or_nothing_was_tried(year, no_attempts):
    assert learnt_latitude(stock(JUNE_EVENING, JUNE_NIGHT)) is None
    assert learnt_latitude(year(None)) is None


def test_by_hours_alone_a_november_evening_is_like_one_in_june(no_attempts):
    counts = importance(
        stock(JUNE_EVENING, JUNE_NIGHT),
        DownloadOptions(depart_h=17.2, arrive_h=17.2, date="2026-11-17"),
    )
    assert counts[0] > 5 * counts[1]


def test_by_the_sun_a_november_evening_is_night(no_attempts):
    past = stock(JUNE_EVENING, JUNE_NIGHT, DECEMBER_EVENING, DECEMBER_NOON)
    asked = DownloadOptions(depart_h=17.2, date="2026-11-17", latitude_deg=51.8)
    june_evening, june_night, december_evening, december_noon = importance(past, asked)
    assert december_evening > june_night > 2 * december_noon
    assert june_night > 2 * june_evening
    south = DownloadOptions(depart_h=17.2, date="2026-11-17", latitude_deg=-51.8)
    assert np.argmax(importance(past, south)) == 2  # summer there: a bright evening in December


def test_without_a_date_the_mission_is_on_the_day_of_the_newest_drive(no_attempts):
    past = stock(JUNE_EVENING, JUNE_NIGHT, DECEMBER_EVENING, DECEMBER_NOON)
    asked = {"depart_h": 17.2, "arrive_h": 18.0, "latitude_deg": 51.8}
    newest = importance(past, DownloadOptions(**asked))
    np.testing.assert_array_equal(
        newest, importance(past, DownloadOptions(**asked, date="2026-12-20"))
    )


def test_all_drives_within_the_hours_of_a_mission_count_alike(no_attempts):
    drives = [session(n, datetime(2026, 6, 20, 8 + n, tzinfo=UTC)) for n in range(4)]
    over_midnight = [session(5 + n, datetime(2026, 6, 20, n, tzinfo=UTC)) for n in (1, 23)]
    counts = importance(
        stock(*drives, *over_midnight), DownloadOptions(depart_h=8.5, arrive_h=10.2)
    )
    assert counts[1] == counts[2] == counts.max()
    assert counts[0] < counts[1]
    night = importance(stock(*drives, *over_midnight), DownloadOptions(depart_h=22.0, arrive_h=2.0))
    assert night[4] == night[5] == night.max()


def test_drives_without_a_known_hour_count_a_little(no_attempts):
    unknown = session(9, datetime(2026, 6, 20, 8, tzinfo=UTC), longitude_deg=None)
    counts = importance(stock(JUNE_EVENING, unknown), DownloadOptions(depart_h=17.0))
    assert 0 < counts[1] < 0.2 < counts[0]
    np.testing.assert_array_equal(importance(stock(unknown), DownloadOptions()), [1.0])


def test_what_is_no_date_or_latitude_is_refused():
    with pytest.raises(ConfigError, match="must be a day such as"):
        DownloadOptions(date="17.11.2026")
    with pytest.raises(ConfigError, match="latitude_deg is 91"):
        DownloadOptions(latitude_deg=91.0)
