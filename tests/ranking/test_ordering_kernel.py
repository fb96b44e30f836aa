"""Ordering and success rates against their NumPy twins, and what the kernels refuse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram import _core
from engram.graph.basin import BIN_COUNT, BIN_M, MatchBasin

UUID_WORDS = np.array([[3, 1], [3, 0], [2, 9], [0, 5], [2**63, 0], [1, 1]], dtype=np.uint64)

# Few values, so that keys tie often; −0 and 0 are equal, what is no number stands last.
values = st.sampled_from([-np.inf, -2.5, -0.0, 0.0, 1e-300, 2.5, np.inf, np.nan])


@given(st.lists(st.tuples(values, values), min_size=len(UUID_WORDS), max_size=len(UUID_WORDS)))
def test_rows_are_ordered_as_by_lexsort(pairs: list[tuple[float, float]]) -> None:
    first, second = np.array(pairs).T.copy()
    expected = np.lexsort((UUID_WORDS[:, 1], UUID_WORDS[:, 0], second, first))
    np.testing.assert_array_equal(_core.order_rows(UUID_WORDS, first, second), expected)


def test_success_rates_are_interpolated_between_the_bins() -> None:
    basin = MatchBasin.of(400.0)
    rng = np.random.default_rng(0)
    along, across = rng.uniform(-30, 30, (2, 7, 11))
    along[0, :4] = (0, BIN_M / 2, -BIN_M / 2, BIN_M * BIN_COUNT)
    centres = (np.arange(BIN_COUNT) + 0.5) * BIN_M
    expected = np.interp(np.abs(along), centres, basin.rates[0])
    expected *= np.interp(np.abs(across), centres, basin.rates[1])
    expected /= basin.rates[:, 0].max()
    np.testing.assert_allclose(basin.success_rate(along, across), np.minimum(expected, 1), 1e-12)
    assert np.isnan(basin.success_rate(np.array([np.nan]), np.array([0.0]))).all()


def test_arguments_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="one value per row"):
        _core.order_rows(UUID_WORDS, np.zeros(3))
    with pytest.raises(ValueError, match="shape"):
        _core.order_rows(UUID_WORDS[:, :1].copy(), np.zeros(6))
    with pytest.raises(ValueError, match="across"):
        _core.success_rates(np.ones((2, 3)), 0.5, np.zeros(2), np.zeros(3))
    with pytest.raises(ValueError, match="rates"):
        _core.success_rates(np.ones((2, 0)), 0.5, np.zeros(2), np.zeros(2))
