"""Random small maps in a centre: a handful of the cases that the benchmark tries by thousands."""

import pytest

from engram_lab.checks import merge_graphs


@pytest.mark.parametrize("seed", range(2))
def test_what_must_hold_of_a_merge_holds_for_random_maps(seed):
    assert merge_graphs.told(seed).violations == []


def test_a_centre_without_edges_can_be_downloaded_from():
    case = merge_graphs.told(46)
    assert (case.violations, case.sent) == ([], "copy")


@pytest.mark.long
def test_what_must_hold_of_a_merge_holds_for_many_random_maps():
    cases = [merge_graphs.told(seed) for seed in range(1000, 1100)]
    assert [found for case in cases for found in case.violations] == []
    assert {"copy", "tod", "paths", "tod+paths", "budget", "region"} <= {
        case.sent for case in cases
    }
