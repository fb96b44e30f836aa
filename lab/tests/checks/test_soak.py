"""The soak compares blocks of the same frames, in a map whose lanes are candidates."""

from pathlib import Path

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram.localiser.localisation import Position
from engram.maps.map import Map
from engram_lab.checks import soak


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


def test_a_robot_beside_the_road_has_its_lanes_as_candidates_and_saves_nodes(
    tmp_path: Path,
) -> None:
    beside = soak.write_road(tmp_path / "road.engram", 200)
    with Map.open(tmp_path / "road.engram") as opened:
        robot = opened.robot(soak.CAMERA, name="r", maps=True, relocaliser=None)
    with robot:
        robot.place_at(Position(beside, SE3(np.eye(3), np.array([1.5, 0, 0])), np.eye(6) * 1e-4))
        steps = [robot.step(soak.lane_frame(number)) for number in range(30)]
    assert not any(one.localised for one in steps)
    assert sum(one.saved is not None for one in steps) == 6
    assert steps[-1].candidates > 20


def test_there_and_back_ends_where_it_began() -> None:
    entries = [soak.lane_frame(number) for number in range(4)]
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
