"""Lanes match with several nodes at once: the same matches as one by one."""

from __future__ import annotations

import os
from dataclasses import replace
from uuid import UUID

import numpy as np
import pytest
from tests.scenes import Scene

from engram.errors import IncompatibleError, MapCorruptError
from engram.frontend.features import NET
from engram.frontend.frame import Frame
from engram.frontend.matching import Match, MatcherConfig
from engram.geometry.se3 import SE3
from engram.graph.model import NodeId
from engram.localiser.acceptance import Prediction
from engram.localiser.attempts import Candidate, Lanes, one_by_one

CONFIG = MatcherConfig()
AHEAD = SE3.exp([0.2, -0.05, 1.0, 0.02, 0.1, 0.01])
NEAR = Prediction(AHEAD, 0.1, 0.03)
LIVE, _ = Scene(300, 0).seen_from(AHEAD)
LIVE_ID = NodeId(UUID(int=1000))


class Frames:
    """Frames of the same place and of others; the sixth cannot be read."""

    def frame(self, node: NodeId) -> Frame:
        if node.int == 5:
            raise MapCorruptError("damaged")
        return Scene(300, node.int % 3).seen_from(SE3.identity())[0]

    def prefetch(self, nodes: list[NodeId]) -> None:
        """Nothing to do."""


def lanes_of(count: int) -> Lanes:
    return Lanes(Frames(), CONFIG, count=count)


def candidates(count: int) -> list[Candidate]:
    """Candidates with a prediction and without."""
    return [
        Candidate(number, NodeId(UUID(int=number)), guide, guided=guide is not None, row=number)
        for number in range(count)
        for guide in [NEAR if number % 2 else None]
    ]


def assert_same(found: list[Match | None], wanted: list[Match | None]) -> None:
    assert any(one is not None and one.reference_from_live is not None for one in wanted)
    assert any(one is not None and one.reference_from_live is None for one in wanted)
    for a, b in zip(found, wanted, strict=True):
        assert (a is None) == (b is None)
        if a is None or b is None:
            continue
        np.testing.assert_array_equal(a.live_rows, b.live_rows)
        np.testing.assert_array_equal(a.reference_rows, b.reference_rows)
        assert (a.reference_from_live is None) == (b.reference_from_live is None)
        if a.reference_from_live is not None and b.reference_from_live is not None:
            np.testing.assert_array_equal(
                a.reference_from_live.matrix(), b.reference_from_live.matrix()
            )
            np.testing.assert_array_equal(a.covariance, b.covariance)


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("asked", [2, 7])
def test_lanes_find_what_is_found_one_by_one(count: int, asked: int) -> None:
    lanes, some = lanes_of(count), candidates(asked)
    wanted = one_by_one(lanes, LIVE, LIVE_ID, some)
    assert (None in wanted) == (asked > 5)
    for _ in range(20):  # threads wait for the next frame and are woken again
        assert_same(lanes.matches(LIVE, LIVE_ID, some), wanted)
    lanes.close()
    assert_same(lanes.matches(LIVE, LIVE_ID, some), wanted)


def test_nothing_asked_is_nothing_found() -> None:
    assert lanes_of(2).matches(LIVE, LIVE_ID, []) == []


def test_frames_of_other_features_are_refused_and_the_lanes_go_on() -> None:
    lanes, some = lanes_of(2), candidates(3)
    with pytest.raises(IncompatibleError, match="descriptors"):
        lanes.matches(replace(LIVE, descriptor=NET), LIVE_ID, some)
    assert_same(lanes.matches(LIVE, LIVE_ID, some), one_by_one(lanes, LIVE, LIVE_ID, some))


def test_where_nothing_is_predicted_the_settings_of_a_lost_robot_count() -> None:
    none_agrees = MatcherConfig(min_consensus=300)
    lost, predicted = Lanes(Frames(), CONFIG, none_agrees).matches(LIVE, LIVE_ID, candidates(2))
    usual = lanes_of(1).matches(LIVE, LIVE_ID, candidates(2))
    assert lost is not None
    assert lost.reference_from_live is None
    assert_same([usual[0], predicted], usual)


def test_a_forked_process_matches_without_the_threads_of_its_parent() -> None:
    lanes, some = lanes_of(2), candidates(3)
    wanted = one_by_one(lanes, LIVE, LIVE_ID, some)
    assert_same(lanes.matches(LIVE, LIVE_ID, some), wanted)  # the threads run now
    child = os.fork()
    if child == 0:
        try:
            assert_same(lanes.matches(LIVE, LIVE_ID, some), wanted)
            del lanes
            os._exit(0)
        except BaseException:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert status == 0
