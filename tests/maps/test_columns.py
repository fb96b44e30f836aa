"""Rows that are read at once, as columns, are checked as rows that are read one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram import _core
from engram.maps.columns import Columns
from engram.maps.rows import checksum

INTS = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.sampled_from([0, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**63 - 1]),
    st.sampled_from([-1, -32, -33, -128, -129, -32768, -32769, -(2**31), -(2**31) - 1, -(2**63)]),
)
TEXTS = st.one_of(st.text(max_size=40), st.text(min_size=250, max_size=300))
ROWS = st.lists(
    st.tuples(INTS, st.floats(allow_nan=False), TEXTS, st.binary(min_size=9, max_size=9))
)


@given(ROWS)
def test_columns_of_sealed_rows_are_their_values(rows: list[tuple]) -> None:
    columns, bad, at = _core.verified_columns(
        [(*row, checksum(row)) for row in rows], ["i", "f", "s", "b9"]
    )
    assert (bad, at) == (-1, -1)
    assert columns is not None
    ints, floats, (codes, texts), data = columns
    assert ints.tolist() == [row[0] for row in rows]
    np.testing.assert_array_equal(floats, np.array([row[1] for row in rows]))
    assert [texts[code] for code in codes.tolist()] == [row[2] for row in rows]
    assert data.tobytes() == b"".join(row[3] for row in rows)


@given(st.binary(max_size=70_000))
def test_bytes_of_any_number_are_summed_as_zlib_does(data: bytes) -> None:
    columns, *_ = _core.verified_columns([(data, checksum([data]))], [f"b{len(data)}"])
    assert columns is not None
    assert columns[0].tobytes() == data


@pytest.mark.parametrize(
    "row", [(1, 2.0, "x"), (1, 2, "x"), (True, 2.0, "x"), (1, 2.0, None), (2**70, 2.0, "x")]
)
def test_a_row_of_other_types_or_sum_is_named(row: tuple) -> None:
    good = (3, 1.0, "y")
    rows = [(*good, checksum(good)), (*row, checksum(good))]
    assert _core.verified_columns(rows, ["i", "f", "s"]) == (None, 1, -1)
    assert _core.verified_columns([(*good,)], ["i", "f", "s"]) == (None, 0, -1)


def test_bytes_of_another_number_are_named_with_their_column() -> None:
    rows = [(n, b"abc", checksum([n, b"abc"])) for n in range(3)]
    assert _core.verified_columns(rows, ["i", "b4"]) == (None, 0, 1)


def test_the_newest_row_of_a_key_counts() -> None:
    columns = Columns(
        {"a": np.array([1, 2, 1, 1]), "value": np.array([10, 20, 30, 40])},
        {"kind": (np.array([0, 0, 0, 1], np.int32), ["x", "y"])},
    )
    newest = columns.newest("a", "kind")
    assert newest["value"].tolist() == [20, 30, 40]
