"""Robots with other lenses and mountings in one map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.builders import (
    CAMERA,
    Seen,
    World,
    covariance_of,
    drive,
    forward,
    localised,
    make_edge,
    map_simulated,
    see,
)

from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Session
from engram.graph.neighbourhood import Search
from engram.localiser.acceptance import Lenses
from engram.localiser.localisation import Budget, Position
from engram.maps.map import Map
from engram.ranking.policies import policy_named
from engram.robot.localisers import localiser_in
from engram.robot.settings import Settings
from engram.testing.contracts import make_node

WORLD = World(40.0, seed=3)
ROAD = np.arange(0.0, 30.0, 0.7)
# 0.5 m higher (y points down), 0.3 m to the right, pitched 10° down.
MOUNTING = SE3.exp([0.3, -0.5, 0.0, 0.0, 0.0, 0.0]) @ SE3.exp([0, 0, 0, -np.deg2rad(10.0), 0, 0])
SURE = covariance_of(0.05, np.deg2rad(0.5))


def two_lenses() -> tuple[ExperienceGraph, dict, dict]:
    """Two drives of five nodes side by side, the second with a lens twice as long."""
    graph = ExperienceGraph()
    wide, long = CAMERA, StereoCamera(800.0, 800.0, 320.0, 240.0, 0.3, 640, 480)
    nodes = [make_node(session, i) for session in (0, 1) for i in range(5)]
    for node in nodes:
        graph.add_node(node)
    for session in (0, 5):
        for a, b in zip(
            nodes[session : session + 4], nodes[session + 1 : session + 5], strict=True
        ):
            graph.add_edge(make_edge(a.id, b.id, forward(1.0)))
    graph.add_edge(make_edge(nodes[0].id, nodes[5].id, SE3.identity()))
    sessions = {
        nodes[0].session: Session(nodes[0].session, "a", wide.id, 0),
        nodes[5].session: Session(nodes[5].session, "b", long.id, 0),
    }
    return graph, sessions, {wide.id: wide, long.id: long}


def test_a_longer_lens_is_most_alike_from_farther_ahead():
    graph, sessions, cameras = two_lenses()
    near = graph.neighbourhood(2, SE3.identity(), covariance_of(1e-4, 1e-5), Search(8.0, 1.0))
    seen = Lenses(graph, sessions, cameras, 400.0, 7.0).as_seen(near)
    shift_m = 7.0 * (1 - 400.0 / 800.0)
    of_long = near.nodes >= 5
    np.testing.assert_allclose(seen.along_m[of_long], near.along_m[of_long] - shift_m)
    np.testing.assert_array_equal(seen.along_m[~of_long], near.along_m[~of_long])
    np.testing.assert_allclose(seen.distance_m, np.abs(seen.along_m), atol=1e-6)
    assert seen.node_from_live is near.node_from_live  # predictions stay what they are


def test_equal_lenses_change_nothing_and_zero_turns_it_off():
    graph, sessions, cameras = two_lenses()
    near = graph.neighbourhood(2, SE3.identity(), covariance_of(1e-4, 1e-5), Search(8.0, 1.0))
    assert Lenses(graph, sessions, cameras, 400.0, 0.0).as_seen(near) is near
    same = {session: replace(one, camera=CAMERA.id) for session, one in sessions.items()}
    assert Lenses(graph, same, cameras, 400.0, 7.0).as_seen(near) is near
    assert Lenses(graph, {}, {}, 400.0, 7.0).as_seen(near) is near


class Asked:
    """A policy that keeps the contexts it was asked with."""

    uses_words = False

    def __init__(self, name: str) -> None:
        self.name, self.policy, self.contexts = name, policy_named(name), []

    def rank(self, context):
        self.contexts.append(context)
        return self.policy.rank(context)


@pytest.mark.parametrize("name", ["recall", "path-near", "distance", "path"])
def test_recall_and_path_near_know_each_nodes_lens(tmp_path, name):
    path = tmp_path / "street.engram"
    map_simulated(path, drive(WORLD, ROAD))
    short = StereoCamera(250.0, 250.0, 320.0, 240.0, 0.3, 640, 480)
    live = drive(WORLD, ROAD[10:20], start_ns=10**15, camera=short, seed=2)
    asked = Asked(name)
    with Map.open(path) as opened, localiser_in(
        opened, short, Settings(), policy=asked, relocaliser=None, budget=Budget(2, 1)
    ) as localiser:  # fmt: skip
        localiser.place_at(Position.at(opened.graph.node(7).id))
        localised(localiser, live)
        context = asked.contexts[-1]
        with_lens = asked.policy.rank(context).tolist()
        without = asked.policy.rank(replace(context, seen=None)).tolist()
    assert context.seen is not None
    shift_m = context.neighbourhood.along_m - context.as_seen.along_m
    np.testing.assert_allclose(shift_m, 7.0 * (1 - 250.0 / 400.0))
    assert (with_lens != without) is (name in {"recall", "path-near"})


def mounted_drive(mounting: SE3) -> list[Seen]:
    """The same drive of the robot, with its camera mounted otherwise on it."""
    plain = drive(WORLD, ROAD, start_ns=10**15, seed=8)
    steps = []
    for seen in plain:
        world_from_live = seen.world_from_live @ mounting
        frame = see(WORLD, world_from_live, seen.frame.stamp_ns, camera=CAMERA)
        odometry = seen.odometry
        if odometry.prev_from_curr is not None:
            moved = mounting.inverse() @ odometry.prev_from_curr @ mounting
            odometry = replace(odometry, prev_from_curr=moved)
        steps.append(Seen(frame, odometry, world_from_live))
    return steps


@pytest.mark.parametrize("seeded", [True, False])
def test_a_camera_mounted_otherwise_localises_as_equal_rigs_do(tmp_path, seeded):
    path = tmp_path / "street.engram"
    map_simulated(path, drive(WORLD, ROAD))
    node_rig = replace(CAMERA, cam_from_rig=SE3.identity())
    found = {}
    for name, rig_from_cam in (("equal", SE3.identity()), ("other", MOUNTING)):
        rig = replace(CAMERA, cam_from_rig=rig_from_cam.inverse())
        with Map.open(path) as opened, localiser_in(
            opened, CAMERA, Settings(), relocaliser=None if seeded else "exhaustive"
        ) as localiser:  # fmt: skip
            if seeded:
                first = opened.graph.node(0).id
                localiser.place_at(Position.mounted(first, node_rig, rig, SURE))
            results = localised(localiser, mounted_drive(rig_from_cam))
        found[name] = np.mean([one.localised for one in results])
    assert found["equal"] > 0.9
    assert found["other"] >= 0.95 * found["equal"]


def test_a_start_that_ignores_the_mounting_is_not_believed(tmp_path):
    path = tmp_path / "street.engram"
    map_simulated(path, drive(WORLD, ROAD))
    with Map.open(path) as opened, localiser_in(
        opened, CAMERA, Settings(), relocaliser=None
    ) as localiser:  # fmt: skip
        node = opened.graph.node(0).id
        localiser.place_at(Position(node, SE3.identity(), SURE))
        (first,) = localised(localiser, mounted_drive(MOUNTING)[:1])
        assert not first.localised
        unknown = Position.mounted(node, CAMERA, CAMERA, SURE)
    assert unknown.node_from_live.distance_m == 0


def test_a_robot_that_stands_at_a_node_is_placed_by_both_mountings(tmp_path):
    path, node_rig = tmp_path / "street.engram", replace(CAMERA, cam_from_rig=SE3.identity())
    map_simulated(path, drive(WORLD, ROAD[:3], camera=node_rig))
    live = drive(WORLD, ROAD[:1], camera=replace(CAMERA, cam_from_rig=MOUNTING.inverse()))
    with Map.open(path) as opened, localiser_in(
        opened, live[0].frame.camera, Settings(), relocaliser=None
    ) as localiser:  # fmt: skip
        standing = localiser.standing_at(opened.graph.node(0).id, live[0].frame, SURE)
    np.testing.assert_allclose(standing.node_from_live.matrix(), MOUNTING.matrix(), atol=1e-12)
