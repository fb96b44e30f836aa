"""What is particular to each of the policies that others are measured against."""

import dataclasses

import numpy as np
import pytest

from engram.errors import ConfigError
from engram.graph.model import PathEntry, PathEntryKind, path_id
from engram.ranking.context import Foreseen
from engram.ranking.policies import policy_named, policy_names
from engram.robot.settings import RobotOptions
from engram.testing.contracts import flat_graph, make_context, memory_of, run_of, session_uuid
from engram_lab.policies import TimeOfDayPolicy, session_tallies


def order_of(name: str, context) -> list[int]:
    """The candidates' nodes in ranked order."""
    return context.neighbourhood.nodes[policy_named(name).rank(context)].tolist()


class TestOracle:
    def test_orders_by_success_then_inliers_then_distance(self) -> None:
        known = Foreseen(np.array([False, True, True, False, True]), np.array([90, 30, 50, 10, 50]))
        context = make_context(candidates=range(5), along_m=[0, 1, 3, 2, 2])
        context = dataclasses.replace(context, foresee=lambda: known)
        assert order_of("oracle", context) == [4, 2, 1, 0, 3]

    def test_a_drive_is_refused(self) -> None:
        with pytest.raises(ConfigError, match="engram lab evaluate"):
            RobotOptions(ranking="oracle")

    def test_a_context_without_foresight_is_refused(self) -> None:
        with pytest.raises(ConfigError, match="engram lab evaluate"):
            policy_named("oracle").rank(make_context(candidates=[0]))


class TestNearestOfEach:
    def test_sessions_take_turns_and_each_offers_its_nearest(self) -> None:
        # Session 0 saved the even nodes, session 1 the odd ones.
        context = make_context(
            candidates=[0, 2, 4, 1, 3], along_m=[0.1, 0.2, 0.3, 1.0, 2.0], sessions=2
        )
        assert order_of("nearest-of-each", context) == [0, 1, 2, 3, 4]


class TestTimeOfDay:
    def test_the_nearest_hour_comes_first_the_short_way_round_midnight(self) -> None:
        context = make_context(candidates=[0, 1, 2], sessions=3, hour=23.5, hours=[20.0, 0.5, 12.0])
        assert order_of("time-of-day", context) == [1, 0, 2]

    def test_experiences_take_turns(self) -> None:
        context = make_context(candidates=range(6), sessions=2, hour=9.0, hours=[17.0, 9.0])
        assert order_of("time-of-day", context) == [1, 0, 3, 2, 5, 4]

    def test_of_equal_hours_the_younger_comes_first_and_unknown_ones_last(self) -> None:
        context = make_context(
            candidates=[0, 1, 2],
            along_m=[0.0, 3.0, 2.0],
            sessions=3,
            hour=9.0,
            hours=[None, 9.0 + 24, 9.0],
            day=50 / 24,
        )
        assert order_of("time-of-day", context) == [1, 2, 0]

    def test_without_a_clock_of_its_own_the_youngest_comes_first(self) -> None:
        context = make_context(
            candidates=[0, 1, 2], sessions=3, hours=[9.0, 9.0 + 24, None], day=50 / 24
        )
        assert order_of("time-of-day", context) == [1, 0, 2]

    def test_without_a_date_of_its_own_the_newest_comes_first(self) -> None:
        context = make_context(
            candidates=[0, 1, 2], sessions=3, hours=[9.0, 9.0 + 48, 9.0 + 24], stamp_ns=1000
        )
        assert order_of("time-of-day", context) == [1, 2, 0]
        assert TimeOfDayPolicy().reasons(context).terms["days apart"].tolist() == [2.0, 0.0, 1.0]

    def test_without_any_clock_the_nearest_comes_first(self) -> None:
        context = make_context(candidates=[0, 1], along_m=[2.0, 1.0], sessions=2)
        assert order_of("time-of-day", context) == [1, 0]


