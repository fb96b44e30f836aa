"""[L15 §V]: a worked example, and the kernel against exact fractions."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.reference.path_posterior import posterior, prior_of, theta_row

from engram.graph.model import PathEntry, PathEntryKind
from engram.graph.paths import PathMemory
from engram.ranking.policies import PathPolicy
from engram.testing.contracts import (
    flat_graph,
    make_context,
    memory_of,
    neighbourhood_of,
    path_uuid,
)
from engram_lab.policies import PathNearPolicy


def scores_of(memory: PathMemory, candidates, *evidence, **options) -> np.ndarray:
    """(Y,) log posterior of candidates, given W, z and k."""
    return memory.scores(candidates, memory.evidence(*evidence, **options))


def posterior_of(memory: PathMemory, candidates, observed, outcomes, reference, **options):
    scores = scores_of(
        memory,
        np.array(candidates, np.int32),
        np.array(observed, np.int32),
        np.array(outcomes, np.bool_),
        reference,
        **options,
    )
    weights = np.exp(scores - scores.max())
    return weights / weights.sum(), scores


# [L15 Fig. 5]; n1…n9 are the indices 1…9.
EXAMPLE_PATHS = [[1, 2, 3, 4, 9], [6, 7, 8, 4, 5]]
EXAMPLE_OBSERVED = [1, 2, 3, 4, 8]
EXAMPLE_OUTCOMES = [True, True, True, True, False]


def test_worked_example_of_the_paper() -> None:
    memory = memory_of(flat_graph(10), EXAMPLE_PATHS)
    probabilities, scores = posterior_of(memory, [5, 9], EXAMPLE_OBSERVED, EXAMPLE_OUTCOMES, 4)
    np.testing.assert_allclose(probabilities, [0.215367, 0.784633], atol=1e-6)
    # Without the prior's common factor of 2 (one shared path, gamma 1) the scores are likelihoods.
    np.testing.assert_allclose(np.exp(scores) / 2, [5.94990e-4, 2.167692e-3], rtol=1e-5)


def test_counts_of_the_worked_example() -> None:
    memory = memory_of(flat_graph(10), EXAMPLE_PATHS)
    counts = memory.co_occurrence(np.array([5, 9], np.int32), np.array(EXAMPLE_OBSERVED, np.int32))
    np.testing.assert_array_equal(counts, [[0, 0, 0, 1, 1], [1, 1, 1, 1, 0]])


def test_the_oracle_gives_the_worked_example() -> None:
    paths = [set(path) for path in EXAMPLE_PATHS]
    assert theta_row(paths, 5, EXAMPLE_OBSERVED) == pytest.approx(
        [1 / 7, 1 / 7, 1 / 7, 2 / 7, 2 / 7]
    )
    expected = posterior(paths, [5, 9], EXAMPLE_OBSERVED, EXAMPLE_OUTCOMES, 4)
    assert [float(p) for p in expected] == pytest.approx([0.215367, 0.784633], abs=1e-6)


@st.composite
def situations(draw):
    nodes = draw(st.integers(3, 30))
    some = st.lists(st.integers(0, nodes - 1), max_size=nodes, unique=True)
    paths = draw(st.lists(some, max_size=140))
    candidates = draw(some.filter(bool))
    observed = draw(some)
    outcomes = [draw(st.booleans()) for _ in observed]
    reference = draw(st.none() | st.integers(0, nodes - 1))
    return nodes, paths, candidates, observed, outcomes, reference


@given(situations())
def test_posterior_equals_the_equations_in_exact_fractions(situation) -> None:
    nodes, paths, candidates, observed, outcomes, reference = situation
    sets = [set(path) for path in paths]
    expected = posterior(sets, candidates, observed, outcomes, reference)
    assert sum(expected) == 1
    assert sum(prior_of(sets, candidates, reference)) == 1
    if observed:
        assert all(sum(theta_row(sets, c, observed)) == 1 for c in candidates)
    memory = memory_of(flat_graph(nodes), paths)
    probabilities, _ = posterior_of(memory, candidates, observed, outcomes, reference)
    # Thirty factors of double precision.
    np.testing.assert_allclose(probabilities, [float(p) for p in expected], rtol=1e-11)


@given(situations())
def test_candidates_stand_by_exact_posteriors_and_equal_ones_by_distance(situation) -> None:
    _, paths, candidates, observed, outcomes, reference = situation
    sets = [set(path) for path in paths]
    expected = posterior(sets, candidates, observed, outcomes, reference)
    # The later a candidate is named the nearer it is, all of them within the match basin.
    along_m = 0.01 * np.arange(len(candidates), 0, -1)
    by_posterior = sorted(range(len(candidates)), key=lambda row: (-expected[row], along_m[row]))
    context = make_context(
        paths=paths,
        candidates=candidates,
        along_m=along_m,
        observed=observed,
        outcomes=outcomes,
        reference=reference,
    )
    assert PathPolicy().rank(context).tolist() == by_posterior
    assert PathNearPolicy().rank(context).tolist() == by_posterior


def test_equal_posteriors_whose_logarithms_differ_tie() -> None:
    """No shared path, or one with each of W: theta is the same."""
    context = make_context(
        paths=[[1, 4], [1, 5], [1, 6]],
        candidates=[0, 1],
        along_m=[0.1, 0.2],
        observed=[4, 5, 6],
        outcomes=[True, True, False],
    )
    for policy in (PathPolicy(), PathNearPolicy()):
        assert policy.rank(context).tolist() == [0, 1]
        nearer = dataclasses.replace(
            context, neighbourhood=neighbourhood_of([0, 1], np.array([0.2, 0.1]))
        )
        assert policy.rank(nearer).tolist() == [1, 0]


def test_a_thousand_observations_neither_underflow_nor_overflow() -> None:
    rng = np.random.default_rng(5)
    paths = [np.flatnonzero(rng.random(1100) < 0.3).tolist() for _ in range(70)]
    candidates, observed = list(range(1000, 1040)), list(range(1000))
    outcomes = (rng.random(1000) < 0.5).tolist()
    memory = memory_of(flat_graph(1100), paths)
    _, scores = posterior_of(memory, candidates, observed, outcomes, 1050)
    counts = memory.co_occurrence(
        np.array(candidates, np.int32), np.array(observed, np.int32)
    ).astype(float)
    theta = (counts + 1) / (counts + 1).sum(axis=1, keepdims=True)
    shared = memory.co_occurrence(np.array(candidates, np.int32), np.array([1050], np.int32))
    expected = np.log(np.where(outcomes, theta, 1 - theta)).sum(axis=1) + np.log(shared[:, 0] + 1)
    np.testing.assert_allclose(scores, expected, rtol=1e-11)


@pytest.mark.parametrize("observed", [[], [3]])
def test_none_or_one_observation_leaves_the_prior_alone(observed) -> None:
    memory = memory_of(flat_graph(10), EXAMPLE_PATHS)
    outcomes = [True] * len(observed)
    probabilities, _ = posterior_of(memory, [5, 9, 6], observed, outcomes, 7)
    np.testing.assert_allclose(probabilities, [0.4, 0.2, 0.4], rtol=1e-12)


def test_empty_path_memory_leaves_all_exactly_equal() -> None:
    memory = memory_of(flat_graph(10), [])
    _, scores = posterior_of(memory, [5, 9, 6], [1, 2, 3], [True, False, True], 4)
    assert len(set(scores.tolist())) == 1


def test_excluded_path_counts_neither_in_likelihood_nor_in_prior() -> None:
    graph = flat_graph(10)
    live = [1, 2, 5, 4]
    with_live = memory_of(graph, [*EXAMPLE_PATHS, live])
    without = memory_of(graph, EXAMPLE_PATHS)
    situation = ([5, 9], EXAMPLE_OBSERVED, EXAMPLE_OUTCOMES, 4)
    excluded, _ = posterior_of(with_live, *situation, excluded=path_uuid(2))
    np.testing.assert_array_equal(excluded, posterior_of(without, *situation)[0])
    assert not np.allclose(posterior_of(with_live, *situation)[0], excluded)


@pytest.mark.parametrize("path_count", [63, 64, 65, 600, 2000])
def test_co_occurrence_equals_set_intersection_at_any_size(path_count: int) -> None:
    rng = np.random.default_rng(path_count)
    nodes = 70
    membership = rng.random((nodes, path_count)) < rng.choice([0.01, 0.5, 0.98], (nodes, 1))
    memory = memory_of(flat_graph(nodes), [np.flatnonzero(m).tolist() for m in membership.T])
    a, b = np.arange(0, 40, dtype=np.int32), np.arange(5, 70, dtype=np.int32)
    expected = membership[a].astype(int) @ membership[b].T.astype(int)
    np.testing.assert_array_equal(memory.co_occurrence(a, b), expected)


@pytest.mark.parametrize("count", [2, 511, 512, 513, 1300])
def test_scores_equal_numpy_for_any_number_of_observations(count: int) -> None:
    rng = np.random.default_rng(count)
    membership = rng.random((1400, 90)) < 0.25
    memory = memory_of(flat_graph(1400), [np.flatnonzero(m).tolist() for m in membership.T])
    candidates = rng.choice(1400, 9, replace=False).astype(np.int32)
    observed = rng.choice(1400, count, replace=False).astype(np.int32)
    outcomes = rng.random(count) < 0.3
    counts = membership[candidates].astype(float) @ membership[observed].T
    theta = (counts + 0.5) / (counts + 0.5).sum(axis=1, keepdims=True)
    expected = np.log(np.where(outcomes, theta, 1 - theta)).sum(axis=1)
    scores = scores_of(memory, candidates, observed, outcomes, None, alpha=0.5)
    np.testing.assert_allclose(scores, expected, rtol=1e-12)


@given(st.data())
@settings(max_examples=40)
def test_what_is_kept_from_frame_to_frame_changes_no_score(data) -> None:
    """W and the paths change a little from call to call, as on a drive; now and then a lot."""
    nodes, paths = 40, 70
    some = st.lists(st.integers(0, nodes - 1), max_size=nodes, unique=True)
    steps = data.draw(st.lists(st.tuples(some, some, st.integers(0, paths - 1)), max_size=6))
    observed = data.draw(some)
    walks: list[list[int]] = [[] for _ in range(paths)]
    graph = flat_graph(nodes)
    kept = memory_of(graph, walks)
    for visited, changed, path in steps:
        for node in visited:
            entry = PathEntry(
                path_uuid(path), len(walks[path]), graph.node(node).id, PathEntryKind.MATCHED, 0
            )
            kept.add(entry)
            walks[path].append(node)
        # A few leave and a few come: those in both lists leave.
        observed = [n for n in observed if n not in changed] + [
            n for n in changed[:2] if n not in observed
        ]
        fresh = PathMemory(graph)
        fresh.add_all(
            [
                PathEntry(
                    path_uuid(number), sequence, graph.node(node).id, PathEntryKind.MATCHED, 0
                )
                for number, walk in enumerate(walks)
                for sequence, node in enumerate(walk)
            ]
        )
        situation = (
            np.arange(nodes, dtype=np.int32),
            np.array(observed, np.int32),
            np.array([n % 2 == 0 for n in observed], np.bool_),
            3,
        )
        np.testing.assert_array_equal(scores_of(kept, *situation), scores_of(fresh, *situation))


def test_a_node_observed_twice_is_refused_and_harms_nothing() -> None:
    memory = memory_of(flat_graph(10), EXAMPLE_PATHS)
    before = scores_of(memory, *_example())
    for observed in ([1, 2, 1], [1, 2, 3, 4, 8, 8]):
        with pytest.raises(ValueError, match="twice"):
            scores_of(
                memory,
                np.array([5, 9], np.int32),
                np.array(observed, np.int32),
                np.ones(len(observed), np.bool_),
                4,
            )
        np.testing.assert_array_equal(scores_of(memory, *_example()), before)


def _example():
    return (
        np.array([5, 9], np.int32),
        np.array(EXAMPLE_OBSERVED, np.int32),
        np.array(EXAMPLE_OUTCOMES, np.bool_),
        4,
    )


def test_on_paths_tells_who_was_where() -> None:
    memory = memory_of(flat_graph(10), [[n % 10, (3 * n) % 10] for n in range(130)])
    held = memory.on_paths(
        [path_uuid(0), path_uuid(129), path_uuid(999)], np.arange(10, dtype=np.int32)
    )
    assert [np.flatnonzero(row).tolist() for row in held] == [[0], [7, 9], []]
