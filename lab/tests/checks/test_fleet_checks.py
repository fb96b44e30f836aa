"""The small checks of a fleet: cameras stand where they are said to, shares add up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engram.measures import Drive
from engram_lab.checks.both_directions import Missed, apart, by_drive, of_length, pair_of, town_of
from engram_lab.checks.dreams import HANDED_IN, HELD_OUT, VALIDATION, made_once
from engram_lab.checks.dreams import told as told_of_held_out
from engram_lab.checks.lenses import told
from engram_lab.checks.mountings import MOUNTED, MountedSequence
from engram_lab.town.session import SimulatedSequence
from engram_lab.town.simulating import campaign_folder
from engram_lab.trial_towns import longer_trial_town, trial_town


def test_a_mounted_camera_stands_higher_and_aside_and_looks_down():
    town = longer_trial_town(401)
    usual, other = SimulatedSequence(town, 6), MountedSequence(town, 6, MOUNTED)
    for a, b in zip(usual.truth().world_from_cam, other.truth().world_from_cam, strict=True):
        np.testing.assert_allclose((a.inverse() @ b).matrix(), MOUNTED.matrix(), atol=1e-9)
    before, after = usual.drive.poses[9].world_from_cam, other.drive.poses[9].world_from_cam
    assert after.translation[2] - before.translation[2] == pytest.approx(0.5, abs=0.03)
    down = np.rad2deg(np.arcsin(before.matrix()[2, 2]) - np.arcsin(after.matrix()[2, 2]))
    assert down == pytest.approx(10.0, abs=0.1)
    assert other.camera.cam_from_rig is not None
    np.testing.assert_allclose(
        (other.camera.cam_from_rig @ MOUNTED).matrix(), np.eye(4), atol=1e-12
    )
    assert other.camera.id != usual.camera.id


def test_a_longer_trial_town_begins_with_the_shorter_one():
    short, longer = trial_town(401), longer_trial_town(401)
    assert longer.sessions[: len(short.sessions)] == short.sessions
    assert [one.number for one in longer.sessions] == list(range(15))
    assert len({one.seed for one in longer.sessions}) == 15
    assert [one.reverse for one in longer.sessions] == [False] * 12 + [True] * 3


def test_the_share_of_the_loss_is_paired_over_towns():
    text = told(np.array([[0.10, 0.04, 0.0], [0.06, 0.02, 0.02]]))
    assert "8.0% ignored, 3.0% known, 1.0% through" in text
    assert "spared 5.0 points (4.0 … 6.0)" in text
    assert "71% of the loss (60% … 100%)" in text


def test_directions_are_compared_over_drives_however_many_maps_each_was_tried_in():
    found = [Missed(8, False, 0.0, None), Missed(9, True, 0.1, None), Missed(8, False, 0.2, None),
             Missed(7, True, 0.2, None), Missed(9, True, 0.3, None)]  # fmt: skip
    usual, against = by_drive(found, reverse=False), by_drive(found, reverse=True)
    np.testing.assert_allclose((usual, against[:1]), [[0.1], [0.2]])
    assert len(against) == 2
    more = apart(usual, np.array([0.1, 0.3]))
    assert more.estimate == pytest.approx(0.1)
    assert (more.low, more.high) == (pytest.approx(0.0), pytest.approx(0.2))
    assert pair_of("8,9") == [8, 9]
    assert [town_of(name).name for name in ("oxford", "401")] == ["oxford", "trial"]
    shorter = of_length(town_of("oxford"), 600.0)
    assert campaign_folder(Path(), shorter) != campaign_folder(Path(), town_of("oxford"))
    assert len(SimulatedSequence(shorter, 1)) == pytest.approx(600 / 0.7, rel=0.1)
    assert of_length(shorter, None) is shorter


def test_what_judges_a_dream_took_no_part_in_it_and_its_maps_are_made_once(tmp_path):
    assert len({*HANDED_IN, *VALIDATION, *HELD_OUT}) == 12
    with pytest.raises(ZeroDivisionError):
        made_once(tmp_path / "a.engram", lambda path: (path.write_text("half"), 1 / 0))
    assert not list(tmp_path.glob("*.engram"))
    before = [Drive(np.ones(10), np.arange(10) < n) for n in (5, 8)]
    after = [Drive(np.ones(10), np.arange(10) < n) for n in (6, 9)]
    assert told_of_held_out(before, after) == (
        "held-out drives miss 35.00% before, 25.00% after: better by 10.00 points (10.00 … 10.00)"
    )
