"""A fleet's day with kills comes to the same map as its files."""

from __future__ import annotations

import pytest

from engram_lab.checks.centre_kills import one_day


@pytest.mark.long
def test_a_day_with_kills_loses_nothing_and_does_nothing_twice(tmp_path):
    day = one_day(tmp_path, 0, kills=6, pause_s=2.0)
    assert day.faults == []
    assert len(day.kills) == 6
    assert day.drives >= 2
