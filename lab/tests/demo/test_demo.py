"""The demo: what it tells, and the drives that ship."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from engram.sample import drives
from engram_lab.demo.sample_drives import PARTS, encoded, write_facts
from engram_lab.demo.story import run_demo

SHIPPED = Path(drives.__file__).parent / "data"


@pytest.mark.parametrize("name", PARTS)
def test_calibration_stamps_and_truth_are_those_of_the_program(name: str, tmp_path: Path) -> None:
    write_facts(PARTS[name], tmp_path / name)
    for file in (f"{name}/calibration.toml", f"{name}/times.txt"):
        assert (SHIPPED / file).read_text() == (tmp_path / file).read_text()
    truths = [np.loadtxt(folder / f"{name}.truth.txt") for folder in (SHIPPED, tmp_path)]
    np.testing.assert_allclose(*truths, atol=1e-6)


@pytest.mark.parametrize("name", PARTS)
def test_images_are_those_of_the_program(name: str) -> None:
    for number, pair in enumerate(PARTS[name].pairs(2)):
        for side in ("left", "right"):
            shipped = cv2.imread(str(SHIPPED / name / side / f"{number:06d}.jpg"), -1)
            body = np.frombuffer(encoded(getattr(pair, side)), np.uint8)
            rendered = cv2.imdecode(body, -1)
            # Equal here; another JPEG library or processor may round otherwise.
            assert np.abs(shipped.astype(int) - rendered).mean() < 0.5


def test_the_drives_that_ship_are_whole_and_small() -> None:
    assert {one.name for one in drives.DRIVES} == PARTS.keys()
    files = [one for one in SHIPPED.rglob("*") if one.is_file()]
    assert len([one for one in files if one.suffix == ".jpg"]) == 2 * 2 * 40
    assert sum(one.stat().st_size for one in files) < 6.5e6


@pytest.mark.long
def test_the_demo_shows_that_paths_find_more_with_fewer_attempts(tmp_path: Path) -> None:
    report = run_demo(tmp_path / "demo")
    distance, path = report.localised["distance"], report.localised["path-near"]
    # At one attempt a frame, 90 and 100 % of the frames are localised.
    assert path[1]["share_localised"] > distance[1]["share_localised"] + 0.05
    assert path[4]["share_localised"] >= distance[4]["share_localised"]
    assert path[4]["attempts_per_frame"] < distance[4]["attempts_per_frame"]
    assert len(report.mapped) + 1 == len(report.conditions) == 6
    for name in ("one_place.png", "map_from_above.png", "attempts.png"):
        assert (report.out / name).stat().st_size > 10_000
    assert list((report.out / "matches_path-near_4").glob("*_localised.png"))
