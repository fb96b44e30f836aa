"""Rendered drives: what every reader of one may rely on."""

import os
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lab.tests.simulation.conftest import small

from engram.errors import ConfigError
from engram_lab.town.camera_model import Lens
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.mesh import Kind
from engram_lab.town.session import SimulatedDrive


def test_pairs_have_the_camera_s_size_and_rising_stamps(drive: SimulatedDrive) -> None:
    pairs = list(islice(drive, 3))
    stamps = [pair.stamp_ns for pair in pairs]
    assert stamps == sorted(set(stamps))
    for pair in pairs:
        assert pair.left.shape == pair.right.shape == (96, 128)
        assert pair.left.dtype == np.uint8
        assert pair.left.std() > 10  # something is to be seen


@pytest.mark.long
def test_the_same_drive_twice_gives_the_same_pictures(hamlet: Campaign) -> None:
    first = [p.left for p in islice(small(SimulatedDrive(hamlet, 0)), 2)]
    second = [p.left for p in islice(small(SimulatedDrive(hamlet, 0)), 2)]
    np.testing.assert_array_equal(first, second)


@pytest.mark.long
def test_two_drives_read_in_turns_do_not_mix(hamlet: Campaign) -> None:
    alone = [p.left for p in islice(small(SimulatedDrive(hamlet, 2)), 2)]
    day, other = small(SimulatedDrive(hamlet, 0)), small(SimulatedDrive(hamlet, 2))
    taken = [b.left for _, b in islice(zip(day, other, strict=False), 2)]
    np.testing.assert_array_equal(alone, taken)


@pytest.mark.long
def test_threads_do_not_change_the_picture(hamlet: Campaign) -> None:
    one = next(iter(small(SimulatedDrive(hamlet, 0, threads=1))))
    three = next(iter(small(SimulatedDrive(hamlet, 0, threads=3))))
    np.testing.assert_array_equal(one.left, three.left)
    np.testing.assert_array_equal(one.right, three.right)


@pytest.mark.long
def test_a_covered_lens_shows_nothing_and_what_was_seen_comes_back(hamlet: Campaign) -> None:
    drive = small(SimulatedDrive(hamlet, 0))
    covered = Lens(covered_from_m=drive.poses[3].driven_m, covered_to_m=drive.poses[5].driven_m)
    drive.plan = replace(drive.plan, lens=covered)
    contrast = [float(cv2.GaussianBlur(pair.left, (0, 0), 2).std()) for pair in islice(drive, 10)]
    # Exposure rises after what little comes through, and is too long for two frames after it.
    assert max(contrast[3:5]) < 0.25 * min(contrast[:3])
    assert min(contrast[7:]) > 0.25 * min(contrast[:3])


@pytest.mark.long
def test_another_seed_is_another_town(drive: SimulatedDrive) -> None:
    other = small(SimulatedDrive(campaign_named("hamlet", seed=4), 0))
    assert (next(iter(drive)).left != next(iter(other)).left).mean() > 0.5


_PRINT_CHECKSUM = """
import sys, numpy as np
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.campaigns import campaign_named
from lab.tests.simulation.conftest import small
drive = small(SimulatedDrive(campaign_named("hamlet", seed=3), int(sys.argv[1])))
np.save(sys.argv[2], next(drive.frames(20, 21)).left)
"""


@pytest.mark.long
@pytest.mark.parametrize("session", [0, 3])
def test_every_instruction_set_gives_the_same_picture(
    session: int, hamlet: Campaign, tmp_path_factory: pytest.TempPathFactory
) -> None:
    out = tmp_path_factory.mktemp("isa") / "left.npy"
    subprocess.run(
        [sys.executable, "-c", _PRINT_CHECKSUM, str(session), str(out)],
        env={**os.environ, "ENGRAM_ISA": "generic"},
        check=True,
    )
    here = next(small(SimulatedDrive(hamlet, session)).frames(20, 21)).left
    difference = np.abs(np.load(out).astype(int) - here)
    assert difference.max() <= 1


