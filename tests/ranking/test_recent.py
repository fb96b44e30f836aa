"""The window of recent attempts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import ConfigError
from engram.ranking.recent import IterationUnit, Observations, RecentAttempts, RecentConfig, RunLog


def as_dict(observations: Observations) -> dict[int, bool]:
    return dict(zip(observations.nodes.tolist(), observations.succeeded.tolist(), strict=True))


def test_frames_within_half_a_metre_are_one_iteration() -> None:
    recent = RecentAttempts()
    driven = [0.0, 0.2, 0.49, 0.5, 0.9, 1.1, 1.2]
    assert [recent.begin_frame(m) for m in driven] == [0, 0, 0, 1, 1, 2, 2]


def test_with_unit_frame_each_frame_is_an_iteration() -> None:
    recent = RecentAttempts(RecentConfig(T_unit=IterationUnit.FRAME))
    assert [recent.begin_frame(0.0) for _ in range(4)] == [0, 1, 2, 3]


def test_latest_outcome_of_each_node_counts() -> None:
    recent = RecentAttempts()
    recent.begin_frame(0.0)
    recent.add([7, 8], [True, True])
    recent.begin_frame(1.0)
    recent.add([7], [False])
    assert as_dict(recent.observations) == {8: True, 7: False}
    assert recent.observations.nodes.tolist() == [8, 7]


@given(st.integers(1, 12), st.integers(1, 40))
def test_window_holds_the_last_t_iterations_whatever_the_frame_rate(T: int, frames: int) -> None:
    fast, slow = (RecentAttempts(RecentConfig(T=T)) for _ in range(2))
    for i in range(frames):
        slow.begin_frame(float(i))
        slow.add([i], [i % 2 == 0])
        for part in range(3):
            fast.begin_frame(i + 0.1 * part)
            fast.add([i], [i % 2 == 0])
    expected = {i: i % 2 == 0 for i in range(max(0, frames - 1 - T), frames)}
    assert as_dict(fast.observations) == as_dict(slow.observations) == expected


def test_t_zero_remembers_nothing() -> None:
    recent = RecentAttempts(RecentConfig(T=0))
    recent.begin_frame(0.0)
    recent.add([1], [True])
    assert len(recent.observations) == 0
    assert recent.observations.nodes.dtype == np.int32


@pytest.mark.parametrize("settings", [{"T": -1}, {"iteration_m": 0.0}])
def test_senseless_settings_are_refused(settings) -> None:
    with pytest.raises(ConfigError):
        RecentConfig(**settings)


def test_run_log_forgets_what_lies_two_hundred_metres_back() -> None:
    log = RunLog()
    for metre in range(500):
        known = np.array([0.5, 0.7])
        log.add(float(metre), [metre, 7], (known, known), [True, False], [30, 0], 90)
    run = log.attempts(499.0)
    assert run.nodes[::2].tolist() == list(range(299, 500))
    assert set(run.nodes[1::2].tolist()) == {7}
    assert run.accepted[:2].tolist() == [True, False]
    assert run.driven_m == 499.0
    assert set(run.inliers.tolist()) == {30, 0}


def test_the_log_of_a_robot_that_stands_still_does_not_grow() -> None:
    log = RunLog()
    expected = np.array([0.5, np.nan]), np.full(2, 0.5)
    for _ in range(20_000):
        log.add(3.0, [1, 2], expected, [False, False], [3, 4], 90)
    run = log.attempts(3.0)
    assert len(run) == 4096
    assert run.frames == 20_000
    assert len(log._columns[0]) < 4 * 4096


def test_failures_without_a_prediction_push_nothing_out_of_the_log() -> None:
    log = RunLog()
    log.add(0.0, [5], (np.array([0.5]), np.array([0.9])), [True], [80], 90)
    nowhere = np.full(20, np.nan)
    for _ in range(1000):
        log.add(0.0, list(range(20)), (nowhere, nowhere), [False] * 20, [4] * 20, 90)
    assert log.attempts(0.0).nodes.tolist() == [5]
