"""The demo, as ``make demo`` runs it."""

from pathlib import Path

import pytest

from engram_lab.demo.story import run_demo


@pytest.mark.long
def test_the_demo_shows_that_paths_find_more_with_fewer_attempts(tmp_path: Path) -> None:
    report = run_demo(tmp_path / "demo")
    distance, path = report.localised["distance"], report.localised["path-near"]
    # At one attempt a frame, 71 and 100 % of the frames are localised.
    assert path[1]["share_localised"] > distance[1]["share_localised"] + 0.1
    assert path[4]["share_localised"] >= distance[4]["share_localised"]
    assert path[4]["attempts_per_frame"] < distance[4]["attempts_per_frame"]
    assert len(report.mapped) + 1 == len(report.conditions) == 6
    for name in ("one_place.png", "map_from_above.png", "attempts.png"):
        assert (report.out / name).stat().st_size > 10_000
    assert list((report.out / "matches_path-near_4").glob("*_localised.png"))
