"""The measures against cases worked by hand."""

import numpy as np
import pytest

from engram.errors import InputError
from engram.measures import Drive, failure, gaps, longest_gap_m, route_m, route_not_localised


def drive(steps: list[float], matched: str) -> Drive:
    return Drive(np.array(steps, dtype=float), np.array([mark == "x" for mark in matched]))


# Ten steps of 1 m; matches end the 2nd, 3rd and 8th: gaps of 2, 1, 5 and 2 m.
WORKED = drive([1.0] * 10, ".xx....x..")


def test_gaps_are_closed_by_start_and_end() -> None:
    found = gaps([WORKED])
    np.testing.assert_allclose(found.length_m, [2, 1, 5, 2])
    np.testing.assert_array_equal(found.failed, [True, False, True, True])


def test_failures_of_the_worked_case() -> None:
    # At 1.5 m: (0.5 + 3.5 + 0.5) / 10.
    assert failure([WORKED], 1.5) == pytest.approx(0.45)


def test_route_not_localised_counts_the_steps_that_end_unmatched() -> None:
    assert route_not_localised([WORKED]) == pytest.approx(0.7)
    assert longest_gap_m([WORKED]) == 5
    assert route_m([WORKED, WORKED]) == 20


def test_sessions_do_not_run_into_one_another() -> None:
    end, start = drive([1, 1, 1], "x.."), drive([1, 1, 1], "..x")
    assert sorted(gaps([end, start]).length_m) == [1, 2, 3]


def test_a_match_where_the_session_starts_or_ends_makes_no_gap_there() -> None:
    whole = drive([0, 1, 1, 1, 1], "xxxxx")
    np.testing.assert_allclose(gaps([whole]).length_m, [1, 1, 1, 1])
    assert not gaps([whole]).failed.any()
    # At rest between two matches is a gap of no length; at rest without one is a failed one.
    rest = drive([0, 0, 1, 0], "xxx.")
    np.testing.assert_allclose(gaps([rest]).length_m, [0, 1, 0])
    np.testing.assert_array_equal(gaps([rest]).failed, [False, False, True])


@pytest.mark.parametrize(
    "matched", [[0, 1, 1, 0], [0.0, 1.0, 1.0, 0.0], [False, True, True, False]]
)
def test_matches_may_be_told_as_numbers(matched) -> None:
    for given in (matched, np.array(matched)):
        told = Drive([1, 2, 3, 4], given)
        assert route_not_localised([told]) == pytest.approx(0.5)
        assert longest_gap_m([told]) == 4


@pytest.mark.parametrize("matched", [[0, 2], [0.5, 1], ["yes", "no"], [np.nan, 1]])
def test_what_is_neither_true_nor_false_is_refused(matched) -> None:
    with pytest.raises(InputError):
        Drive(np.ones(2), matched)


def test_a_session_without_a_match_is_one_gap() -> None:
    never = drive([2, 3], "..")
    np.testing.assert_allclose(gaps([never]).length_m, [5])
    assert failure([never], 1.0) == pytest.approx(0.8)


def test_a_robot_at_rest_has_no_route() -> None:
    rest = drive([0, 0], "x.")
    assert failure([rest], 10) == 0
    assert route_not_localised([rest]) == 0


def test_route_estimator_agrees_with_drawing_points_at_random() -> None:
    rng = np.random.default_rng(3)
    steps = rng.uniform(0, 2, 400)
    matched = rng.random(400) < 0.2
    sample = Drive(steps, matched)
    ends = np.concatenate([np.cumsum(steps)[matched], [steps.sum()]])
    points = rng.uniform(0, steps.sum(), 200_000)
    ahead = ends[np.searchsorted(ends, points)] - points
    # 200,000 draws: standard error below 0.0012, four of them.
    assert failure([sample], 5.0) == pytest.approx(np.mean(ahead >= 5.0), abs=0.005)


@pytest.mark.parametrize(
    ("steps", "matched"), [([1.0, -1.0], "xx"), ([np.nan, 1.0], "xx"), ([1.0], "xx")]
)
def test_what_is_no_drive_is_refused(steps: list[float], matched: str) -> None:
    with pytest.raises(InputError):
        drive(steps, matched)
