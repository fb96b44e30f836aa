"""What crosses the wire is what is new."""

from __future__ import annotations

import pytest

from engram_lab.checks.centre_wire import measured


@pytest.mark.long
def test_a_hand_in_sends_what_is_new_and_little_else(tmp_path):
    nothing_kb, beyond_kb, overhead = (one.value for one in measured(tmp_path))
    assert 5 < nothing_kb < 100
    assert beyond_kb < 200
    assert 1.0 < overhead < 1.15
