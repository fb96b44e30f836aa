"""What `engram bench --only world` puts together."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from engram.errors import ConfigError
from engram_lab.bench import world
from engram_lab.town.calibration import VISITS, Appearance, Row, world_hash

ROW = Row("f", "route failed, by day", 5.0, 3, 8, "%")


@pytest.fixture
def seen(monkeypatch) -> list[int]:
    """Towns that were looked at; no town is built, and there is no clip."""
    towns: list[int] = []
    monkeypatch.setattr(world, "Places", towns.append)
    counts = {name: np.full(4, 70) for name in VISITS}
    monkeypatch.setattr(world, "appearance", lambda *_: Appearance(np.full(4, 600), counts))
    monkeypatch.delenv("ENGRAM_DATA", raising=False)
    return towns


def test_it_looks_at_unseen_towns_and_says_that_the_clip_is_absent(seen: list[int]) -> None:
    report = world.measure_world()
    assert seen == [4, 5]
    assert {row.letter for row in report.measured} == {"a", "b", "c"}
    assert any("ENGRAM_DATA" in note for note in report.notes)
    assert json.loads(json.dumps(report.to_dict()))["hash"] == world_hash()
    assert report.table().row_count == len(report.measured) + len(report.recorded)


def test_it_needs_a_town(seen: list[int]) -> None:
    with pytest.raises(ConfigError, match="no town"):
        world.measure_world(())


def test_what_is_recorded_is_read_again_with_its_world(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    assert world.read_record(path) == ((), None, "")
    world.write_record([ROW], "town 1", path)
    assert world.read_record(path) == ((ROW,), world_hash(), "town 1")


def test_a_record_of_another_world_is_warned_of(seen, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "record.json"
    world.write_record([ROW], "town 1", path)
    for known, warned in ((world_hash(), False), ("0123456789ab", True)):
        values = json.loads(path.read_text())
        path.write_text(json.dumps({**values, "hash": known}))
        monkeypatch.setattr(world, "read_record", lambda: reader(path))
        assert any("another world" in note for note in world.measure_world().notes) is warned


reader = world.read_record


@pytest.mark.data
def test_the_clip_is_kittis(data_dir: Path, monkeypatch) -> None:
    monkeypatch.setenv("ENGRAM_DATA", str(data_dir))
    clip = world.load_clip()
    assert clip is not None
    assert len(clip) == 51
    spacing_m = np.mean([(a[0].inverse() @ b[0]).distance_m for a, b in itertools.pairwise(clip)])
    assert spacing_m == pytest.approx(1.197, abs=0.001)
