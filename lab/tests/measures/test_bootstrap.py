"""Intervals over sessions against cases worked by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import InputError
from engram_lab.intervals import Resamples, SessionSums, difference, excess_ratio, ratio


def sums(numerator, denominator) -> SessionSums:
    return SessionSums(np.array(numerator, float), np.array(denominator, float))


def test_a_measure_is_pooled_over_sessions_not_averaged() -> None:
    # 1 of 2 m and 0 of 8 m missed: a tenth of the way, though half of the first session.
    assert sums([1, 0], [2, 8]).value == pytest.approx(0.1)


def test_two_sessions_draw_as_two_coins_do() -> None:
    # Drawn with replacement both are the first in a quarter of the cases, both the second in
    # another: the middle half is the pooled value, the 90 % interval reaches the ends.
    resamples = Resamples.of(2, 4000, seed=1)
    measure = sums([1, 0], [1, 1])
    interval = resamples.interval(measure)
    assert (interval.estimate, interval.low, interval.high) == (0.5, 0.0, 1.0)
    assert resamples.interval(measure, level=0.4).low == 0.5


def test_equal_sessions_leave_no_doubt() -> None:
    interval = Resamples.of(5, 100).interval(sums([3] * 5, [10] * 5))
    assert interval.low == interval.high == interval.estimate == pytest.approx(0.3)


def test_a_paired_difference_is_certain_where_every_session_agrees() -> None:
    resamples = Resamples.of(4, 500)
    a, b = sums([1, 2, 3, 4], [10] * 4), sums([2, 3, 4, 5], [10] * 4)
    interval = resamples.interval(difference(a, b))
    assert interval.low == pytest.approx(interval.high) == pytest.approx(-0.1)
    assert resamples.interval(a).high - resamples.interval(a).low > 0.05


def test_excess_is_counted_above_the_bound() -> None:
    a, b, bound = sums([9], [10]), sums([3], [10]), sums([1], [10])
    ones = np.ones((1, 1))
    assert excess_ratio(a, b, bound)(ones)[0] == pytest.approx(4.0)
    assert ratio(a, b)(ones)[0] == pytest.approx(3.0)
    assert ratio(a, b, added=0.3)(ones)[0] == pytest.approx(2.0)
    # What reaches the bound is infinitely better than what does not, and as good as its like.
    assert np.isinf(excess_ratio(a, bound, bound)(ones)[0])
    assert np.isnan(excess_ratio(bound, bound, bound)(ones)[0])


def test_the_same_seed_gives_the_same_interval() -> None:
    measure = sums([1, 5, 2, 0, 7], [10, 11, 9, 12, 10])
    first, again, other = (Resamples.of(5, 200, seed).interval(measure) for seed in (3, 3, 4))
    assert first == again
    assert first != other


@given(st.lists(st.tuples(st.floats(0, 10), st.floats(0.1, 10)), min_size=1, max_size=12))
def test_an_interval_lies_within_the_sessions_extremes(parts) -> None:
    above, below = zip(*parts, strict=True)
    interval = Resamples.of(len(parts), 200).interval(sums(above, below))
    shares = np.array(above) / np.array(below)
    slack = 1e-9  # rounding of the weighted sums
    assert shares.min() - slack <= interval.low <= interval.high <= shares.max() + slack


def test_draws_of_other_sessions_are_refused() -> None:
    with pytest.raises(InputError, match=r"over 3 sessions .* as many sessions as there are"):
        Resamples.of(2).interval(SessionSums(np.ones(3), np.ones(3)))


def test_no_sessions_are_refused() -> None:
    with pytest.raises(InputError, match="0 sessions"):
        Resamples.of(0)
    with pytest.raises(InputError, match="one length"):
        SessionSums(np.zeros(2), np.zeros(3))
