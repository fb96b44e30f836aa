"""Segments that begin behind a gap of odometry, found from where the one before ended."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from uuid import uuid4

import numpy as np
import pytest
from tests.builders import PERIOD_NS, drive, map_simulated

from engram.fleet.merge.replay import Segment, position_behind_gap
from engram.fleet.merge.report import Seed
from engram.geometry.se3 import SE3
from engram.graph.model import Edge, EdgeKind, Node, SessionId, node_id
from engram.localiser.localisation import Position
from engram.maps.map import open_map
from engram.odometry.motion import GapConfig
from engram.odometry.step import OdometryStatus, OdometryStep

from .robots import DAY_NS, WORLD, merged, robot_map, truth_of


def mapped_with_gap(path, appearance):
    """A drive of 40 m, a metre a frame, that loses track from 15 to 24 m."""
    steps = drive(WORLD, np.arange(40.0), appearance, start_ns=2 * DAY_NS, seed=2)
    lost = OdometryStep(OdometryStatus.NO_CONSENSUS)
    steps[15:24] = [replace(one, odometry=lost) for one in steps[15:24]]
    return map_simulated(path, steps, "r2")


def test_a_segment_behind_a_gap_is_found_from_where_the_one_before_ended(tmp_path):
    first = robot_map(tmp_path / "r1.engram", np.arange(40.0))
    second = mapped_with_gap(tmp_path / "r2.engram", appearance=0)
    centre = tmp_path / "centre.engram"
    _, report = merged(centre, tmp_path / "r1.engram", tmp_path / "r2.engram")
    before, behind = report.segments
    assert (before.seed, behind.seed) == (Seed.PLACE, Seed.GAP)
    assert behind.omitted > 10
    assert report.components == 1
    truth = truth_of(first, second)
    with open_map(centre) as opened:
        omissions = opened.omissions.values()
        assert len(omissions) == report.omitted
        for one in omissions:
            true = truth[one.node].inverse() @ truth[one.omitted]
            assert (one.node_from_omitted.inverse() @ true).distance_m < 0.3


def test_what_matches_nothing_behind_a_gap_is_looked_for_elsewhere(tmp_path):
    robot_map(tmp_path / "r1.engram", np.arange(40.0))
    appearance = np.where(np.arange(40) < 20, 0, 1)
    mapped_with_gap(tmp_path / "r2.engram", appearance)
    _, report = merged(tmp_path / "centre.engram", tmp_path / "r1.engram", tmp_path / "r2.engram")
    before, behind = report.segments
    assert (before.seed, behind.seed) == (Seed.PLACE, Seed.NONE)
    assert (behind.omitted, report.components) == (0, 2)


@pytest.fixture
def segments():
    """Eight nodes at a metre a frame, and one that is moved about behind them."""
    session = SessionId(uuid4())
    nodes = [
        Node(node_id(session, at * PERIOD_NS), session, at * PERIOD_NS, "camera", float(at))
        for at in range(9)
    ]
    metre, sure = SE3(np.eye(3), np.array([0.0, 0.0, 1.0])), np.eye(6) * 1e-4
    steps = [
        Edge(one.id, other.id, EdgeKind.ODOMETRY, metre, sure) for one, other in pairwise(nodes[:8])
    ]
    return Segment(tuple(nodes[:8]), tuple(steps)), nodes[8]


def behind(segments, gap_ns):
    before, node = segments
    last = before.nodes[-1]
    after = Segment((replace(node, stamp_ns=last.stamp_ns + gap_ns),), ())
    return position_behind_gap(Position.at(last.id), before, after, GapConfig())


def test_the_robot_is_taken_to_drive_on_as_it_did(segments):
    found = behind(segments, 4 * PERIOD_NS)
    assert found.node == segments[0].nodes[-1].id
    assert found.node_from_live.translation == pytest.approx([0.0, 0.0, 4.0], abs=1e-6)
    assert found.sigma_m == pytest.approx(2.0, rel=0.1)  # half of the way


def test_a_guess_over_more_than_ten_metres_is_none(segments):
    assert behind(segments, 9 * PERIOD_NS) is not None
    assert behind(segments, 11 * PERIOD_NS) is None


def test_nothing_is_guessed_of_a_robot_whose_speed_is_not_known(segments):
    before, node = segments
    alone = Segment(before.nodes[-1:], ())
    assert behind((alone, node), PERIOD_NS) is None
