"""Both directions of a road are experiences of one road, tied where the robot turned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.builders import Seen, World, localised, map_simulated, see

from engram.fleet.download.downloading import download
from engram.fleet.download.mission import DownloadOptions
from engram.geometry.se3 import SE3
from engram.graph.neighbourhood import Search
from engram.localiser.localisation import Budget, Position
from engram.maps.map import Map
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.robot.localisers import localiser_in
from engram.robot.settings import Settings

LENGTH_M = 60.0
WORLD = World(LENGTH_M, seed=21)
STEP_M, TURN_RAD = 0.7, np.deg2rad(12.0)
PERIOD_NS = 400_000_000  # at walking pace, so that the turn is believed


def there(start_m: float, end_m: float) -> list[SE3]:
    return [WORLD.pose_at(s) for s in np.arange(start_m, end_m, STEP_M)]


def turned(at: SE3) -> list[SE3]:
    """A turn of 180° on a circle of 1.5 m, to the left lane of the way back."""
    count = round(np.pi / TURN_RAD)
    step = SE3.exp([0, 0, 1.5 * TURN_RAD, 0, -TURN_RAD, 0])
    poses = [at]
    for _ in range(count):
        poses.append(poses[-1] @ step)
    return poses[1:]


def on(at: SE3, length_m: float) -> list[SE3]:
    return [at @ SE3.exp([0, 0, s, 0, 0, 0]) for s in np.arange(STEP_M, length_m, STEP_M)]


def there_and_back(turn_m: float, back_m: float, start_m: float = 0.0) -> list[SE3]:
    poses = there(start_m, turn_m)
    poses += turned(poses[-1])
    return poses + on(poses[-1], back_m)


def drive_along(poses: list[SE3], start_ns: int, seed: int) -> list[Seen]:
    """Frames along a way, with odometry of 1 % and 0.1° of noise a step."""
    rng = np.random.default_rng(seed)
    steps: list[Seen] = []
    for i, truth in enumerate(poses):
        frame = see(WORLD, truth, start_ns + i * PERIOD_NS)
        odometry = OdometryStep(OdometryStatus.FIRST)
        if steps:
            motion = steps[-1].world_from_live.inverse() @ truth
            sigma_m = 0.003 + 0.01 * motion.distance_m
            sigma = np.array([sigma_m] * 3 + [np.deg2rad(0.1)] * 3)
            noisy = SE3.exp(rng.normal(0, sigma)) @ motion
            odometry = OdometryStep(OdometryStatus.OK, noisy, np.diag(sigma**2), 100)
        steps.append(Seen(frame, odometry, truth))
    return steps


@pytest.fixture(scope="module", params=["one drive", "two drives"])
def road(request, tmp_path_factory) -> Path:
    """A drive to the end of the road, and back; or a drive along it, and another that turned."""
    path = tmp_path_factory.mktemp("road") / "road.engram"
    if request.param == "one drive":
        map_simulated(path, drive_along(there_and_back(50.0, 48.0), 10**14, 1))
    else:
        map_simulated(path, drive_along(there(0.0, 50.0), 10**14, 1))
        map_simulated(path, drive_along(there_and_back(49.0, 48.0, 40.0), 2 * 10**14, 3), "r2")
    return path


@pytest.fixture(scope="module")
def one_way(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("road") / "one_way.engram"
    map_simulated(path, drive_along(there(0.0, 50.0), 10**14, 1))
    return path


def turning_back(path: Path):
    """A robot that turns round in the middle of the road; what it finds after the turn.

    Without a relocaliser: it can only go on from where it knows to be.
    """
    poses = there_and_back(25.0, 20.0, start_m=5.0)
    live = drive_along(poses, 10**15, 2)
    after = len(there(5.0, 25.0)) + len(turned(poses[0]))
    with Map.open(path) as opened, localiser_in(
        opened, live[0].frame.camera, Settings(), relocaliser=None, budget=Budget(2, 2)
    ) as localiser:  # fmt: skip
        first = min(opened.graph.nodes, key=lambda node: abs(node.driven_m - 5.0))
        localiser.place_at(Position(first.id, SE3.identity(), 0.01 * np.eye(6)))
        found = localised(localiser, live)
    return found[after:]


def test_a_robot_that_turns_round_localises_again_at_once(road):
    found = turning_back(road)
    assert all(one.localised for one in found[:3])
    assert np.mean([one.localised for one in found]) > 0.95
    assert sum(one.proposed for one in found) == 0


def test_a_map_of_one_direction_alone_does_not_show_the_other(one_way):
    found = turning_back(one_way)
    assert not any(one.localised for one in found[5:])


def test_nodes_of_both_directions_are_in_one_neighbourhood(road):
    with Map.open(road) as opened:
        graph = opened.graph
        assert graph.components().max() == 0
        first = graph.nodes[0].session
        node = min(
            (one for one in graph.nodes if one.session == first),
            key=lambda one: abs(one.driven_m - 25.0),
        )
        near = graph.neighbourhood(
            graph.index(node.id), SE3.identity(), np.zeros((6, 6)), Search(8.0, np.pi)
        )
        headings = np.abs(near.yaw_rad)
        assert (headings < 0.5).sum() > 5
        assert (headings > np.pi - 0.5).sum() > 5


def headings_of(opened: Map):
    """Each node with its heading relative to the first one, by the edges."""
    tree = opened.graph.chains_from(0)
    for node in opened.graph.nodes:
        yield node, abs(tree.pose(opened.graph.index(node.id)).yaw_rad)


@pytest.mark.parametrize("policy", ["route", "region"])
def test_routes_and_regions_take_both_directions(road, tmp_path, policy):
    with Map.open(road) as opened:
        session = next(iter(opened.sessions))
        along = [node for node in opened.graph.nodes if node.session == session]
        middle = min(along, key=lambda one: abs(one.driven_m - 25.0))
        headings = {node.id: heading for node, heading in headings_of(opened)}
    options = (
        DownloadOptions("route", route=str(session), radius_m=8.0)
        if policy == "route"
        else DownloadOptions("region", near=(str(middle.id),), radius_m=6.0)
    )
    download(road, tmp_path / "part.engram", options)
    with Map.open(tmp_path / "part.engram") as part:
        sent = [headings[node.id] for node in part.graph.nodes]
        assert part.graph.components().max() == 0
    assert min(sent) < 0.5
    assert max(sent) > np.pi - 0.5
