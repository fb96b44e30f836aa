"""A tree of binary words: grown by clustering descriptors, searched to quantise them.

Source: Nistér & Stewénius, Scalable recognition with a vocabulary tree, CVPR 2006, with clusters of
binary vectors: Grana et al., A fast approach for integrating ORB descriptors in the bag of words
model, 2013 (k-majority).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import InputError
from engram.monitor import QUIET, Monitor


@dataclass(frozen=True, slots=True, eq=False)
class TreeArrays:
    """A tree as it is stored.

    Attributes:
        centres: (M, B) uint8, one per node in breadth-first order; the root's is unused.
        bounds: (M+1,) int32, the children of node n are the nodes bounds[n] to bounds[n + 1] - 1;
            a node without children is a leaf, and leaves are the words, in this order.
    """

    centres: NDArray[np.uint8]
    bounds: NDArray[np.int32]

    @property
    def words(self) -> int:
        """Number of leaves."""
        return int(np.count_nonzero(np.diff(self.bounds) == 0))

    @property
    def leaf_centres(self) -> NDArray[np.uint8]:
        """(W, B) uint8, the centres of the words."""
        return self.centres[np.flatnonzero(np.diff(self.bounds) == 0)]

    def searchable(self) -> _core.WordTree:
        """The tree in the form that the core searches.

        Raises:
            InputError: the arrays do not form a tree.
        """
        try:
            return _core.WordTree(self.centres, self.bounds)
        except (TypeError, ValueError) as error:
            raise InputError(str(error)) from error


def grow_tree(
    descriptors: NDArray[np.uint8],
    words: int,
    depth: int,
    *,
    iterations: int,
    seed: int,
    monitor: Monitor = QUIET,
) -> TreeArrays:
    """Clusters descriptors level by level into a tree with one leaf per word.

    All levels but the last have the same branching factor. The last one divides the words in
    proportion to the members of each cluster, so that all words cover about equally many
    descriptors.

    Args:
        descriptors: (N, B) uint8, N > 0.
        words: number of leaves; there are fewer if descriptors are equal or few.
        depth: levels below the root.
        iterations: most of Lloyd's iterations per cluster.
        seed: seed of the first centres.
        monitor: receives the stage `cluster`, one item per cluster.
    """
    branching = round(words ** (1 / depth))
    # Clusters of the level above as rows of their members, in the order of the level.
    clusters = [np.arange(len(descriptors))]
    levels: list[NDArray[np.uint8]] = [np.zeros((1, descriptors.shape[1]), np.uint8)]
    children: list[NDArray[np.int64]] = []
    with monitor.stage("cluster", sum(branching**level for level in range(depth))) as stage:
        for level in range(depth):
            sizes = np.array([len(cluster) for cluster in clusters])
            last = level == depth - 1
            wanted = _shared_out(words, sizes) if last else np.full(len(sizes), branching)
            found: list[NDArray[np.uint8]] = []
            below: list[NDArray[np.int64]] = []
            for cluster, k in zip(clusters, wanted, strict=True):
                centres, parts = _split(descriptors, cluster, int(k), iterations, seed + level)
                found.append(centres)
                below += parts
                stage.advance()
            levels.append(np.concatenate(found))
            children.append(np.array([len(centres) for centres in found]))
            clusters = below
    children.append(np.zeros(len(clusters), np.int64))
    bounds = np.concatenate([[1], 1 + np.cumsum(np.concatenate(children))])
    return TreeArrays(np.concatenate(levels), bounds.astype(np.int32))


def _split(
    descriptors: NDArray[np.uint8],
    cluster: NDArray[np.int64],
    k: int,
    iterations: int,
    seed: int,
) -> tuple[NDArray[np.uint8], list[NDArray[np.int64]]]:
    """Centres (K, B) uint8 of a cluster's parts, and the rows of the members of each.

    A cluster that is not split becomes its own only child, so that all leaves have the same depth.
    """
    centres, part = _core.k_majority(descriptors[cluster], k, iterations, seed)
    order = np.argsort(part, kind="stable")
    ends = np.cumsum(np.bincount(part, minlength=len(centres)))
    return centres.view(np.uint8), np.split(cluster[order], ends[:-1])


def _shared_out(total: int, sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """`total` in proportion to sizes, at least 1 each, by the largest remainder."""
    shares = total * sizes / sizes.sum()
    whole: NDArray[np.int64] = np.maximum(np.floor(shares).astype(np.int64), 1)
    left = total - int(whole.sum())
    if left > 0:
        order = np.argsort(whole - shares, kind="stable")
        whole[order[:left]] += 1
    return whole
