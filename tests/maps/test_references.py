"""Sequence numbers of a path, stored by stretches."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from engram.maps.references import Stretches


@given(st.lists(st.integers(-20, 20)))
def test_stretches_hold_what_a_set_holds(numbers):
    found: set[int] = set()
    stretches = Stretches()
    for number in numbers:
        stretches.add(number)
        found.add(number)
        assert {one for one in range(-22, 23) if one in stretches} == found
    assert {one for one in range(-22, 23) if one in Stretches(numbers)} == found


def test_successive_numbers_take_one_stretch():
    stretches = Stretches(range(1000))
    assert stretches._firsts == [0]
    assert stretches._lasts == [999]
