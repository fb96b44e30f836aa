"""A mapping robot that is told another place than it knows joins nothing by that word alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.builders import World, drive, map_simulated

from engram.localiser.localisation import Position
from engram.maps.map import open_map

ROAD = np.arange(0.0, 40.0, 0.7)


@pytest.mark.parametrize("knew", [True, False])
def test_a_place_that_is_said_ties_only_a_robot_that_knows_none(tmp_path: Path, knew: bool) -> None:
    path = tmp_path / "town.engram"
    here = drive(World(40.0), ROAD)
    map_simulated(path, here)
    start_ns = here[0].frame.stamp_ns + 10**12
    again = drive(World(40.0), ROAD[:10], seed=1, start_ns=start_ns)
    new = drive(World(40.0, seed=1), ROAD[:20], start_ns=start_ns)[10:]
    with (
        open_map(path) as town,
        town.robot(new[0].frame.camera, name="r", maps=True) as robot,
    ):
        nodes = list(town.graph.nodes)
        if knew:
            robot.place_at(Position.at(nodes[0].id))
            found = [robot.step(one.logged).localised for one in again]
            assert all(found)
        robot.place_at(Position.at(nodes[-1].id))
        found = [robot.step(one.logged).localised for one in new]
        assert not any(found)
    with open_map(path) as town:
        # Where it was said to be, and where it came from, is 25 m apart.
        far = {node.id for node in nodes[-10:]}
        live = {node.id for node in town.graph.nodes} - {node.id for node in nodes}
        assert live
        across = [edge for edge in town.graph.edges if {edge.a, edge.b} & far and edge.b in live]
        assert bool(across) is not knew


def test_a_fix_where_it_was_said_to_be_ties_it(tmp_path: Path) -> None:
    path = tmp_path / "town.engram"
    here = drive(World(40.0), ROAD)
    map_simulated(path, here)
    start_ns = here[0].frame.stamp_ns + 10**12
    new = drive(World(40.0, seed=1), ROAD[:20], start_ns=start_ns)
    again = drive(World(40.0), ROAD, seed=1, start_ns=start_ns)
    with open_map(path) as town, town.robot(new[0].frame.camera, name="r", maps=True) as robot:
        nodes = list(town.graph.nodes)
        for one in new[:10]:
            robot.step(one.logged)
        robot.place_at(Position.at(nodes[0].id))
        found = [robot.step(one.logged).localised for one in again[10:20]]
        assert any(found)
    with open_map(path) as town:
        assert len(set(town.graph.components().tolist())) == 1
