"""Edges that live fixes contradict again and again."""

from itertools import pairwise
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
from tests.builders import World, drive

from engram.frontend.matching import Match
from engram.geometry.cameras import CameraId
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Edge, EdgeKind, Node, NodeId, SessionId
from engram.localiser.attempts import Candidate, Outcome
from engram.localiser.localisation import Position
from engram.mapper.mapper import EdgeVotes, VoteConfig
from engram.maps.map import open_map

SURE = 1e-4 * np.eye(6)
NOTHING = np.zeros(0, np.int32)
LENGTH = 12
LOOKS = VoteConfig().against


def at(x_m: float, z_m: float) -> SE3:
    return SE3(np.eye(3), np.array([x_m, 0.0, z_m]))


def streets(off_m: float) -> ExperienceGraph:
    """Two drives of one street, half a metre apart; one match of the fifth nodes ties them."""
    graph = ExperienceGraph()
    for session in (1, 2):
        for k in range(LENGTH):
            name = NodeId(UUID(int=100 * session + k))
            graph.add_node(Node(name, SessionId(UUID(int=session)), k, CameraId("c"), float(k)))
        own = graph.nodes[-LENGTH:]
        for a, b in pairwise(own):
            graph.add_edge(Edge(a.id, b.id, EdgeKind.ODOMETRY, at(0, 1), SURE))
    a, b = graph.node(5).id, graph.node(LENGTH + 5).id
    graph.add_edge(Edge(a, b, EdgeKind.MATCH, at(0.5, off_m), SURE))
    return graph


def frame(graph: ExperienceGraph, k: int, inliers: int = 70) -> list[Outcome]:
    """What a frame beside the k-th nodes matches: a node of each drive."""
    return [
        Outcome(
            Candidate(node, graph.node(node).id, None, guided=False, row=None),
            rank,
            Match(at(x_m, 0.2), SURE, inliers, NOTHING, NOTHING),
            accepted=rank == 0,
        )
        for rank, (node, x_m) in enumerate(((k, 0.3), (LENGTH + k, -0.2)))
    ]


def test_what_fixes_contradict_again_and_again_is_distrusted_at_once() -> None:
    graph = streets(off_m=9.0)
    votes = EdgeVotes(graph)
    for k in range(LOOKS - 1):
        votes.count(k, frame(graph, k))
    assert not votes.removals
    votes.count(LOOKS, frame(graph, LOOKS))
    (removal,) = votes.removals
    assert removal.a == graph.node(5).id
    assert removal.a_from_b.distance_m == pytest.approx(np.hypot(0.5, 9.0))
    known = graph.predict(3, LENGTH + 3)
    assert known is not None
    assert np.sqrt(known[1][0, 0]) > 100.0


def test_what_fixes_confirm_stays() -> None:
    graph = streets(off_m=0.0)
    votes = EdgeVotes(graph)
    for k in range(LENGTH):
        votes.count(k, frame(graph, k))
    assert not votes.removals


def test_weak_matches_do_not_vote() -> None:
    graph = streets(off_m=9.0)
    votes = EdgeVotes(graph)
    for k in range(LENGTH):
        votes.count(k, frame(graph, k, inliers=VoteConfig().inliers - 1))
    assert not votes.removals


def test_a_robot_that_maps_removes_a_planted_edge_with_its_session(tmp_path: Path) -> None:
    path, world, road = tmp_path / "town.engram", World(40.0), np.arange(0.0, 30.0, 0.7)
    drives = [drive(world, road, seed=k, start_ns=(k + 1) * 10**15) for k in range(3)]
    camera = drives[0][0].frame.camera
    for number, seen in enumerate(drives[:2]):  # the second is lost, and maps the street again
        with (
            open_map(path, create=True) as town,
            town.robot(camera, name=f"r{number}", maps=True, relocaliser=None) as robot,
        ):
            for one in seen:
                robot.step(one.logged)
    with open_map(path) as town:
        # Some metres on: the third robot's first matches do not vote yet.
        a, b = (
            [node.id for node in town.graph.nodes if town.sessions[node.session].robot == name][8]
            for name in ("r0", "r1")
        )
        false = Edge(a, b, EdgeKind.MATCH, at(0.0, 6.0), SURE)
        with (
            town.writing(),
            town.begin_revision(author="test", message="plant", configuration={}) as writer,
        ):
            writer.add_edge(false)
            writer.commit()
    with (
        open_map(path) as town,
        town.robot(camera, name="r2", maps=True, lanes=8, relocaliser=None) as robot,
    ):
        first = next(iter(town.graph.nodes)).id
        robot.place_at(Position.at(first))
        found = [robot.step(one.logged) for one in drives[2]]
    assert sum(one.localised for one in found) > 30
    with open_map(path) as town:
        assert (false.a, false.b) in {(one.a, one.b) for one in town.removals}
        assert town.graph.find_edge(a, b, EdgeKind.MATCH) is None
