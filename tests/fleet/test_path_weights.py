"""[G16] Algorithms 2 and 3, equations (5) and (7): examples worked by hand, and the corners."""

from __future__ import annotations

from uuid import UUID

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import InputError
from engram.fleet.download.selections import count_paths, epoch_count, epoch_of, mission_epochs
from engram.graph.model import PathId

P1, P2, P3 = (PathId(UUID(int=number)) for number in (1, 2, 3))
# Ten nodes, saved at these hours; three drives as in [G16] Fig. 5.
HOURS = np.array([8.2, 8.6, 9.0, 9.5, 9.9, 10.0, 14.5, 14.6, np.nan, 23.9])
ON_PATH = {
    P3: np.array([6, 7, 9, 8]),
    P1: np.array([0, 1, 2, 3, 2]),  # comes to node 2 twice: it counts once
    P2: np.array([2, 4, 5, 6]),
}


def counts(epoch_min: float = 60.0):
    return count_paths(ON_PATH, HOURS, epoch_min)


def test_algorithm_2_counts_the_nodes_of_each_path_in_each_epoch():
    found = counts()
    assert found.paths == (P1, P2, P3)
    expected = np.zeros((3, 24), int)
    expected[0, 8], expected[0, 9] = 2, 2  # 8.2, 8.6 | 9.0, 9.5
    expected[1, 9], expected[1, 10], expected[1, 14] = 2, 1, 1  # 9.0, 9.9 | 10.0 | 14.5
    expected[2, 14], expected[2, 23] = 2, 1  # 14.5, 14.6 | 23.9; one has no known hour
    np.testing.assert_array_equal(found.counts, expected)


def test_equation_7_makes_shares_of_each_epoch_and_nothing_of_an_empty_one():
    weights = counts().weights
    np.testing.assert_allclose(weights[:, 8], [1, 0, 0], rtol=0)
    np.testing.assert_allclose(weights[:, 9], [1 / 2, 1 / 2, 0], rtol=0)
    np.testing.assert_allclose(weights[:, 14], [0, 1 / 3, 2 / 3], rtol=1e-15)
    np.testing.assert_array_equal(weights[:, 0], [0, 0, 0])


def test_equation_5_is_half_open():
    np.testing.assert_array_equal(
        epoch_of(np.array([0.0, 8.999, 9.0, 9.5, 23.999, np.nan]), 60.0), [0, 8, 9, 9, 23, -1]
    )
    # Ten minutes are no binary fraction of an hour: a boundary stays a boundary.
    ninths = np.arange(144) / 6
    np.testing.assert_array_equal(epoch_of(ninths, 10.0), np.arange(144))
    # 7 hours do not divide the day: the last epoch has three.
    assert epoch_count(420.0) == 4
    np.testing.assert_array_equal(epoch_of(np.array([20.9, 21.0, 23.9]), 420.0), [2, 3, 3])


@pytest.mark.parametrize(
    ("epoch", "percent", "rows"),
    [
        (9, 50, [0]),  # a tie of two: the lower UUID
        (9, 51, [0, 1]),  # ⌈1.02⌉
        (9, 1, [0]),  # never none
        (9, 0, [0]),
        (14, 50, [2]),
        (14, 100, [2, 1]),
        (8, 100, [0]),  # paths without a node in the epoch are none of its paths
        (0, 100, []),
    ],
)
def test_best_paths_of_an_epoch(epoch, percent, rows):
    assert counts().best(epoch, percent) == rows


@pytest.mark.parametrize(
    ("start", "end", "buffer", "epochs"),
    [
        (8.5, 9.5, 0, [8, 9]),
        (9.0, 9.0, 0, [9]),
        (None, None, 0, [8, 9, 10, 14, 23]),  # live deployment: all that there is
        (3.0, 9.0, 0, [8, 9]),  # before the first epoch with data: from that on
        (None, 8.5, 0, [8]),
        (14.0, None, 0, [14, 23]),
        (10.0, 12.5, 0, [10]),  # epochs without data are passed over
        (11.0, 12.0, 60, [10]),  # 10:00 to 13:00
        (11.0, 12.0, 121, [8, 9, 10, 14]),
        (22.0, 8.9, 0, [23, 8]),  # over midnight, without clamping
        (23.5, 1.0, 0, [23]),
        (23.9, 23.8, 0, [8, 9, 10, 14, 23]),  # all but six minutes of a day
        (0.2, 8.5, 60, [23, 8, 9]),  # the buffer reaches over midnight
        (14.0, 23.5, 60, [14, 23]),
        (9.0, 20.0, 720, [8, 9, 10, 14, 23]),  # more than a day
        (0.5, None, 60, [8, 9, 10, 14, 23]),  # a lone time stays within its day
    ],
)
def test_algorithm_3_finds_the_epochs_of_a_mission(start, end, buffer, epochs):
    assert mission_epochs(counts(), start, end, buffer) == epochs


@pytest.mark.parametrize(("start", "end"), [(11.0, 13.0), (15.0, 22.0), (2.0, 5.0), (0.5, 0.2)])
def test_a_mission_without_data_is_told_where_there_is_some(start, end):
    only_noon = count_paths({P1: np.array([0])}, np.array([14.5]), 60.0)
    if (start, end) == (0.5, 0.2):  # nearly the whole day: there is data
        assert mission_epochs(only_noon, start, end) == [14]
        return
    with pytest.raises(InputError, match=r"no epoch from .* has data; there is some from 14:00 to"):
        mission_epochs(only_noon, start, end)


def test_every_stretch_of_the_day_with_data_is_told():
    words = "some from 8:00 to 11:00, 14:00 to 15:00, 23:00 to 24:00: choose"
    with pytest.raises(InputError, match=words):
        mission_epochs(counts(), 11.5, 13.0)


def test_a_start_after_all_data_with_an_open_end_has_none():
    only_noon = count_paths({P1: np.array([0])}, np.array([14.5]), 60.0)
    with pytest.raises(InputError, match="from 16:00 to the last"):
        mission_epochs(only_noon, 16.0, None)


def test_no_known_hour_at_all_is_said():
    with pytest.raises(InputError, match="no path has a node with a known hour"):
        mission_epochs(count_paths(ON_PATH, np.full(10, np.nan), 60.0), 8.0, 9.0)


@given(
    hours=st.lists(st.floats(0, 23.999) | st.just(float("nan")), min_size=1, max_size=30),
    epoch_min=st.sampled_from([1.0, 10.0, 45.0, 60.0, 90.0, 1440.0]),
    start=st.none() | st.floats(0, 23.99),
    end=st.none() | st.floats(0, 23.99),
    buffer=st.sampled_from([0.0, 30.0, 400.0]),
)
def test_epochs_are_those_of_the_clock_minute_by_minute(hours, epoch_min, start, end, buffer):
    """Brute force: drive the mission minute by minute."""
    found = count_paths({P1: np.arange(len(hours))}, np.array(hours), epoch_min)
    filled = set(np.flatnonzero(found.counts[0]).tolist())
    if start is None or end is None or not filled:
        return
    span = (end - start) * 60 % 1440 + 2 * buffer
    minutes = np.append(np.arange(0, min(span, 1440), 0.5), min(span, 1440))
    passed = set(epoch_of((start - buffer / 60 + minutes / 60) % 24, epoch_min).tolist())
    try:
        told = mission_epochs(found, start, end, buffer)
    except InputError:
        told = []
    assert set(told) >= (passed & filled)
    # Rounding at the mission's ends may add the epochs that only touch it.
    assert len(set(told) - passed) <= 2
    assert len(told) == len(set(told))
