"""A camera that stalls or freezes gives no false fix; the robot is found again at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram.sequences.opening import open_drive
from engram_lab.checks.stalls import KITTI_06, KITTI_06_TRUTH, Clip, Tally, freezes, stalls


@pytest.fixture(scope="module", params=[None, "0:25"], ids=["whole", "half"])
def clip(request, data_dir: Path, tmp_path_factory: pytest.TempPathFactory):
    folder = data_dir / KITTI_06
    pairs = list(open_drive(folder))
    rows = np.loadtxt(data_dir / KITTI_06_TRUTH)[: len(pairs)]
    truth = [SE3.from_matrix(row.reshape(3, 4)) for row in rows]
    mapped = open_drive(folder, **({"frames": request.param} if request.param else {}))
    path = tmp_path_factory.mktemp("faults") / "town.engram"
    made = Clip(pairs, truth, path, mapped)
    yield made, request.param is None
    made.close()


@pytest.mark.data
def test_no_fix_after_a_stall_is_false(clip) -> None:
    # The street repeats every 27.7 m: stalls of about that length are the worst.
    found = stalls(clip[0], [(4, 36), (12, 36), (10, 18), (16, 40), (22, 45)])
    assert found.false == 0
    assert found.fixes > 50
    if clip[1]:  # the map knows where the robot is; two frames tell a stall from a wrong stamp
        assert all(one <= 2 for one in found.again)


@pytest.mark.data
def test_no_fix_comes_from_images_that_are_repeated(clip) -> None:
    found = freezes(clip[0], [12, 28])
    assert found.false == 0
    if clip[1]:
        assert len(found.again) == found.tries


def test_a_tally_counts_tries_that_were_hurt_and_frames_until_found_again() -> None:
    tally = Tally()
    tally.count({0: 0.1, 1: 5.0, 3: 0.2}, range(4), after=2)
    tally.count({0: 0.1}, range(4), after=2)
    assert (tally.tries, tally.fixes, tally.false, tally.hurt) == (2, 4, 1, 1)
    assert tally.worst_m == 5.0
    assert tally.again == [1]
