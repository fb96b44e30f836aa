"""A drive that has hung on nothing joins a map only where fixes agree for long enough."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.builders import PERIOD_NS, Seen, World, drive, map_simulated

from engram.geometry.se3 import SE3
from engram.maps.map import Map, open_map
from engram.odometry.step import OdometryStatus, OdometryStep

STEP_M = 0.7
# A street that was mapped, and others that are like nothing.
STREET, ELSEWHERE, BEYOND = World(90.0), World(130.0, seed=7), World(40.0, seed=8)


def along(world: World, length_m: float) -> list[Seen]:
    return drive(world, np.arange(0.0, length_m, STEP_M), seed=1)


def one_after_another(*parts: list[Seen]) -> list[Seen]:
    """One drive through all of them, straight ahead."""
    ahead = SE3(np.eye(3), np.array([0, 0, STEP_M]))
    covariance = np.diag([0.01**2] * 3 + [0.002**2] * 3)
    on = OdometryStep(OdometryStatus.OK, ahead, covariance, 100)
    whole = []
    for part in parts:
        for number, seen in enumerate(part):
            stamp_ns = 10**15 + len(whole) * PERIOD_NS
            odometry = on if whole and number == 0 else seen.odometry
            frame = replace(seen.frame, stamp_ns=stamp_ns)
            whole.append(replace(seen, frame=frame, odometry=odometry))
    return whole


def map_recorded(path: Path, seen: list[Seen]) -> None:
    map_simulated(path, seen, name="r2", rounds=4)


def map_live(path: Path, seen: list[Seen]) -> None:
    with (
        open_map(path) as opened,
        opened.robot(seen[0].frame.camera, name="r2", maps=True, ranking="path", rounds=4) as robot,
    ):
        for one in seen:
            robot.step(one.logged)


@pytest.fixture(scope="module")
def street_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mapped") / "street.engram"
    map_simulated(path, along(STREET, 88.0))
    return path


@pytest.mark.parametrize(
    ("mapped", "alone_m", "alike_m", "parts"),
    [
        (map_recorded, 120.0, 40.0, 2),  # alike for a while: nothing is joined
        pytest.param(map_recorded, 120.0, 86.0, 1, marks=pytest.mark.long),  # the street itself
        pytest.param(map_live, 110.0, 30.0, 2, marks=pytest.mark.long),
        (map_live, 60.0, 40.0, 1),  # a third of the way that it was alone
        (map_recorded, 20.0, 40.0, 1),
    ],
)
def test_a_drive_that_hung_on_nothing_joins_where_fixes_agree_along_a_share_of_it(
    street_map: Path,
    tmp_path: Path,
    mapped: Callable[[Path, list[Seen]], None],
    alone_m: float,
    alike_m: float,
    parts: int,
) -> None:
    path = shutil.copy(street_map, tmp_path / "street.engram")
    before, alike, after = along(ELSEWHERE, alone_m), along(STREET, alike_m), along(BEYOND, 38.0)
    mapped(path, one_after_another(before, alike, after))
    with Map.open(path) as opened:
        assert len(np.unique(opened.graph.components())) == parts
