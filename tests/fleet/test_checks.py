"""Which drives of one robot overlap in time."""

from __future__ import annotations

from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from engram.fleet.merge.open_merge import Span, overlapping
from engram.testing.contracts import session_record

# Short spans on a short time line: many touch, many begin together.
SPANS = st.lists(st.tuples(st.integers(0, 30), st.integers(0, 8), st.booleans()), max_size=14)


@given(SPANS)
def test_the_sweep_finds_every_pair_that_overlaps_with_a_new_one_among_it(told):
    spans = [
        Span(session_record(number), first, first + length)
        for number, (first, length, _) in enumerate(told)
    ]
    new = {span.session.id for span, (_, _, is_new) in zip(spans, told, strict=True) if is_new}
    expected = {
        frozenset((a.session.id, b.session.id))
        for a, b in combinations(spans, 2)
        if a.first_ns <= b.last_ns
        and b.first_ns <= a.last_ns
        and {a.session.id, b.session.id} & new
    }
    found = [frozenset((a.id, b.id)) for a, b in overlapping(spans, new)]
    assert len(found) == len(set(found))
    assert set(found) == expected
