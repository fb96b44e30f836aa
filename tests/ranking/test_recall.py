"""Γ(recall): what it is, and what it is to do."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.builders import forward, make_edge
from tests.reference import recall as reference

from engram import _core
from engram.graph.basin import prior_basin_m
from engram.graph.model import PathEntry, PathEntryKind, path_id
from engram.graph.paths import Attempts, PathMemory
from engram.ranking.lessons import UNKNOWN_BASE, Lessons
from engram.ranking.recall import RECALL, RecallPolicy
from engram.ranking.recent import AttemptHistory
from engram.testing.contracts import (
    flat_graph,
    lessons_of,
    make_context,
    memory_of,
    run_of,
    session_uuid,
)
from engram_lab.bench.synthetic import SyntheticPlace

SESSIONS = 4


@st.composite
def situations(draw):
    nodes = draw(st.integers(2, 20))
    node = st.integers(0, nodes - 1)
    rate = st.sampled_from([0.1, 0.5, 0.9])
    candidates = draw(st.lists(node, min_size=1, max_size=nodes, unique=True))
    attempt = st.tuples(st.floats(-40, 0), node, rate | st.just(np.nan), st.booleans())
    lessons = draw(
        st.lists(st.tuples(st.integers(0, SESSIONS - 1), node, rate, st.booleans()), max_size=15)
    )
    run = sorted(draw(st.lists(attempt, max_size=10)), key=lambda one: one[0])
    context = make_context(
        candidates=candidates,
        along_m=[draw(st.floats(-4, 4)) for _ in candidates],
        sessions=SESSIONS,
        run=run,
        lessons=lessons,
    )
    # Some matches fall short of the 20 inliers needed, some are refused for where they are.
    inliers = [
        draw(st.integers(20, 200) if one[3] else st.sampled_from([0, 1, 12, 19, 60])) for one in run
    ]
    attempts = dataclasses.replace(context.run, inliers=np.array(inliers, np.int64))
    return dataclasses.replace(context, run=attempts), lessons


@given(situations())
def test_order_is_that_of_the_formulas(situation) -> None:
    context, lessons = situation
    rates = reference.base(context.graph, lessons, range(len(context.graph)))
    found = RecallPolicy().rank(context).tolist()
    to_pick, lost = iter(found), []

    def follow(margins: list[float], left: list[int]) -> int:
        place = left.index(next(to_pick))
        lost.append(max(margins) - margins[place])
        return place

    # Each pick is the best one after those before it; where candidates all but tie, sums in
    # another order may prefer either.
    assert reference.order(context, rates, RECALL, prior_basin_m(256.0), follow) == found
    assert max(lost) < 1e-9


def nodes_of(context, policy=None) -> list[int]:
    order = (policy or RecallPolicy()).rank(context)
    return context.neighbourhood.nodes[order].tolist()


class TestLearning:
    """Three sessions took turns: node n was saved by session n % 3."""

    def test_what_past_drives_failed_with_stands_back(self) -> None:
        situation = {"candidates": [1, 2], "along_m": [0.0, 0.4], "sessions": 3}
        lessons = [(3, 1, 0.9, False)] * 4 + [(3, 2, 0.9, True)] * 4
        assert nodes_of(make_context(**situation, lessons=lessons)) == [2, 1]
        assert nodes_of(make_context(**situation)) == [1, 2]

    def test_what_this_run_finds_weighs_more_than_what_past_drives_say(self) -> None:
        context = make_context(
            candidates=[1, 2],
            along_m=[0.0, 0.4],
            sessions=3,
            run=[(-1.0, 4, 0.9, True)],
            lessons=[(3, 1, 0.9, False)] * 4 + [(3, 2, 0.9, True)] * 4,
        )
        assert nodes_of(context) == [1, 2]

    def test_many_inliers_speak_for_a_session_more_than_few(self) -> None:
        context = make_context(
            candidates=[0, 1],
            along_m=[0.0, 0.4],
            sessions=2,
            run=[(-1.0, 2, 0.9, True), (-1.0, 3, 0.9, True)],
        )
        few_and_many = dataclasses.replace(context.run, inliers=np.array([22, 90]))
        many_and_few = dataclasses.replace(context.run, inliers=np.array([90, 22]))
        assert nodes_of(dataclasses.replace(context, run=few_and_many)) == [1, 0]
        assert nodes_of(dataclasses.replace(context, run=many_and_few)) == [0, 1]

    def test_a_near_miss_counts_less_than_no_match_at_all(self) -> None:
        context = make_context(
            candidates=[0, 1],
            along_m=[0.0, 0.1],
            sessions=2,
            run=[(-1.0, 2, 0.9, False), (-1.0, 3, 0.9, False)],
        )
        near_miss = dataclasses.replace(context.run, inliers=np.array([0, 19]))
        assert nodes_of(dataclasses.replace(context, run=near_miss)) == [1, 0]
        # One that has inliers enough and is refused is a match of something else.
        elsewhere = dataclasses.replace(context.run, inliers=np.array([19, 60]))
        assert nodes_of(dataclasses.replace(context, run=elsewhere)) == [0, 1]

    def test_the_very_node_speaks_louder_than_its_session(self) -> None:
        context = make_context(
            candidates=[0, 1],
            along_m=[0.0, 0.2],
            run=[(-1.0, 0, 0.9, False), (-1.0, 1, 0.9, True)],
        )
        assert nodes_of(context) == [1, 0]

    def test_a_longer_lens_minds_distance_less(self) -> None:
        situation = {
            "candidates": [0, 1],
            "along_m": [0.0, 3.0],
            "sessions": 2,
            "run": [(-1.0, 2, 0.9, True), (-1.0, 3, 0.9, True)],
        }
        wide, long = (make_context(**situation, focal_px=focal) for focal in (256.0, 707.0))
        inliers = np.array([25, 60])
        near, far = (
            nodes_of(dataclasses.replace(one, run=dataclasses.replace(one.run, inliers=inliers)))
            for one in (wide, long)
        )
        assert near == [0, 1]
        assert far == [1, 0]

    def test_a_failure_far_away_teaches_next_to_nothing(self) -> None:
        situation = {"candidates": [0, 1], "along_m": [0.0, 2.0], "sessions": 2}
        far = make_context(**situation, run=[(-1.0, 0, 0.01, False)] * 5)
        near = make_context(**situation, run=[(-1.0, 0, 0.9, False)] * 5)
        assert nodes_of(far) == [0, 1]
        assert nodes_of(near) == [1, 0]

    def test_where_nobody_was_expected_to_match_a_failure_teaches_nothing(self) -> None:
        context = make_context(candidates=[0, 1], sessions=2, run=[(-1.0, 0, 0.9, False)] * 5)
        beyond = dataclasses.replace(context.run, distance_m=np.full(5, 8.0))
        judged = RecallPolicy().judge(dataclasses.replace(context, run=beyond))
        assert judged.terms["this run"].tolist() == [0.0, 0.0]
        assert RecallPolicy().judge(context).terms["this run"][0] < -1

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
        base = Lessons.learnt(graph, memory, [walker], Attempts.none(), np.zeros(0)).base
        assert base[1] > base[0] == base[2] == base[3] == pytest.approx(UNKNOWN_BASE)

    def test_of_nodes_saved_since_the_map_was_opened_nothing_is_known(self) -> None:
        lessons = lessons_of(flat_graph(3), [(0, 1, 0.9, False)])
        known = lessons.log_odds_of(np.array([1, 3, 0, 9], np.int32))
        unknown = np.log(UNKNOWN_BASE / (1 - UNKNOWN_BASE))
        assert known[1] == known[3] == unknown
        assert known[2] == np.log(lessons.base[0] / (1 - lessons.base[0]))
        assert Lessons.none().log_odds_of(np.array([4], np.int32)).tolist() == [unknown]


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

    @pytest.mark.parametrize("step_m", [0.7, 0.0])
    @pytest.mark.parametrize("inliers", [5, 12, 15, 17, 19])
    @pytest.mark.parametrize("aside_m", [0.5, 1.0, 1.5, 2.0])
    def test_what_nearly_matches_for_ever_is_not_tried_for_ever(
        self, step_m: float, inliers: int, aside_m: float
    ) -> None:
        """The nearest node's drive falls short of 20 inliers each time, the other's would match."""
        history, driven_m, tried = AttemptHistory(), 0.0, []
        for _ in range(30):
            history.begin_frame(driven_m)
            context = make_context(candidates=[0, 1], along_m=[0.0, aside_m], sessions=2)
            context = dataclasses.replace(context, run=history.run())
            pick = int(context.neighbourhood.nodes[RecallPolicy().rank(context)[0]])
            matched = pick == 1
            rates = context.success_rates()[[pick]]
            away_m = context.neighbourhood.rms_distance_m[[pick]]
            count = 40 if matched else inliers
            history.add([pick], (away_m, rates), [matched], [count], 300)
            tried.append(pick)
            driven_m += step_m
        # Once found, what matches is not left again.
        assert 1 in tried[:12]
        assert sum(tried[12:]) >= 15

    @pytest.mark.parametrize(
        ("lanes", "elsewhere", "sigma_m", "all_are_tried"),
        [
            (2, 0, 7.0, True),
            (2, 0, 0.2, False),
            (2, 62, 7.0, True),  # as many as a relocaliser may try in every frame
            (1, 0, 7.0, True),
            (1, 31, 7.0, True),
        ],
    )
    def test_a_robot_that_lost_its_place_tries_every_candidate(
        self, lanes: int, elsewhere: int, sigma_m: float, all_are_tried: bool
    ) -> None:
        """Thirty nodes over 29 m, of which none matches; as many picks of each kind."""
        count, history, driven_m = 30, AttemptHistory(), 0.0
        tried: set[int] = set()
        for _ in range(2 * count // lanes + 2):
            history.begin_frame(driven_m)
            context = make_context(
                candidates=range(count), along_m=np.arange(float(count)), sessions=3
            )
            near = dataclasses.replace(context.neighbourhood, sigma_m=np.full(count, sigma_m))
            context = dataclasses.replace(context, neighbourhood=near, run=history.run())
            picks = nodes_of(context)
            assert sorted(picks) == list(range(count))
            tried |= set(picks[:lanes])
            nodes = [*picks[:lanes], *(number % count for number in range(elsewhere))]
            rates = np.r_[np.full(lanes, 0.9), np.full(elsewhere, np.nan)]
            failed = [False] * len(nodes)
            history.add(nodes, (5 * (1 - rates), rates), failed, [0] * len(nodes), 300)
            driven_m += 0.7
        assert (tried == set(range(count))) is all_are_tried

    def test_it_tells_whose_place_is_by_turn(self) -> None:
        """The nearest two of three were tried long ago, and nobody knows where the robot is."""
        context = make_context(
            candidates=range(3),
            along_m=[0.0, 1.5, 3.0],
            sessions=3,
            run=[(-40.0, 0, 0.9, False), (-40.0, 1, 0.9, False)],
        )
        near = dataclasses.replace(context.neighbourhood, sigma_m=np.full(3, 3.0))
        judged = RecallPolicy().judge(dataclasses.replace(context, neighbourhood=near))
        assert judged.order.tolist() == [0, 2, 1]
        assert judged.by_turn.tolist() == [False, False, True]
        assert not RecallPolicy().judge(context).by_turn.any()

    def test_what_is_known_vaguely_stands_behind_what_is_near(self) -> None:
        context = make_context(candidates=[0, 1], along_m=[0.0, 1.0], sessions=2)
        assert nodes_of(context) == [0, 1]
        near = dataclasses.replace(context.neighbourhood, sigma_m=np.array([5.0, 0.1]))
        assert nodes_of(dataclasses.replace(context, neighbourhood=near)) == [1, 0]

    def test_terms_add_up_to_the_chance_of_the_first_pick(self) -> None:
        context = SyntheticPlace(20).context(candidates=60, observed=200)
        judged = RecallPolicy().judge(context)
        first = judged.order[0]
        margin = sum(values[first] for values in judged.terms.values())
        odds = RECALL.bias + RECALL.steepness * margin
        assert judged.chances[first] == pytest.approx(1 / (1 + np.exp(-odds)), rel=1e-9)


def test_arrays_that_do_not_fit_are_refused() -> None:
    one, node = np.zeros(1), np.zeros(1, np.int32)
    groups = {
        _core.RecallRun: {
            "driven_m": 0.0,
            "at_m": one,
            "nodes": node,
            "sessions": node,
            "distance_m": one,
            "rates": one,
            "accepted": np.ones(1, np.bool_),
            "inliers": np.full(1, 30),
        },
        _core.RecallCandidates: {
            "nodes": node,
            "sessions": node,
            "costs": one,
            "prior": one,
        },
    }
    good_run, good_candidates = (make(**values) for make, values in groups.items())
    constants = RecallPolicy()._bound
    _core.recall_order(good_run, good_candidates, constants)
    for make, name, bad in (
        (_core.RecallRun, "at_m", np.zeros(2)),
        (_core.RecallRun, "sessions", np.zeros(2, np.int32)),
        (_core.RecallRun, "distance_m", np.zeros(0)),
        (_core.RecallRun, "rates", np.zeros(2)),
        (_core.RecallRun, "accepted", np.ones(2, np.bool_)),
        (_core.RecallRun, "inliers", np.ones(2, np.int64)),
        (_core.RecallCandidates, "costs", np.zeros(2)),
        (_core.RecallCandidates, "prior", np.zeros(0)),
    ):
        with pytest.raises(ValueError, match="recall_order"):
            make(**{**groups[make], name: bad})
    for name, bad in (
        ("memory_m", 0.0),
        ("tally_memory_m", np.nan),
        ("prior_weight", 0.0),
        ("regret", -1.0),
        ("untried_rate", 0.0),
        ("untried_attempts", -1.0),
        ("needed", 0),
        ("attempts", -1),
        ("picks", -1),
    ):
        constants = RecallPolicy()._bound
        setattr(constants, name, bad)
        with pytest.raises(ValueError, match="recall_order"):
            _core.recall_order(good_run, good_candidates, constants)


def test_path_memory_is_left_alone() -> None:
    context = make_context(candidates=[0, 1], paths=[[0, 1]], sessions=2)
    before = memory_of(context.graph, [[0, 1]]).paths
    RecallPolicy().rank(context)
    assert list(context.path_memory.paths) == list(before)


def test_sessions_without_candidates_cost_nothing() -> None:
    """Numbers of sessions are names: work and memory follow the candidates, not the map."""
    nodes, far = np.arange(2, dtype=np.int32), np.array([2**31 - 1, 7], np.int32)
    near = np.array([1, 0], np.int32)
    one = np.ones(2)
    orders = []
    for sessions in (far, near):
        run = _core.RecallRun(
            9.0, one, nodes, sessions, one, one, np.ones(2, np.bool_), np.array([90, 25])
        )
        candidates = _core.RecallCandidates(nodes, sessions, one, np.zeros(2))
        orders.append(_core.recall_order(run, candidates, RecallPolicy()._bound))
    for a, b in zip(*orders, strict=True):
        assert np.array_equal(a, b)
    assert orders[0][0].tolist() == [0, 1]
