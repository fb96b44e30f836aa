"""The drives that ship are what their program renders."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from engram.sample import drives
from engram_lab.demo.sample_drives import PARTS, encoded, write_facts

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
