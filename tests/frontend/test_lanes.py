"""Matching with several frames at once: the same matches as one by one, whatever takes them."""

from __future__ import annotations

import os

import numpy as np
import pytest
from tests.scenes import Scene

from engram.errors import InputError
from engram.frontend.matching import Lanes, Match, MatcherConfig, Question, match_frames
from engram.geometry.se3 import SE3

CONFIG = MatcherConfig()
AHEAD = SE3.exp([0.2, -0.05, 1.0, 0.02, 0.1, 0.01])
NEAR = np.diag([0.01] * 3 + [0.001] * 3)


def questions(count: int) -> list[Question]:
    """Frames of the same place and of others, with a prediction and without."""
    found = []
    for number in range(count):
        reference, _ = Scene(300, number % 3).seen_from(SE3.identity())
        guide = (AHEAD, NEAR) if number % 2 else (None, None)
        found.append(Question(reference, CONFIG, number, *guide))
    return found


LIVE, _ = Scene(300, 0).seen_from(AHEAD)


def one_by_one(asked: list[Question]) -> list[Match]:
    return [
        match_frames(one.reference, LIVE, CONFIG, one.seed, one.predicted, one.predicted_covariance)
        for one in asked
    ]


def assert_same(found: list[Match], wanted: list[Match]) -> None:
    assert any(one.reference_from_live is not None for one in wanted)
    assert any(one.reference_from_live is None for one in wanted)
    for a, b in zip(found, wanted, strict=True):
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
    lanes, some = Lanes(count), questions(asked)
    wanted = one_by_one(some)
    for _ in range(20):  # threads wait for the next frame and are woken again
        assert_same(lanes.match(LIVE, some), wanted)
    lanes.close()
    assert_same(lanes.match(LIVE, some), wanted)


def test_nothing_asked_is_nothing_found() -> None:
    assert Lanes(2).match(LIVE, []) == []


def test_a_question_that_does_not_fit_is_refused_and_the_lanes_go_on() -> None:
    lanes, some = Lanes(2), questions(3)
    broken = Question(some[0].reference, CONFIG, 0, AHEAD)
    with pytest.raises(InputError, match="covariance"):
        lanes.match(LIVE, [*some, broken])
    assert_same(lanes.match(LIVE, some), one_by_one(some))


def test_a_forked_process_matches_without_the_threads_of_its_parent() -> None:
    lanes, some = Lanes(2), questions(3)
    wanted = one_by_one(some)
    assert_same(lanes.match(LIVE, some), wanted)  # the threads run now
    child = os.fork()
    if child == 0:
        try:
            assert_same(lanes.match(LIVE, some), wanted)
            del lanes
            os._exit(0)
        except BaseException:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert status == 0
    assert_same(lanes.match(LIVE, some), wanted)
