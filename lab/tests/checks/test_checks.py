"""Checks on small cases: random maps that are merged, a long drive."""

from __future__ import annotations

import numpy as np
import pytest
from tests.builders import World, drive

from engram.geometry.se3 import SE3
from engram.sequences.sequence import LoggedFrame
from engram_lab.checks import merge_graphs, soak


@pytest.mark.parametrize("seed", range(2))
def test_what_must_hold_of_a_merge_holds_for_random_maps(seed):
    assert merge_graphs.told(seed).violations == []


def test_a_centre_without_edges_can_be_downloaded_from():
    case = merge_graphs.told(46)
    assert (case.violations, case.sent) == ([], "copy")


@pytest.mark.long
def test_what_must_hold_of_a_merge_holds_for_many_random_maps():
    cases = [merge_graphs.told(seed) for seed in range(1000, 1100)]
    assert [found for case in cases for found in case.violations] == []
    assert {"copy", "tod", "paths", "tod+paths", "budget", "region"} <= {
        case.sent for case in cases
    }


def test_each_pair_of_blocks_starts_at_the_same_frame() -> None:
    starts: dict[str, list[int]] = {"old": [], "fresh": []}

    def run(name: str, seconds: float):
        def block(first: int) -> float:
            starts[name].append(first)
            return seconds

        return block

    figures = {
        one.name: one.value
        for one in soak.compared(run("old", 0.3), run("fresh", 0.2), 7, "old", "fresh")
    }
    assert starts["old"] == starts["fresh"]
    assert starts["old"][:2] == [7, 7 + 50]
    assert figures["ratio, median"] == pytest.approx(1.5)
    assert figures["a frame old"] == pytest.approx(6.0)


def test_there_and_back_ends_where_it_began() -> None:
    seen = drive(World(6.0), np.arange(4.0), 0, start_ns=0, seed=0)
    entries = [LoggedFrame(one.frame, one.odometry) for one in seen]
    frame_at = soak.there_and_back(entries)
    lap = [frame_at(number) for number in range(1, 7)]  # 1 2 3 2 1 0
    pose = SE3.identity()
    for one in lap:
        assert one.odometry.prev_from_curr is not None
        pose = pose @ one.odometry.prev_from_curr
    assert pose.distance_m < 1e-12
    assert lap[-1].frame.landmarks is entries[0].frame.landmarks
    stamps_ns = [one.frame.stamp_ns for one in lap]
    assert stamps_ns == sorted(set(stamps_ns))
