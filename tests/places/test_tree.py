"""Clustering of binary descriptors, and the search for the nearest word."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.instruction_sets import printed

from engram import _core
from engram.errors import InputError
from engram.places.vocabulary import TreeArrays, grow_tree


def clustered(seed: int, groups: int = 12, members: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors around centres that are far from each other, and the group of each."""
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 256, (groups, 32), dtype=np.uint8)
    group = rng.permutation(np.repeat(np.arange(groups), members))
    flips = np.packbits(rng.random((len(group), 256)) < 0.05, axis=1)
    return centres[group] ^ flips, group


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)


def grown(descriptors: np.ndarray, words: int, depth: int, seed: int = 1) -> TreeArrays:
    return grow_tree(descriptors, words, depth, iterations=20, seed=seed)


def test_groups_that_lie_apart_do_not_share_a_word() -> None:
    descriptors, group = clustered(seed=0)
    words = grown(descriptors, words=36, depth=1).searchable().quantise(descriptors, 1)
    # Three words a group: Lloyd's iterations may split poorly, but no word needs to be shared.
    assert len(set(zip(words, group, strict=True))) == len(set(words))


@given(st.integers(0, 10_000), st.integers(1, 40))
@settings(max_examples=25)
def test_k_majority_ends_where_neither_half_step_changes_anything(seed: int, k: int) -> None:
    descriptors = np.random.default_rng(seed).integers(0, 256, (80, 32), dtype=np.uint8)
    centres, part = _core.k_majority(descriptors, k, 1000, seed)
    centres = centres.view(np.uint8)
    assert np.array_equal(part, distances(descriptors, centres).argmin(axis=1))
    for j, centre in enumerate(centres):
        members = np.unpackbits(descriptors[part == j], axis=1)
        assert len(members)
        ones, bits = 2 * members.sum(axis=0, dtype=int), np.unpackbits(centre)
        decided = ones != len(members)  # a tie may stand either way
        assert np.array_equal((ones > len(members))[decided], bits[decided])


def test_k_majority_finds_no_more_centres_than_there_are_different_descriptors() -> None:
    descriptors = np.repeat(np.arange(3, dtype=np.uint8)[:, None], 32, axis=1).repeat(4, axis=0)
    centres, part = _core.k_majority(np.ascontiguousarray(descriptors), 10, 10, 0)
    assert len(centres) == 3
    assert np.array_equal(centres.view(np.uint8)[part], descriptors)


def test_a_search_along_all_branches_finds_the_nearest_word() -> None:
    descriptors, _ = clustered(seed=2)
    tree = grown(descriptors, words=8, depth=2)
    words = tree.searchable().quantise(descriptors, 8)  # as wide as the tree
    leaves = distances(descriptors, tree.leaf_centres)
    assert np.array_equal(leaves[np.arange(len(words)), words], leaves.min(axis=1))


@pytest.mark.parametrize("beam", [1, 2, 3])
def test_a_search_follows_the_nearest_branches(beam: int) -> None:
    descriptors, _ = clustered(seed=3, groups=40, members=15)
    tree = grown(descriptors, words=60, depth=3)
    found = tree.searchable().quantise(descriptors, beam)
    leaves = np.flatnonzero(np.diff(tree.bounds) == 0)
    for descriptor, word in zip(descriptors[::20], found[::20], strict=True):
        front = [0]
        while any(tree.bounds[n] < tree.bounds[n + 1] for n in front):
            children = [c for n in front for c in range(tree.bounds[n], tree.bounds[n + 1])]
            away = distances(descriptor[None], tree.centres[children])[0]
            front = [children[i] for i in np.lexsort((children, away))[:beam]]
        assert leaves[word] == front[0]


def test_words_are_as_many_as_asked_for_where_there_is_enough_to_cluster() -> None:
    descriptors = np.random.default_rng(4).integers(0, 256, (4000, 32), dtype=np.uint8)
    assert grown(descriptors, words=300, depth=3).words == 300


def test_equal_seeds_give_equal_trees() -> None:
    descriptors, _ = clustered(seed=5)
    first, again = grown(descriptors, 30, 2), grown(descriptors, 30, 2)
    assert np.array_equal(first.centres, again.centres)
    assert not np.array_equal(first.centres, grown(descriptors, 30, 2, seed=2).centres)


def test_all_instruction_sets_give_the_same_words() -> None:
    program = (
        "import sys, hashlib; sys.path.insert(0, sys.argv[1]);"
        "from tests.places import test_tree as t;"
        "d, _ = t.clustered(6); tree = t.grown(d, 50, 2);"
        "print(hashlib.sha256(tree.centres.tobytes() + tree.searchable().quantise(d, 2)"
        ".tobytes()).hexdigest())"
    )
    assert len(printed(program)) == 1


@pytest.mark.parametrize(
    "bounds", [[1, 3, 3], [1, 1, 3, 3], [1, 3, 2, 3], [0, 3, 3, 3], [1, 3, 4, 3], [1, 2, 3, 4]]
)
def test_what_is_no_tree_is_refused(bounds: list[int]) -> None:
    tree = TreeArrays(np.zeros((3, 32), np.uint8), np.array(bounds, np.int32))
    with pytest.raises(InputError):
        tree.searchable()
