"""The window of recent attempts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import ConfigError
from engram.ranking.recent import AttemptHistory, IterationUnit, Observations, RecentConfig


def add(history: AttemptHistory, nodes: list[int], accepted: list[bool]) -> None:
    """Adds attempts of which all but their outcomes are the same."""
    known = np.full(len(nodes), 0.5)
    history.add(nodes, (known, known), accepted, [30] * len(nodes), 90)


def as_dict(observations: Observations) -> dict[int, bool]:
    return dict(zip(observations.nodes.tolist(), observations.succeeded.tolist(), strict=True))


def test_frames_within_half_a_metre_are_one_iteration() -> None:
    recent = AttemptHistory()
    driven = [0.0, 0.2, 0.49, 0.5, 0.9, 1.1, 1.2]
    assert [recent.begin_frame(m) for m in driven] == [0, 0, 0, 1, 1, 2, 2]


def test_with_unit_frame_each_frame_is_an_iteration() -> None:
    recent = AttemptHistory(RecentConfig(T_unit=IterationUnit.FRAME))
    assert [recent.begin_frame(0.0) for _ in range(4)] == [0, 1, 2, 3]


def test_latest_outcome_of_each_node_counts() -> None:
    recent = AttemptHistory()
    recent.begin_frame(0.0)
    add(recent, [7, 8], [True, True])
    recent.begin_frame(1.0)
    add(recent, [7], [False])
    assert as_dict(recent.observations) == {8: True, 7: False}
    assert recent.observations.nodes.tolist() == [8, 7]


@given(st.integers(1, 12), st.integers(1, 40))
def test_window_holds_the_last_t_iterations_whatever_the_frame_rate(T: int, frames: int) -> None:
    fast, slow = (AttemptHistory(RecentConfig(T=T)) for _ in range(2))
    for i in range(frames):
        slow.begin_frame(float(i))
        add(slow, [i], [i % 2 == 0])
        for part in range(3):
            fast.begin_frame(i + 0.1 * part)
            add(fast, [i], [i % 2 == 0])
    expected = {i: i % 2 == 0 for i in range(max(0, frames - 1 - T), frames)}
    assert as_dict(fast.observations) == as_dict(slow.observations) == expected


def test_t_zero_remembers_nothing() -> None:
    recent = AttemptHistory(RecentConfig(T=0))
    recent.begin_frame(0.0)
    add(recent, [1], [True])
    assert len(recent.observations) == 0
    assert recent.observations.nodes.dtype == np.int32


@pytest.mark.parametrize("settings", [{"T": -1}, {"iteration_m": 0.0}])
def test_senseless_settings_are_refused(settings) -> None:
    with pytest.raises(ConfigError):
        RecentConfig(**settings)


def test_the_run_forgets_what_lies_two_hundred_metres_back() -> None:
    history = AttemptHistory()
    for metre in range(500):
        history.begin_frame(float(metre))
        known = np.array([0.5, 0.7])
        history.add([metre, 7], (known, known), [True, False], [30, 0], 90)
    run = history.run()
    assert run.nodes[::2].tolist() == list(range(299, 500))
    assert set(run.nodes[1::2].tolist()) == {7}
    assert run.accepted[:2].tolist() == [True, False]
    assert run.driven_m == 499.0
    assert set(run.inliers.tolist()) == {30, 0}


def test_the_history_of_a_robot_that_stands_still_does_not_grow() -> None:
    history = AttemptHistory()
    expected = np.array([0.5, np.nan]), np.full(2, 0.5)
    for _ in range(20_000):
        history.begin_frame(3.0)
        history.add([1, 2], expected, [False, False], [3, 4], 90)
    run = history.run()
    assert len(run) == 4096
    assert run.frames == 20_000
    assert len(history._columns[0]) < 4 * 4096


def test_failures_without_a_prediction_push_nothing_out() -> None:
    history = AttemptHistory()
    history.begin_frame(0.0)
    history.add([5], (np.array([0.5]), np.array([0.9])), [True], [80], 90)
    nowhere = np.full(20, np.nan)
    for _ in range(1000):
        history.add(list(range(20)), (nowhere, nowhere), [False] * 20, [4] * 20, 90)
    assert history.run().nodes.tolist() == [5]
    assert as_dict(history.observations) == {5: True}


def test_a_resumed_history_has_no_recent_attempts_and_goes_on_with_its_number() -> None:
    history = AttemptHistory()
    history.begin_frame(0.0)
    add(history, [1], [True])
    history.resume(7)
    assert len(history.observations) == 0
    assert history.begin_frame(0.1) == 7
