"""The contract of every ranking policy, and what is particular to each."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.worlds import make_context, neighbourhood_of, path_uuid

from engram.errors import ConfigError
from engram.graph.basin import BASIN_LEVEL
from engram.ranking import Foreseen, RankingContext, policy_named, policy_names
from engram.ranking.context import order_by
from engram.ranking.path import PathPolicy


@st.composite
def contexts(draw) -> RankingContext:
    nodes = draw(st.integers(1, 25))
    some = st.lists(st.integers(0, nodes - 1), max_size=nodes, unique=True)
    candidates = draw(some)
    observed = draw(some)
    hours = st.none() | st.floats(0, 23.99)
    words = st.lists(st.integers(0, 9), max_size=5, unique=True).map(sorted)
    run = st.tuples(
        st.floats(-50, 0),
        st.integers(0, nodes - 1),
        st.sampled_from([0.0, 0.3, 0.9, np.nan]),
        st.booleans(),
    )
    context = make_context(
        paths=draw(st.lists(some, max_size=8)),
        candidates=candidates,
        # Few values, so that ties in distance are common.
        along_m=[draw(st.sampled_from([-3.0, -0.5, 0.0, 0.5, 1.0, 6.0])) for _ in candidates],
        observed=observed,
        outcomes=[draw(st.booleans()) for _ in observed],
        reference=draw(st.none() | st.integers(0, nodes - 1)),
        own_path=draw(st.none() | st.just(path_uuid(0))),
        stamp_ns=draw(st.integers(0, 2**62)),
        sessions=draw(st.integers(1, 5)),
        run=sorted(draw(st.lists(run, max_size=12)), key=lambda attempt: attempt[0]),
        hour=draw(hours),
        hours=draw(st.lists(hours, max_size=5)),
        words=draw(st.none() | st.dictionaries(st.integers(0, nodes - 1), words)),
        live_words=draw(st.none() | words),
        lessons=draw(
            st.lists(
                st.tuples(
                    st.integers(0, 4),
                    st.integers(0, nodes - 1),
                    st.sampled_from([0.0, 0.3, 0.9]),
                    st.booleans(),
                ),
                max_size=12,
            )
        ),
    )
    return foreknown(context, draw(st.integers(0, 2**32)))


def foreknown(context: RankingContext, seed: int = 0) -> RankingContext:
    """The context with made-up foresight, a property of the node and not of the row."""
    nodes = context.neighbourhood.nodes

    def tell() -> Foreseen:
        rng = np.random.default_rng(seed)
        inliers = rng.integers(0, 4, len(context.graph)) * 10
        return Foreseen(inliers[nodes] >= 20, inliers[nodes])

    return dataclasses.replace(context, foresee=tell)


@pytest.mark.parametrize("name", sorted(policy_names()))
class TestContract:
    def test_name_is_the_one_in_the_table(self, name: str) -> None:
        assert policy_named(name).name == name

    @given(context=contexts())
    @settings(max_examples=25)
    def test_ranking_is_a_permutation_of_the_rows(self, name: str, context) -> None:
        order = policy_named(name).rank(context)
        assert order.dtype == np.int64
        assert sorted(order.tolist()) == list(range(len(context.neighbourhood)))

    @given(context=contexts(), seed=st.integers(0, 2**32))
    @settings(max_examples=25)
    def test_order_of_nodes_does_not_depend_on_the_order_of_rows(
        self, name: str, context, seed: int
    ) -> None:
        shuffle = np.random.default_rng(seed).permutation(len(context.neighbourhood))
        near = context.neighbourhood
        shuffled = foreknown(
            dataclasses.replace(
                context,
                neighbourhood=neighbourhood_of(near.nodes[shuffle], near.along_m[shuffle]),
            )
        )
        context = foreknown(context)
        nodes = near.nodes[policy_named(name).rank(context)]
        again = shuffled.neighbourhood.nodes[policy_named(name).rank(shuffled)]
        np.testing.assert_array_equal(nodes, again)

    @given(context=contexts())
    @settings(max_examples=15)
    def test_one_policy_serves_again_and_gives_the_same(self, name: str, context) -> None:
        policy = policy_named(name)
        first = policy.rank(context)
        policy.rank(foreknown(make_context(candidates=[0, 1, 2], paths=[[0, 1]], reference=1)))
        np.testing.assert_array_equal(first, policy.rank(context))

    def test_no_candidates_give_an_empty_order(self, name: str) -> None:
        assert policy_named(name).rank(foreknown(make_context())).shape == (0,)

    def test_the_live_path_does_not_count(self, name: str) -> None:
        situation = {
            "candidates": [0, 1, 2, 3],
            "observed": [4, 5, 6],
            "outcomes": [True, True, False],
            "reference": 4,
        }
        past = [[4, 1, 5], [6, 2]]
        without = make_context(paths=past, **situation)
        with_live = make_context(
            paths=[*past, [4, 3, 5], [4, 3, 5]][:3], own_path=path_uuid(2), **situation
        )
        policy = policy_named(name)
        np.testing.assert_array_equal(
            policy.rank(foreknown(without)), policy.rank(foreknown(with_live))
        )

    def test_a_robot_on_its_first_day_gets_an_order(self, name: str) -> None:
        """No history, clock, words or position: all candidates, and the nearest first."""
        context = foreknown(make_context(candidates=[4, 2, 7], along_m=[2.0, 0.5, 1.0], sessions=3))
        order = policy_named(name).rank(context)
        assert sorted(order.tolist()) == [0, 1, 2]
        if name not in {"random", "oracle"}:
            assert order.tolist() == [1, 2, 0]


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


@given(context=contexts())
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
