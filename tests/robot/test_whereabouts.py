"""A robot that maps has a place in the map frame, from its first frame on."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.localisation import Position
from engram.maps.map import open_map
from engram.robot.mapping import Beginning, map_drive
from engram.robot.robot import DisplayPose
from engram.robot.settings import RobotOptions
from engram.sequences.opening import open_drive


def test_a_first_drive_lies_where_the_committed_frame_will_have_it(
    street: Path, tmp_path: Path
) -> None:
    path = tmp_path / "street.engram"
    seen: list[tuple[object, SE3 | None]] = []

    def begin(begun: Beginning) -> None:
        display_pose = DisplayPose(begun.opened.frame, begun.robot.graph)
        begun.robot.watch = lambda _, found: seen.append((found.saved, display_pose.after(found)))

    map_drive(path, open_drive(street, frames="::2"), begin=begin)
    assert seen
    assert all(map_from_live is not None for _, map_from_live in seen)
    with open_map(path) as opened:
        away_m = [
            np.linalg.norm(here.translation - opened.frame.pose(saved).translation)
            for saved, here in seen
            if saved is not None and here is not None
        ]
    assert len(away_m) > 3
    # The layout also levels the ground, so heights differ a little.
    assert max(away_m) < 0.5


def test_a_second_drive_lies_in_the_frame_of_the_first(street: Path, tmp_path: Path) -> None:
    path = tmp_path / "street.engram"
    map_drive(path, open_drive(street, frames="::2"))
    here = []

    def begin(begun: Beginning) -> None:
        display_pose = DisplayPose(begun.opened.frame, begun.robot.graph)
        begun.robot.watch = lambda _, found: here.append((found, display_pose.after(found)))

    map_drive(path, open_drive(street, frames="1::2"), options=RobotOptions(), begin=begin)
    with open_map(path) as opened:
        for found, map_from_live in here:
            if found.localised:
                expected = opened.frame.pose(found.node) @ found.node_from_live
                assert map_from_live is not None
                np.testing.assert_allclose(
                    map_from_live.translation, expected.translation, atol=0.5
                )
            elif found.position is None:
                assert map_from_live is None


def test_what_a_lost_robot_saved_lies_where_the_graph_joins_it(
    street: Path, tmp_path: Path
) -> None:
    path = tmp_path / "street.engram"
    map_drive(path, open_drive(street, frames="::2"))
    with open_map(path) as opened:
        nodes, frame = opened.graph.nodes, opened.frame

        class Half:
            """The frame of the nodes that were committed: the first half."""

            is_empty = False

            def find(self, node: NodeId) -> SE3 | None:
                return frame.find(node) if opened.graph.index(node) < len(nodes) // 2 else None

        display_pose = DisplayPose(Half(), opened.graph)  # type: ignore[arg-type]

        def at(node: NodeId) -> Any:
            position = Position(node, SE3.identity(), np.eye(6))
            return SimpleNamespace(position=position, saved=None)

        assert display_pose.after(at(nodes[-1].id)) is None, "nothing with a place was seen yet"
        assert display_pose.after(at(nodes[0].id)) is not None
        here = display_pose.after(at(nodes[-1].id))
        assert here is not None
        expected = frame.pose(nodes[-1].id).translation
        np.testing.assert_allclose(here.translation[:2], expected[:2], atol=0.5)
