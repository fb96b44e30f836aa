"""Which nodes hang together: as joining them one by one tells."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from engram.graph.graph import grouped, labels_of


@given(st.integers(0, 12).flatmap(
    lambda count: st.tuples(
        st.just(count),
        st.lists(st.tuples(*[st.integers(0, max(count - 1, 0))] * 2), max_size=15 if count else 0),
    )
))  # fmt: skip
def test_labels_number_what_hangs_together_by_its_first_node(drawn):
    count, pairs = drawn
    parts = {node: {node} for node in range(count)}
    for a, b in pairs:
        joined = parts[a] | parts[b]
        parts |= dict.fromkeys(joined, joined)
    firsts = sorted({min(part) for part in parts.values()})
    expected = [firsts.index(min(parts[node])) for node in range(count)]
    labels = labels_of(np.array(pairs, np.int64).reshape(-1, 2), count)
    assert labels.dtype == np.int64
    assert labels.tolist() == expected
    assert [group.tolist() for group in grouped(labels)] == [sorted(parts[one]) for one in firsts]
