"""Lost robots in a real map file: cold start, kidnapping, new places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from tests.builders import World, drive, errors_m, localise_simulated, map_simulated

from engram.localiser.localisation import LocalisationStatus

ROAD = World(length_m=120.0, seed=11)
ELSEWHERE = World(length_m=60.0, seed=12)


def test_a_cold_start_anywhere_is_found_at_once(mapped) -> None:
    path, made = mapped
    for start in (5.0, 37.5, 62.2, 90.4):
        live = drive(ROAD, start + np.arange(0, 3, 0.5), start_ns=2_000_000_000_000, seed=1)
        found = localise_simulated(path, live, relocaliser="fabmap")
        assert found[0].status is LocalisationStatus.LOCALISED
        # Two looks with 0.3 px noise at landmarks 5 to 40 m away.
        assert errors_m(found, live, made.saved).max() < 0.1


def test_a_kidnapped_robot_is_found_where_it_was_put(mapped) -> None:
    path, made = mapped
    places = np.concatenate([np.arange(10, 15, 0.5), np.arange(70, 85, 0.5)])
    live = drive(ROAD, places, start_ns=3_000_000_000_000, seed=2)
    before, after = live[:10], live[10:]
    # Odometry does not notice: the robot believes that it drove on by one step.
    after[0] = replace(after[0], odometry=before[-1].odometry)
    found = localise_simulated(path, before + after, relocaliser="fabmap")
    last = found[-1]
    assert last.status is LocalisationStatus.LOCALISED
    assert errors_m(found[-1:], live[-1:], made.saved).max() < 0.1


def test_somewhere_else_is_never_a_position(mapped) -> None:
    path, _ = mapped
    live = drive(ELSEWHERE, np.arange(0, 10, 1.0), start_ns=4_000_000_000_000)
    for one in localise_simulated(path, live, relocaliser="fabmap"):
        assert one.status is not LocalisationStatus.LOCALISED
        assert one.node_from_live is None


def test_two_drives_of_one_road_made_apart_are_joined(tmp_path: Path) -> None:
    path = tmp_path / "two.engram"
    map_simulated(path, drive(ROAD, np.arange(0, 40, 1.0)), name="first")
    again = map_simulated(
        path,
        drive(ROAD, np.arange(20, 60, 1.0), start_ns=5_000_000_000_000, seed=3),
        name="second",
    )
    # The second robot is not told where it is: it finds itself, and saves what lies beyond.
    assert again.statuses[0] == "localised"
    assert 5 <= len(again.saved) <= 22
    beyond = [world_from_node.translation[2] for world_from_node in again.saved.values()]
    assert min(beyond) > 39
