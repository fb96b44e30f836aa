"""Injected faults do to a drive what they say; results are kept and counted."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest

from engram.frontend import StereoPair
from engram.geometry import SE3, StereoCamera
from engram.graph.model import NodeId
from engram_lab.studies.faults.clips import JUDGING, MAPPED, SETTING, Clip
from engram_lab.studies.faults.injected import FAULTS, Blackout, Frozen, Kidnapped, Stall
from engram_lab.studies.faults.page import headline, matrix
from engram_lab.studies.faults.study import (
    CARRIED,
    KINDS,
    Place,
    Trial,
    drawn,
    read_trials,
    run_trial,
)

CAMERA = StereoCamera(60.0, 60.0, 47.5, 31.5, 0.2, 96, 64)


@pytest.fixture
def pairs() -> list[StereoPair]:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (40, 2, 64, 96), dtype=np.uint8)
    return [StereoPair(k * 100_000_000, one[0], one[1], CAMERA) for k, one in enumerate(images)]


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_begins_at_its_start_and_changes_something_then(pairs, name: str) -> None:
    fault = FAULTS[name]
    assert fault.weakest <= fault.strongest
    shown = fault.apply(pairs, fault.strongest, 10, np.random.default_rng(1))
    for number, one in enumerate(shown[:10]):
        assert one.frame == number
        assert one.pair is pairs[number]
    assert [id(one.pair) for one in shown] != [id(pair) for pair in pairs]
    assert all(one.pair.left.dtype == np.uint8 for one in shown)
    assert all(one.pair.left.shape == (64, 96) for one in shown)


def test_a_stall_leaves_out_the_frames_of_its_time(pairs) -> None:
    shown = Stall().apply(pairs, 1.0, 10, np.random.default_rng(1))
    assert [one.frame for one in shown] == [*range(10), *range(20, 40)]


def test_a_frozen_stream_shows_the_image_before_it(pairs) -> None:
    shown = Frozen().apply(pairs, 3, 10, np.random.default_rng(1))
    assert all(shown[k].pair.left is pairs[9].left for k in (10, 11, 12))
    assert shown[13].pair is pairs[13]
    assert shown[11].pair.stamp_ns == pairs[11].stamp_ns


def test_a_blackout_ends(pairs) -> None:
    shown = Blackout().apply(pairs, 5, 10, np.random.default_rng(1))
    assert [int(one.pair.left.max()) == 0 for one in shown] == [10 <= k < 15 for k in range(40)]


def test_a_kidnapped_robot_is_elsewhere_and_its_stamps_go_on(pairs) -> None:
    shown = Kidnapped().apply(pairs, 12, 10, np.random.default_rng(1))
    assert shown[10].frame == 22
    assert [one.pair.stamp_ns for one in shown] == [k * 100_000_000 for k in range(len(shown))]


def test_trials_are_drawn_from_their_number_and_no_clip_of_the_limits_is_judged() -> None:
    first, again = (drawn(7, JUDGING) for _ in range(2))
    assert first[:2] == again[:2]
    assert first[1].session != MAPPED
    assert {drawn(number, JUDGING)[0] for number in range(len(KINDS))} == set(KINDS)
    assert not {plan.town for plan in SETTING} & {plan.town for plan in JUDGING}


def test_results_are_read_as_far_as_they_are_whole_and_counted(tmp_path: Path) -> None:
    trials = [
        Trial(0, "stall", "a", 15, 0.5, frames=50, fixes=40, again=0, driven_m=60.0),
        Trial(1, "stall", "a", 15, 3.0, frames=50, fixes=30, false=4, events=1, worst_m=7.5),
        Trial(2, "none", "a", 15, 0.0, frames=50, fixes=50, again=1),
    ]
    file = tmp_path / "trials.jsonl"
    file.write_text("\n".join(json.dumps(asdict(one)) for one in trials) + '\n{"number": 3, "f')
    assert read_trials(file) == trials
    assert "1 false events, largest error claimed 7.50 m" in headline(trials)
    rows = matrix(trials).splitlines()
    assert len(rows) == 2 + 1 + 2 + 1
    assert rows[-1].startswith("| all |  | 3 | 150 | 120 | 4 | 1 | 7.50 |")


def test_a_map_without_a_far_place_tells_no_robot_a_wrong_one(pairs) -> None:
    """Clips of a wide camera are short: all nodes may lie within 15 m of the robot."""
    place = Place.__new__(Place)
    here = SE3.identity()
    place.world_from_node = {NodeId(UUID(int=k)): here for k in range(1, 4)}
    clip = Clip(JUDGING[1], pairs, [here] * len(pairs))
    assert run_trial(2, CARRIED, clip, place, np.random.default_rng(1)) is None
    place.world_from_node[NodeId(UUID(int=9))] = SE3.exp([0, 0, 15.5, 0, 0, 0])
    assert place.nodes_off(here) == [NodeId(UUID(int=9))]
