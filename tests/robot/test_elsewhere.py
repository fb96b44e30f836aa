"""A robot whose images go on elsewhere is lost until it finds itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from tests.builders import World, drive, map_simulated

from engram.localiser.localisation import LocalisationStatus, Position
from engram.maps.map import open_map
from engram.odometry.step import OdometryStatus, OdometryStep

ROAD = np.arange(0.0, 30.0, 0.7)


def test_it_is_lost_where_nothing_is_known_and_found_where_the_map_is(tmp_path: Path) -> None:
    here = drive(World(30.0), ROAD)
    map_simulated(tmp_path / "town.engram", here)
    elsewhere = drive(World(30.0, seed=1), ROAD, start_ns=here[0].frame.stamp_ns)
    failed = OdometryStep(OdometryStatus.NO_CONSENSUS)
    shown = [one.logged for one in here[:15]]
    shown += [replace(elsewhere[15].logged, odometry=failed)]
    shown += [one.logged for one in elsewhere[16:20]]
    shown += [one.logged for one in here[20:25]]
    with open_map(tmp_path / "town.engram") as town, town.robot(here[0].frame.camera) as robot:
        robot.place_at(Position.at(town.graph.node(0).id))
        found = [robot.step(one).status for one in shown]
    assert set(found[:15]) == {LocalisationStatus.LOCALISED}
    assert found[15] is LocalisationStatus.NO_ODOMETRY
    assert set(found[16:20]) == {LocalisationStatus.LOST}
    assert LocalisationStatus.LOCALISED in found[20:]
