"""How alike a live frame and nodes look."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import MapCorruptError
from engram.frontend.frame import BRIEF, Frame
from engram.graph.model import NodeId
from engram.places.vocabulary import default_vocabulary
from engram.places.words import NodeWords
from engram.ranking.recall import RECALL, RecallPolicy, likenesses, standard_likenesses
from engram.testing.contracts import MadeUpWords, flat_graph, make_context

WORDS = st.lists(st.integers(0, 49), max_size=12, unique=True)


def cosine(idf: np.ndarray, a: list[int], b: list[int]) -> float:
    """Of two idf-weighted sets, as written in the books."""
    vectors = np.zeros((2, len(idf)))
    vectors[0, a], vectors[1, b] = idf[a], idf[b]
    norms = np.linalg.norm(vectors, axis=1)
    return float(vectors[0] @ vectors[1] / norms.prod()) if norms.all() else 0.0


@given(WORDS, st.lists(WORDS, max_size=6))
def test_it_is_the_cosine_with_each_node(live: list[int], shown: list[list[int]]) -> None:
    graph = flat_graph(max(len(shown), 1))
    words = MadeUpWords(graph, {node: sorted(one) for node, one in enumerate(shown)})
    expected = [cosine(words.idf, live, one) for one in shown]
    nodes = [graph.node(node).id for node in range(len(shown))]
    found = likenesses(words, np.array(sorted(live), np.int32), nodes)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_candidates_are_compared_with_each_other() -> None:
    context = make_context(
        candidates=[0, 1, 2], words={0: [1, 2], 1: [1, 9], 2: [8, 9]}, live_words=[1, 2]
    )
    found = standard_likenesses(context)
    assert found.argmax() == 0
    assert found.argmin() == 2
    assert found.mean() == pytest.approx(0)
    assert found.std() == pytest.approx(1)


def test_nothing_is_liker_where_all_are_alike_or_no_word_is_known() -> None:
    alike = make_context(candidates=[0, 1], words={0: [3], 1: [3]}, live_words=[3])
    unknown = make_context(candidates=[0, 1])
    none = make_context(candidates=[], words={}, live_words=[3])
    for context in (alike, unknown, none):
        assert not standard_likenesses(context).any()


@pytest.mark.parametrize(("sigma_m", "first"), [(0.1, 0), (3.0, 1)])
def test_recall_looks_at_what_it_sees_where_nobody_knows_the_distance(
    sigma_m: float, first: int
) -> None:
    context = make_context(
        candidates=[0, 1], along_m=[0.0, 0.5], sessions=2, words={0: [7], 1: [3]}, live_words=[3]
    )
    near = dataclasses.replace(context.neighbourhood, sigma_m=np.full(2, sigma_m))
    context = dataclasses.replace(context, neighbourhood=near)
    judged = RecallPolicy().judge(context)
    assert judged.order[0] == first
    assert np.ptp(judged.terms["likeness"]) == pytest.approx(
        2 * RECALL.likeness if sigma_m > RECALL.vague_m else 0
    )
    odds = RECALL.bias + RECALL.steepness * sum(term[first] for term in judged.terms.values())
    assert judged.chances[first] == pytest.approx(1 / (1 + np.exp(-odds)))


class _Unreadable:
    """Frames of a map all of whose landmarks are damaged."""

    def frame(self, node: NodeId) -> Frame:
        raise MapCorruptError(f"node {node}: its landmarks do not match their hash")


def test_a_node_that_cannot_be_read_shows_nothing() -> None:
    words = NodeWords(_Unreadable(), lambda: default_vocabulary(BRIEF))
    words.prepare()
    node = flat_graph(2).node(1).id
    assert words.of_node(node) is None
    assert likenesses(words, np.array([3], np.int32), [node]).tolist() == [0.0]


class _Counted(_Unreadable):
    """The same, with the nodes whose frames were read."""

    def __init__(self) -> None:
        self.read: list[NodeId] = []

    def frame(self, node: NodeId) -> Frame:
        self.read.append(node)
        return super().frame(node)


def test_only_the_words_of_the_last_nodes_are_kept(monkeypatch) -> None:
    monkeypatch.setattr("engram.places.words._REMEMBERED", 2)
    frames = _Counted()
    words = NodeWords(frames, lambda: default_vocabulary(BRIEF))
    first, second, third = (flat_graph(3).node(number).id for number in range(3))
    for node in (first, second, third, second, third, first):
        words.of_node(node)
    assert frames.read == [first, second, third, first]