class TestBagOfWords:
    def test_the_experience_that_looks_like_the_frame_comes_first(self) -> None:
        context = make_context(
            candidates=[0, 1, 2, 3],
            along_m=[0.0, 0.5, 0.2, 0.7],
            sessions=2,
            words={0: [1, 2], 2: [3], 1: [7, 8], 3: [8, 9]},
            live_words=[7, 8, 9],
        )
        assert order_of("bag-of-words", context) == [1, 0, 3, 2]

    def test_nodes_farther_than_two_metres_do_not_count_where_others_are_nearer(self) -> None:
        words = {0: [1], 2: [7, 8, 9], 1: [7, 30, 31]}
        context = make_context(
            candidates=[0, 2, 1],
            along_m=[0.0, 5.0, 3.0],
            sessions=2,
            words=words,
            live_words=[7, 8, 9],
        )
        # Session 0 looks like node 0 here, which shows none of the words; session 1 has only a
        # node 3 m away, and that one shows a word.
        assert order_of("bag-of-words", context)[0] == 1

    def test_rare_words_count_more(self) -> None:
        # Of the made-up vocabulary word 49 is the rarest, word 0 the most common.
        context = make_context(
            candidates=[0, 1],
            sessions=2,
            words={0: [0, 20], 1: [49, 20]},
            live_words=[0, 49],
        )
        assert order_of("bag-of-words", context) == [1, 0]


class TestBandit:
    def test_probability_is_the_published_one(self) -> None:
        context = make_context(
            candidates=[0, 1],
            sessions=2,
            run=[(-8.0, 0, 0.5, False), (0.0, 0, 0.9, True), (-4.0, 1, np.nan, False)],
        )
        successes, failures = session_tallies(context)
        np.testing.assert_allclose(successes, [1.0, 0.0])
        # A failure counts as much as a success was likely; without a prediction it says nothing.
        np.testing.assert_allclose(failures, [0.5 * np.exp(-1.0), 0.0])

    def test_a_session_that_failed_nearby_steps_back(self) -> None:
        context = make_context(
            candidates=[0, 1], along_m=[0.0, 0.5], sessions=2, run=[(-1.0, 0, 0.9, False)]
        )
        assert order_of("bandit", context) == [1, 0]

    def test_the_second_pick_is_of_another_session(self) -> None:
        context = make_context(
            candidates=[0, 2, 1],
            along_m=[0.0, 0.1, 0.4],
            sessions=2,
            run=[(-1.0, 0, 0.9, True)],
        )
        # p = (1 + 0.3) / (1 + 1) = 0.6 for node 2 after the pick of node 0: 0.6 · (1 − 0.8 · 0.6)
        # is less than the 0.3 of a session never tried only once the pick counts.
        assert order_of("bandit", context) == [0, 2, 1]
        twice = dataclasses.replace(
            context, run=run_of([(-1.0, 0, 0.9, True)] * 6 + [(-1.0, 1, 0.9, True)])
        )
        assert order_of("bandit", twice) == [0, 1, 2]


class TestCollaborative:
    def test_the_drive_that_matched_what_matches_now_comes_first(self) -> None:
        # Three sessions took turns: node 3 was saved by session 0, and session 2 matched it.
        graph = flat_graph(9, sessions=3)
        memory = memory_of(graph, [])
        entry = PathEntry(path_id(session_uuid(2)), 0, graph.node(3).id, PathEntryKind.MATCHED, 0)
        memory.add(entry)
        context = make_context(
            graph=graph, candidates=[7, 8], along_m=[0.0, 1.0], run=[(-1.0, 3, 0.9, True)]
        )
        context = dataclasses.replace(context, path_memory=memory)
        assert order_of("collaborative", context) == [8, 7]

    def test_an_experience_that_was_seen_much_here_must_explain_more(self) -> None:
        graph = flat_graph(12, sessions=2)
        context = make_context(
            graph=graph,
            candidates=[0, 2, 4, 6, 1],
            along_m=[0.0, 0.1, 0.2, 0.3, 0.4],
            run=[(-1.0, 8, 0.9, True), (-1.0, 9, 0.9, True)],
        )
        assert order_of("collaborative", context)[0] == 1


def test_random_depends_on_seed_and_stamp() -> None:
    orders = {
        tuple(policy_named("random").rank(make_context(candidates=range(12), **varied)).tolist())
        for varied in ({}, {"seed": 1}, {"stamp_ns": 1}, {"seed": 1, "stamp_ns": 1})
    }
    assert len(orders) == 4


def test_no_policy_but_the_oracle_needs_foresight() -> None:
    context = make_context(candidates=[0, 1, 2], sessions=2)
    for name in {*policy_names()} - {"oracle"}:
        assert len(policy_named(name).rank(context)) == 3
