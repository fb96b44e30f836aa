"""The Chow-Liu tree: the strongest dependences between words.

Source: Chow & Liu, Approximating discrete probability distributions with dependence trees, IEEE
Transactions on Information Theory 14(3), 1968; used for visual words by Cummins & Newman, FAB-MAP,
IJRR 27(6), 2008, §4.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from engram.monitor import QUIET, Monitor

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Rows of the mutual information held at a time: 40 MB at 10,000 words.
_BLOCK = 512


@dataclass(frozen=True, slots=True, eq=False)
class WordStatistics:
    """Counts of words in training images, alone and together with their parent in the tree.

    Attributes:
        images: number of training images.
        seen: (W,) int32, images that show each word.
        parents: (W,) int32, parent of each word in the Chow-Liu tree; -1 for a root. Independent
            words are in separate trees.
        seen_with_parent: (W,) int32, images that show both; 0 for a root.
    """

    images: int
    seen: NDArray[np.int32]
    parents: NDArray[np.int32]
    seen_with_parent: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.seen)


def learn_statistics(
    images: list[NDArray[np.int32]], words: int, monitor: Monitor = QUIET
) -> WordStatistics:
    """Counts words and builds the tree of the greatest total mutual information.

    Memory holds one block of rows of the mutual information at a time; of each block only the
    maximum spanning forest is kept. This is exact: an edge that is the weakest of a cycle among
    some edges is the weakest among all.

    Args:
        images: the distinct words, (n,) int32, of each training image.
        words: size of the vocabulary, W.
        monitor: receives the stage `relate`, one item per block of rows.
    """
    from scipy.sparse import csr_array

    shown = _occurrences(images, words)
    seen = np.asarray(shown.sum(axis=0), dtype=np.int32)
    by_word = shown.T.tocsr()
    forest: csr_array = csr_array((words, words))
    blocks = range(0, words, _BLOCK)
    with monitor.stage("relate", len(blocks)) as stage:
        for first in blocks:
            rows = np.arange(first, min(first + _BLOCK, words))
            both = (by_word[rows] @ shown).toarray()
            information = mutual_information(both, seen[rows, None], seen[None, :], len(images))
            information[np.arange(words) <= rows[:, None]] = 0  # each pair once
            forest = _strongest(forest, information, first)
            stage.advance()
    parents = _rooted(forest, seen)
    return WordStatistics(len(images), seen, parents, _with_parent(by_word, parents))


def mutual_information(
    both: NDArray[np.float64], a: NDArray[np.int32], b: NDArray[np.int32], images: int
) -> NDArray[np.float64]:
    """Mutual information of pairs of binary variables, from counts that broadcast.

    Args:
        both: (W, V) float64, counts of images that show both words.
        a, b: (W, 1) and (V,) int32, counts of images that show each of the two words.
        images: number of images.

    Returns:
        (W, V) float64, nats.
    """
    p_a, p_b = a / images, b / images
    p_both = both / images
    joint = (p_both, p_a - p_both, p_b - p_both, 1 - p_a - p_b + p_both)
    apart = (p_a * p_b, p_a * (1 - p_b), (1 - p_a) * p_b, (1 - p_a) * (1 - p_b))
    total = np.zeros(np.broadcast_shapes(both.shape, a.shape, b.shape))
    for p, q in zip(joint, apart, strict=True):
        seen = (p > 0) & (q > 0)
        ratio = np.divide(p, q, out=np.ones_like(total), where=seen)
        total += np.where(seen, p, 0) * np.log(ratio)
    return np.maximum(total, 0)


def _occurrences(images: list[NDArray[np.int32]], words: int) -> csr_array:
    """(images, W) float64, 1 where an image shows a word."""
    from scipy.sparse import csr_array

    lengths = [len(image) for image in images]
    columns = np.concatenate([*images, np.zeros(0, np.int32)])
    starts = np.concatenate([[0], np.cumsum(lengths)])
    return csr_array((np.ones(len(columns)), columns, starts), shape=(len(images), words))


def _strongest(forest: csr_array, information: NDArray[np.float64], first: int) -> csr_array:
    """The maximum spanning forest of a forest and a block of rows from `first` on."""
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    rows, columns = np.nonzero(information)
    old = forest.tocoo()
    words = forest.shape[0]
    weights = np.concatenate([old.data, -information[rows, columns]])
    ends = (np.concatenate([old.row, rows + first]), np.concatenate([old.col, columns]))
    return csr_array(minimum_spanning_tree(coo_array((weights, ends), (words, words)).tocsr()))


def _rooted(forest: csr_array, seen: NDArray[np.int32]) -> NDArray[np.int32]:
    """(W,) int32: parent of each word, if each tree's root is its most frequent word."""
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    words = len(seen)
    parents = np.full(words, -1, np.int32)
    _, tree_of = connected_components(forest, directed=False)
    _, roots = np.unique(tree_of[np.argsort(-seen, kind="stable")], return_index=True)
    by_frequency = np.argsort(-seen, kind="stable")
    edges = forest.tocoo()
    degree = np.bincount(np.concatenate([edges.row, edges.col]), minlength=words)
    for root in by_frequency[roots]:
        if degree[root] == 0:
            continue
        order, before = breadth_first_order(forest, int(root), directed=False)
        parents[order[1:]] = before[order[1:]]
    return parents


def _with_parent(by_word: csr_array, parents: NDArray[np.int32]) -> NDArray[np.int32]:
    """(W,) int32: number of images that show a word and its parent."""
    children = np.flatnonzero(parents >= 0)
    together = np.zeros(len(parents), np.int32)
    if len(children):
        both = by_word[children].multiply(by_word[parents[children]])
        together[children] = np.asarray(both.sum(axis=1)).ravel()
    return together
