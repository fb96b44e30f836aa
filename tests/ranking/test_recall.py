"""Γ(recall): what it is, and what it is to do."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.reference import recall as reference
from tests.worlds import (
    flat_graph,
    forward,
    lessons_of,
    make_context,
    make_edge,
    memory_of,
    run_of,
    session_uuid,
)

from engram import _core
from engram.experience.model import PathEntry, PathEntryKind, path_id
from engram.experience.path_memory import PathMemory
from engram.ranking import Lessons, PastAttempts
from engram.ranking.recall import RECALL, RecallPolicy
from engram.ranking.synthetic import SyntheticPlace

SESSIONS = 4


@st.composite
def situations(draw):
    nodes = draw(st.integers(2, 20))
    node = st.integers(0, nodes - 1)
    rate = st.sampled_from([0.1, 0.5, 0.9])
    candidates = draw(st.lists(node, min_size=1, max_size=nodes, unique=True))
    hours = draw(st.lists(st.none() | st.floats(0, 23), min_size=SESSIONS, max_size=SESSIONS))
    attempt = st.tuples(st.floats(-40, 0), node, rate, st.booleans())
    lessons = draw(
        st.lists(st.tuples(st.integers(0, SESSIONS - 1), node, rate, st.booleans()), max_size=15)
    )
    context = make_context(
        candidates=candidates,
        along_m=[draw(st.floats(-4, 4)) for _ in candidates],
        sessions=SESSIONS,
        run=sorted(draw(st.lists(attempt, max_size=10)), key=lambda one: one[0]),
        hour=draw(st.none() | st.floats(0, 23)),
        hours=hours,
        lessons=lessons,
    )
    return context, lessons, hours


@given(situations())
@settings(max_examples=80)
def test_order_is_that_of_the_formulas(situation) -> None:
    context, lessons, hours = situation
    count = int(context.graph.sessions.max()) + 1
    count = max([count, *(attempt[0] + 1 for attempt in lessons)])
    table = reference.lessons(context.graph, count, lessons, context.graph.sessions)
    known = [np.nan if hour is None else hour for hour in hours][:count]
    found = RecallPolicy().rank(context).tolist()
    to_pick, lost = iter(found), []

    def follow(odds: list[float], left: list[int]) -> int:
        place = left.index(next(to_pick))
        lost.append(max(odds) - odds[place])
        return place

    # Each pick is the best one after those before it. The table holds single precision, so where
    # candidates all but tie either may be picked.
    assert reference.order(context, table, RECALL, known, follow) == found
    assert max(lost) < 1e-3


def nodes_of(context, policy=None) -> list[int]:
    order = (policy or RecallPolicy()).rank(context)
    return context.neighbourhood.nodes[order].tolist()


class TestLearning:
    """Three sessions took turns: node n was saved by session n % 3."""

    def test_what_like_minded_drives_failed_with_stands_back(self) -> None:
        # Drives 0 and 3 fared alike with node 6; drive 3 failed with 1 and matched 2.
        lessons = [(3, 6, 0.9, True)] * 3 + [(3, 1, 0.9, False)] * 3 + [(3, 2, 0.9, True)] * 3
        context = make_context(
            candidates=[1, 2],
            along_m=[0.0, 0.4],
            sessions=3,
            run=[(-1.0, 6, 0.9, True)] * 2,
            lessons=lessons,
        )
        assert nodes_of(context) == [2, 1]
        without = make_context(
            candidates=[1, 2], along_m=[0.0, 0.4], sessions=3, run=[(-1.0, 6, 0.9, True)] * 2
        )
        assert nodes_of(without) == [1, 2]

    def test_failures_of_this_run_tell_which_drives_it_is_not_like(self) -> None:
        # Drive 3 matched node 6 and node 1, drive 4 neither; this run fails with 6.
        lessons = [(3, 6, 0.9, True), (3, 1, 0.9, True), (4, 6, 0.9, False), (4, 1, 0.9, False)]
        lessons = 3 * [*lessons, (4, 2, 0.9, True), (3, 2, 0.9, False)]
        situation = {
            "candidates": [1, 2],
            "along_m": [0.0, 0.0],
            "sessions": 3,
            "lessons": lessons,
        }
        failed = make_context(**situation, run=[(-1.0, 6, 0.9, False)] * 3)
        matched = make_context(**situation, run=[(-1.0, 6, 0.9, True)] * 3)
        assert nodes_of(failed) == [2, 1]
        assert nodes_of(matched) == [1, 2]

    def test_a_failure_far_away_teaches_next_to_nothing(self) -> None:
        situation = {"candidates": [0, 1], "along_m": [0.0, 1.0], "sessions": 2}
        far = make_context(**situation, run=[(-1.0, 0, 0.01, False)] * 5)
        near = make_context(**situation, run=[(-1.0, 0, 0.9, False)] * 5)
        assert nodes_of(far) == [0, 1]
        assert nodes_of(near) == [1, 0]

    def test_evidence_is_shared_along_an_experience_only(self) -> None:
        graph = flat_graph(12, sessions=2)
        for index in range(0, 8, 2):  # nodes 0, 2, 4, … of session 0 are one chain
            graph.add_edge(make_edge(graph.node(index).id, graph.node(index + 2).id, forward(2.0)))
        lessons = lessons_of(graph, [(1, 4, 0.9, False)] * 4)
        base = lessons.base
        assert base[4] < base[2] < base[0]
        assert base[2] == pytest.approx(base[6])
        assert base[0] < base[10]  # not of the chain

    def test_a_drive_whose_attempts_are_forgotten_speaks_by_its_path(self) -> None:
        graph = flat_graph(4, sessions=2)
        memory = PathMemory(graph)
        walker = path_id(session_uuid(7))
        memory.add(PathEntry(walker, 0, graph.node(1).id, PathEntryKind.MATCHED, 0))
        lessons = Lessons.learnt(graph, memory, [walker], np.array([np.nan]), PastAttempts.none())
        assert lessons.entry_viewers.tolist() == [0]
        assert lessons.starts.tolist() == [0, 0, 1, 1, 1]
        assert lessons.rates[0] > lessons.base[1] > 0.4

    def test_the_live_drive_is_no_past_drive(self) -> None:
        """A session that is resumed finds its own attempts in the map."""
        lessons = [(0, 1, 0.9, True)] * 9 + [(0, 3, 0.9, True)] * 9
        context = make_context(
            candidates=[1, 2], sessions=4, run=[(-1.0, 3, 0.9, True)] * 3, lessons=lessons
        )
        policy = RecallPolicy()
        own = path_id(session_uuid(0))
        assert policy.judge(context).viewers[0] > 0.2
        judged = policy.judge(dataclasses.replace(context, own_path=own))
        assert judged.viewers[0] == 0


class TestPicking:
    def test_the_second_pick_is_not_one_that_fails_with_the_first(self) -> None:
        context = make_context(candidates=[0, 2, 4, 1], along_m=[0.0, 0.1, 0.2, 0.6], sessions=2)
        assert nodes_of(context)[:2] == [0, 1]

    def test_one_lane_does_not_get_stuck_when_the_light_changes(self) -> None:
        """The old experience matched for long, and past drives swear by it; now it fails."""
        lessons = [(2, 0, 0.9, True), (2, 1, 0.9, False)] * 5
        run = [(0.5 * k - 20.0, 0, 0.9, True) for k in range(40)]
        driven_m, tried = 0.0, []
        while 1 not in tried and driven_m < 20:
            context = make_context(
                candidates=[0, 1], along_m=[0.0, 0.3], sessions=2, run=run, lessons=lessons
            )
            context = dataclasses.replace(context, run=run_of(run, driven_m))
            tried.append(nodes_of(context)[0])
            run.append((driven_m, tried[-1], 0.9, False))
            driven_m += 0.5
        assert tried[0] == 0
        # Before the robot counts as lost, though all that it knows speaks against it.
        assert driven_m < 10

    def test_without_a_clock_it_does_not_matter_what_time_it_is(self) -> None:
        policy = RecallPolicy(clock=False)
        situation = {"candidates": [0, 1], "along_m": [0.0, 0.2], "sessions": 2}
        orders = {
            tuple(nodes_of(make_context(**situation, hour=hour, hours=[3.0, 12.0]), policy))
            for hour in (None, 3.0, 12.0)
        }
        assert len(orders) == 1
        noon = make_context(**situation, hour=12.0, hours=[3.0, 12.0])
        assert nodes_of(noon) == [1, 0]

    def test_terms_add_up_to_the_chance_of_the_first_pick(self) -> None:
        context = SyntheticPlace(20).context(candidates=60, observed=200)
        judged = RecallPolicy().judge(context)
        first = judged.order[0]
        odds = sum(values[first] for values in judged.terms.values())
        assert judged.chances[first] == pytest.approx(1 / (1 + np.exp(-odds)), rel=1e-9)


def test_a_table_that_does_not_fit_is_refused() -> None:
    starts = np.array([0, 1], np.int64)
    one = np.full(1, 0.5, np.float32)
    good = (starts, np.zeros(1, np.int32), one, one, one, np.full(1, 0.5), 1)
    _core.RecallLessons(*good)
    for at, bad in (
        (0, np.array([0, 2], np.int64)),
        (0, np.array([1, 1], np.int64)),
        (1, np.ones(1, np.int32)),
        (1, np.full(1, -1, np.int32)),
        (2, np.zeros(2, np.float32)),
        (5, np.full(2, 0.5)),
    ):
        with pytest.raises(ValueError, match="recall_order"):
            _core.RecallLessons(*good[:at], bad, *good[at + 1 :])


def test_path_memory_is_left_alone() -> None:
    context = make_context(candidates=[0, 1], paths=[[0, 1]], sessions=2)
    before = memory_of(context.graph, [[0, 1]]).paths
    RecallPolicy().rank(context)
    assert list(context.path_memory.paths) == list(before)
