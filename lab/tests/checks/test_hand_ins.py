"""An evening of hand-ins, with a small city."""

from __future__ import annotations

from pathlib import Path

import pytest

from engram_lab.checks.hand_ins import evening
from engram_lab.studies.scale import City


@pytest.mark.long
def test_all_that_robots_hand_in_at_once_is_merged(tmp_path: Path) -> None:
    city = City(3, length=40, distinct=3)

    found = {one.name: one.value for one in evening(tmp_path, city, 4, driven=16, downloads=1)}

    assert (found["hand-ins merged"], found["hand-ins failed"]) == (4, 0)
    assert (found["server errors"], found["problems of the map"]) == (0, 0)
    assert 4 <= found["nodes added"] <= 4 * 16
    assert 0 < found["of a core, merging"] < 10
    assert found["downloads meanwhile, until the manifest: longest"] > 0
