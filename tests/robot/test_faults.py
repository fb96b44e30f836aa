"""A camera that stalls or freezes gives no false fix; the robot is found again at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from engram_lab.studies.faults.questions import disturbed, frozen_streams, stalled
from engram_lab.studies.faults.study import RealPlan

MAPS = pytest.mark.parametrize("mapped", [slice(None), slice(25)], ids=["whole", "half"])


@pytest.fixture(scope="module")
def clip(data_dir: Path):
    return RealPlan("kitti-06", "whole", data_dir).read()


@MAPS
@pytest.mark.data
def test_no_fix_after_a_stall_is_false(clip, mapped, tmp_path: Path) -> None:
    # The street repeats every 27.7 m: stalls of about that length are the worst.
    gaps = [(4, 36), (12, 36), (10, 18), (16, 40), (22, 45)]
    found = disturbed(clip, mapped, tmp_path / "town.engram", stalled(clip, gaps))
    assert (found.robots, found.false) == (5, 0)
    assert found.fixes > 50
    if mapped == slice(None):  # two frames tell a stall from a wrong stamp
        assert len(found.again) == 5
        assert all(one <= 2 for one in found.again)


@MAPS
@pytest.mark.data
def test_no_fix_comes_from_images_that_are_repeated(clip, mapped, tmp_path: Path) -> None:
    found = disturbed(clip, mapped, tmp_path / "town.engram", frozen_streams(clip, [12, 28]))
    assert found.false == 0
    if mapped == slice(None):
        assert len(found.again) == found.robots == 6
