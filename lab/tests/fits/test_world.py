"""The month of laps by which the town's difficulty is judged."""

import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from lab.tests.evaluation.campaigns import write_campaign

from engram.errors import SequenceError
from engram_lab.fits.world import LAPS, load_clip, measure_laps, month
from engram_lab.studies.drives import campaign_logs
from engram_lab.town.campaigns import Size, campaign_named


def test_the_month_is_begbroke_in_small() -> None:
    campaign = month()
    assert (len(campaign.sessions), campaign.length_m) == (LAPS, 150)
    starts = [plan.start for plan in campaign.sessions]
    assert starts == sorted(set(starts))
    assert 25 < (starts[-1] - starts[0]).days <= 30
    assert len({start.hour for start in starts}) > 12
    assert [plan.number for plan in campaign.sessions] == list(range(LAPS))


@pytest.mark.parametrize("seed", range(1, 6))
def test_the_month_has_every_weather_in_its_share(seed: int) -> None:
    whole = Counter(
        plan.weather for plan in campaign_named("begbroke24h", seed, Size.FULL).sessions
    )
    some = Counter(plan.weather for plan in month(seed).sessions)
    for weather, count in whole.items():
        assert abs(some[weather] - count * LAPS / 140) <= 1.0


@pytest.mark.long
def test_laps_that_look_alike_are_saved_once_and_fail_nowhere(tmp_path: Path) -> None:
    drives = write_campaign(tmp_path, looks=(0,) * 5).drives
    found = measure_laps([drive.path for drive in drives], tmp_path / "work")
    assert found.saved == pytest.approx(0.25, abs=0.05)  # the first of four
    assert found.fails < 0.05
    # 8 m ahead and behind of a road of 24 m, with a node every 1.4 m.
    assert 4 < found.candidates < 13
    assert found.can_succeed > 0.2


@pytest.mark.long
def test_laps_that_all_look_different_are_all_saved_and_fail_everywhere(tmp_path: Path) -> None:
    drives = write_campaign(tmp_path, looks=(0, 1, 2, 3, 4)).drives
    found = measure_laps([drive.path for drive in drives], tmp_path / "work")
    assert found.saved > 0.9
    assert found.fails > 0.9


@pytest.mark.data
def test_the_clip_is_kittis(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ENGRAM_DATA", str(data_dir))
    clip = load_clip()
    assert clip is not None
    assert len(clip) == 51
    spacing_m = np.mean([(a[0].inverse() @ b[0]).distance_m for a, b in itertools.pairwise(clip)])
    assert spacing_m == pytest.approx(1.197, abs=0.001)


def test_a_lap_that_is_not_rendered_is_named(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="40 laps are not rendered"):
        measure_laps(campaign_logs(month(), tmp_path), tmp_path)
