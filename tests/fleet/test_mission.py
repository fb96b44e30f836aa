"""What a robot asks of the centre, as people write it."""

from __future__ import annotations

import pytest

from engram.errors import ConfigError
from engram.fleet.download.mission import budget_from_text, hour_from_text


@pytest.mark.parametrize(
    ("text", "size_bytes", "percent"),
    [
        (None, None, None),
        ("4096", 4096, None),
        ("200MB", 200_000_000, None),
        ("200 M", 200_000_000, None),
        ("1.5GiB", 3 * 2**29, None),
        (" 10kB ", 10_000, None),
        ("25%", None, 25.0),
        ("12.5 %", None, 12.5),
    ],
)
def test_a_budget_is_a_size_or_a_share(text, size_bytes, percent):
    assert budget_from_text(text) == (size_bytes, percent)


@pytest.mark.parametrize(
    "text", ["", "much", "-5%", "%", "1e2%", "5MiBB", "3 apples", "²kB", "5iB"]
)
def test_what_is_neither_says_what_would_be(text):
    with pytest.raises(ConfigError, match=r"such as 200MB, 1\.5GiB or 4096, or a share .* 25%"):
        budget_from_text(text)


@pytest.mark.parametrize(
    ("text", "hour"), [(None, None), ("9", 9.0), ("09:30", 9.5), (" 23:45 ", 23.75)]
)
def test_hours_of_day(text, hour):
    assert hour_from_text(text, "start") == hour


@pytest.mark.parametrize("text", ["", "24:00", "9:60", "9h", "-1", "9:5"])
def test_what_is_no_hour_of_day(text):
    with pytest.raises(ConfigError, match=r"start is .* must be a time of day such as 9:30"):
        hour_from_text(text, "start")
