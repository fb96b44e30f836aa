"""How alike a live frame and nodes look, by their visual words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext
from engram.ranking.words import WordSource


class Likeness:
    """Cosine, 0…1, of idf-weighted sets of words with those of one frame.

    Args:
        words: knows the nodes' words.
        live: (n,) int32, the distinct words of the frame.
    """

    def __init__(self, words: WordSource, live: NDArray[np.int32]) -> None:
        self._words = words
        self._weights = words.idf**2
        self._seen = np.zeros(len(self._weights))
        self._seen[live] = self._weights[live]
        self._norm = float(np.sqrt(self._seen.sum()))
        # By word: whether a node before has it. A union by sorting takes several times as long.
        self._met = np.zeros(len(self._weights), np.bool_)

    def __call__(self, nodes: list[int]) -> float:
        """Of all that some nodes show together."""
        shared = whole = 0.0
        sets = [self._words.of_node(node) for node in nodes]
        for one in sets:
            fresh = one if len(sets) == 1 else one[~self._met[one]]
            self._met[fresh] = True
            shared += float(self._seen[fresh].sum())
            whole += float(self._weights[fresh].sum())
        for one in sets:
            self._met[one] = False
        norm = self._norm * float(np.sqrt(whole))
        return shared / norm if norm > 0 else 0.0

    def of_each(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(Y,) of each of some nodes."""
        sets = [self._words.of_node(node) for node in nodes.tolist()]
        met = np.concatenate([*sets, np.zeros(0, np.int32)])
        place = np.repeat(np.arange(len(sets)), [len(one) for one in sets])
        shared, whole = (
            np.bincount(place, values[met], minlength=len(sets))
            for values in (self._seen, self._weights)
        )
        norms = self._norm * np.sqrt(whole)
        return np.divide(shared, norms, out=np.zeros(len(sets)), where=norms > 0)


def standard_likenesses(context: RankingContext) -> NDArray[np.float64]:
    """(Y,) by how many standard deviations each candidate looks liker than they do on average.

    Zeros where there is no vocabulary, and where all look equally like the live frame.
    """
    words, nodes = context.background.words, context.neighbourhood.nodes
    if words is None or context.live_words is None or len(nodes) == 0:
        return np.zeros(len(nodes))
    alike = Likeness(words, context.live_words()).of_each(nodes)
    alike -= alike.mean()
    deviation = alike.std()
    return alike / deviation if deviation > 1e-9 else np.zeros(len(nodes))