@pytest.mark.parametrize(
    ("session", "name"),
    [
        (0, "clear"),
        pytest.param(2, "overcast", marks=pytest.mark.long),
        pytest.param(3, "night", marks=pytest.mark.long),
        (4, "rain"),
    ],
)
def test_the_world_looks_as_it_did(session: int, name: str, hamlet: Campaign) -> None:
    """A change of any picture is a change of the world: raise its version and store them anew."""
    stored = cv2.imread(str(Path(__file__).parent / "pictures" / f"{name}.png"), 0)
    here = next(small(SimulatedDrive(hamlet, session)).frames(20, 21)).left
    difference = np.abs(stored.astype(int) - here)
    # One grey level for another order of sums; more where rounding decides what a sample sees.
    assert (difference > 1).mean() < 0.001


def test_truth_says_what_the_pixels_show(drive: SimulatedDrive) -> None:
    truth = next(drive.truths(10, 11))
    assert truth.depth_m.shape == truth.kinds.shape == (96, 128)
    np.testing.assert_array_equal(np.isinf(truth.depth_m), truth.kinds == -1)
    # The lowest row looks at the ground close ahead: the camera's height over the pixel's slope.
    slope = (95 - drive.camera.cy) / drive.camera.fy
    ground = truth.kinds[-1] == Kind.GROUND
    assert ground.mean() > 0.5
    np.testing.assert_allclose(
        np.median(truth.depth_m[-1][ground]), drive.robot.height_m / slope, rtol=0.1
    )


def test_the_right_picture_shifted_by_true_disparity_is_the_left_one(
    drive: SimulatedDrive,
) -> None:
    pair, truth = next(drive.frames(10, 11)), next(drive.truths(10, 11))
    rows, columns = np.mgrid[:96, :128]
    there = columns - truth.disparity_px
    inside = (there > 1) & (there < 126) & np.isfinite(truth.depth_m)
    low = np.floor(there[inside]).astype(int)
    share = there[inside] - low
    right = pair.right.astype(float)
    at = rows[inside]
    guessed = right[at, low] * (1 - share) + right[at, low + 1] * share
    left = pair.left[inside].astype(float)
    # Not at occlusions, so a robust measure; unshifted the correlation is far lower.
    assert np.corrcoef(guessed, left)[0, 1] > 0.85
    assert np.median(np.abs(guessed - left)) < 6


def test_a_point_behind_a_wall_is_not_seen(drive: SimulatedDrive) -> None:
    truth = next(drive.truths(10, 11))
    row, column = 60, 64
    z = float(truth.depth_m[row, column])
    camera = drive.camera
    ray = np.array([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0])
    points = truth.world_from_cam @ np.stack([ray * z * 0.9, ray * z, ray * z * 1.2, -ray])
    assert truth.sees(points).tolist() == [True, True, False, False]


def test_unknown_names_and_numbers_are_refused(hamlet: Campaign) -> None:
    with pytest.raises(ConfigError, match="known are: hamlet"):
        campaign_named("atlantis")
    with pytest.raises(ConfigError, match="seed is -1"):
        campaign_named("hamlet", seed=-1)
    with pytest.raises(ConfigError, match="sessions 0 to 5, not 6"):
        SimulatedDrive(hamlet, 6)


@pytest.mark.parametrize("name", ["keble", "oxford"])
@given(seed=st.integers(0, 2**31 - 1))
@settings(max_examples=30)
def test_campaigns_of_few_drives_meet_sun_and_clouds(name: str, seed: int) -> None:
    """Each sky as often as its share of the summer, to within one drive of ten, but in rain."""
    drawn = Counter(session.weather for session in campaign_named(name, seed).sessions)
    rained = drawn["rain"] + drawn["damp"]
    assert 2 - rained <= drawn["clear"] <= 3
    assert 3 - rained <= drawn["overcast"] <= 4
    assert set(drawn) <= {"clear", "fair", "broken", "overcast", "rain", "damp"}
