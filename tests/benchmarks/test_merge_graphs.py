"""Random small maps in a centre: a handful of the cases that the benchmark tries by thousands."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import merge_graphs


@pytest.mark.parametrize("seed", range(4))
def test_what_must_hold_of_a_merge_holds_for_random_maps(seed):
    assert list(merge_graphs.violations(seed)) == []


@pytest.mark.long
def test_what_must_hold_of_a_merge_holds_for_many_random_maps():
    assert [found for seed in range(1000, 1100) for found in merge_graphs.violations(seed)] == []
