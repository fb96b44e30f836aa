"""The tree of words that tell most about each other."""

from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import entropy

from engram.places import vocabulary
from engram.places.vocabulary import learn_statistics, mutual_information


def drawn_images(seed: int, words: int = 14, count: int = 40) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    shown = rng.random((count, words)) < rng.uniform(0.1, 0.9, words)
    shown[:, 1] = shown[:, 0] ^ (rng.random(count) < 0.1)
    shown[:, 2] = shown[:, 1] ^ (rng.random(count) < 0.2)
    return [np.flatnonzero(row).astype(np.int32) for row in shown]


def table(images: list[np.ndarray], words: int) -> np.ndarray:
    shown = np.zeros((len(images), words), int)
    for row, image in zip(shown, images, strict=True):
        row[image] = 1
    return shown


def information(a: np.ndarray, b: np.ndarray) -> float:
    """H(a) + H(b) − H(a, b), by scipy."""
    joint = np.histogram2d(a, b, bins=2, range=[[0, 1], [0, 1]])[0].ravel()
    return entropy(np.bincount(a)) + entropy(np.bincount(b)) - entropy(joint)


def test_mutual_information_is_that_of_the_entropies() -> None:
    shown = table(drawn_images(0), 14)
    for a, b in combinations(range(14), 2):
        both = np.array(float((shown[:, a] & shown[:, b]).sum()))
        found = mutual_information(both, shown[:, a].sum(), shown[:, b].sum(), len(shown))
        assert np.isclose(found, information(shown[:, a], shown[:, b]), atol=1e-12)


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_the_tree_has_the_greatest_information_of_all_trees(seed: int) -> None:
    images = drawn_images(seed)
    shown = table(images, 14)
    found = learn_statistics(images, 14)
    total = sum(
        information(shown[:, q], shown[:, p]) for q, p in enumerate(found.parents) if p >= 0
    )
    # Kruskal's algorithm over all pairs, from the strongest on.
    group = list(range(14))
    best = 0.0
    pairs = [(information(shown[:, a], shown[:, b]), a, b) for a, b in combinations(range(14), 2)]
    for strength, a, b in sorted(pairs, reverse=True):
        if group[a] != group[b]:
            best += strength
            group = [group[b] if g == group[a] else g for g in group]
    assert np.isclose(total, best, rtol=1e-9)


def test_blocks_make_no_difference(monkeypatch) -> None:
    images = drawn_images(3)
    whole = learn_statistics(images, 14)
    monkeypatch.setattr(vocabulary, "_BLOCK", 4)
    assert np.array_equal(whole.parents, learn_statistics(images, 14).parents)


def test_counts_are_counts() -> None:
    images = drawn_images(4)
    shown = table(images, 14)
    found = learn_statistics(images, 14)
    assert found.images == 40
    assert np.array_equal(found.seen, shown.sum(axis=0))
    for q, p in enumerate(found.parents):
        both = (shown[:, q] & shown[:, p]).sum() if p >= 0 else 0
        assert found.seen_with_parent[q] == both


def test_words_never_seen_and_words_always_seen_are_roots() -> None:
    images = [np.array([0, 2], np.int32), np.array([2], np.int32)]
    assert learn_statistics(images, 4).parents.tolist() == [-1] * 4
