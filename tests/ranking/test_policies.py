"""The contract of every ranking policy, and what is particular to each."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engram.errors import ConfigError
from engram.graph.basin import BASIN_LEVEL
from engram.ranking.context import Foreseen, order_by
from engram.ranking.policies import PathPolicy, policy_named, policy_names
from engram.testing.contracts import check_policy, make_context, random_context, unmet

contexts = st.integers(0, 2**32).map(random_context)


@pytest.mark.parametrize("name", sorted(policy_names()))
@given(context=contexts)
@settings(max_examples=25)
def test_every_policy_meets_the_contract(name: str, context) -> None:
    assert unmet(check_policy(lambda: policy_named(name), [context])) == []


@pytest.mark.parametrize("name", sorted({*policy_names()} - {"random", "oracle"}))
def test_a_robot_on_its_first_day_gets_the_nearest_first(name: str) -> None:
    context = make_context(candidates=[4, 2, 7], along_m=[2.0, 0.5, 1.0], sessions=3)
    assert policy_named(name).rank(context).tolist() == [1, 2, 0]


def rank_by_row(context):
    return np.arange(len(context.neighbourhood))


def rank_without_the_last(context):
    return rank_by_row(context)[:-1]


def rank_by_the_live_path(context):
    order = rank_by_row(context)
    return order if context.own_path is None else order[::-1]


def rank_as_a_list(context):
    return rank_by_row(context).tolist()


@pytest.mark.parametrize(
    ("rank", "demands"),
    [
        (rank_by_row, ["nodes come in the same order when rows are shuffled"]),
        (rank_without_the_last, ["every row", "a robot on its first day", "nodes come"]),
        (rank_by_the_live_path, ["nodes come", "the robot's own path"]),
        (rank_as_a_list, ["every row", "no candidates", "a robot on its first day", "nodes come"]),
    ],
)
def test_a_policy_that_breaks_the_contract_is_found_out(rank, demands) -> None:
    class Policy:
        name = "broken"

        def rank(self, context):
            return rank(context)

    found = unmet(check_policy(Policy))
    assert len(found) == len(demands), found
    assert all(one.startswith(demand) for one, demand in zip(found, demands, strict=True)), found


@pytest.mark.parametrize("name", sorted({*policy_names()} - {"random"}))
def test_equal_candidates_stand_by_distance_then_by_uuid(name: str) -> None:
    context = make_context(candidates=[0, 1, 2, 3, 4], along_m=[1.0, 0.5, -0.5, 0.5, -1.0])
    nothing = Foreseen(np.zeros(5, np.bool_), np.zeros(5, np.int64))
    context = dataclasses.replace(context, foresee=lambda: nothing)
    ids = [context.graph.node(i).id for i in range(5)]
    expected = sorted(range(5), key=lambda i: (context.neighbourhood.distance_m[i], ids[i]))
    assert policy_named(name).rank(context).tolist() == expected


@pytest.mark.parametrize("name", ["path", "path-near"])
def test_path_policies_put_the_companion_of_recent_successes_first(name: str) -> None:
    context = make_context(
        paths=[[1, 2, 3, 4, 9], [6, 7, 8, 4, 5]],
        candidates=[5, 9],
        along_m=[0.1, 1.0],
        observed=[1, 2, 3, 4, 8],
        outcomes=[True, True, True, True, False],
        reference=4,
    )
    assert policy_named(name).rank(context).tolist() == [1, 0]


def test_candidates_with_the_same_counts_in_another_order_tie() -> None:
    # Node 0 shares path A with two of W, node 1 path B with two others: equal posteriors, though
    # the factors are multiplied in different orders.
    rng = np.random.default_rng(3)
    observed = list(range(2, 60))
    members = rng.permutation(observed)
    paths = [[0, *members[:29].tolist()], [1, *members[29:].tolist()]]
    context = make_context(
        paths=paths,
        candidates=[0, 1],
        along_m=[0.7, 0.6],
        observed=observed,
        outcomes=[True] * len(observed),
    )
    assert policy_named("path").rank(context).tolist() == [1, 0]


def test_path_near_ranks_by_distance_beyond_the_basin_and_the_published_formula_does_not() -> None:
    situation = {
        "paths": [[0, 1, 2, 3]],
        "candidates": [3, 4, 5],
        "along_m": [6.0, 1.0, 4.0],
        "observed": [0, 1, 2],
        "outcomes": [True, True, True],
        "reference": 2,
    }
    context = make_context(**situation)
    assert policy_named("path").rank(context)[0] == 0
    assert policy_named("path-near").rank(context).tolist() == [1, 2, 0]
    # A longer lens sees farther: the basin then holds the companion 6 m away.
    assert policy_named("path-near").rank(make_context(**situation, focal_px=707.0))[0] == 0


@given(context=contexts)
@settings(deadline=None)
def test_path_near_is_the_formula_within_the_basin_and_distance_beyond(context) -> None:
    near = context.neighbourhood
    beyond = context.success_rates() < BASIN_LEVEL
    scores = PathPolicy().scores(context, near.nodes)
    # The core adds up in another order: what differs in its last bits only may stand in either.
    scores = np.where(beyond, 0, scores.round(9))
    order, expected = policy_named("path-near").rank(context), order_by(context, beyond, -scores)
    np.testing.assert_array_equal(np.sort(order), np.sort(expected))
    np.testing.assert_array_equal(scores[order], scores[expected])
    np.testing.assert_array_equal(order[beyond[order]], expected[beyond[expected]])


def test_path_near_refuses_arrays_that_do_not_fit() -> None:
    context = make_context(paths=[[0, 1]], candidates=[0, 1])
    near = context.neighbourhood
    for broken in (
        dataclasses.replace(near, nodes=np.array([0, 99], np.int32)),
        dataclasses.replace(near, distance_m=near.distance_m[:1]),
        dataclasses.replace(near, along_m=near.along_m[:1]),
    ):
        with pytest.raises((IndexError, ValueError), match=r"index 99|one offset and one distance"):
            policy_named("path-near").rank(dataclasses.replace(context, neighbourhood=broken))


def test_unknown_policy_is_refused_with_the_known_ones_named() -> None:
    with pytest.raises(ConfigError, match=r"'nearest'.*distance.*path, path-near, .*recall"):
        policy_named("nearest")
