"""Γ(bag-of-words): experiences that look like the live frame first [MacTavish 2017]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, round_robin
from engram.ranking.reasons import Reasons
from engram.ranking.words import WordSource

# An experience looks like its nodes within so many metres do (SPEC §4).
_HERE_M = 2.0


class BagOfWordsPolicy:
    """By the cosine of the live frame's words and each experience's words here, round robin.

    Source: SPEC §4; MacTavish, Paton, Barfoot, Visual triage: a bag-of-words experience selector
    for long-term visual route following, ICRA 2017. Without a vocabulary all are alike.
    """

    name = "bag-of-words"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context, -experience_similarities(context))

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        meaning = {"likeness": "cosine of the frame's words and those of the node's drive here"}
        return Reasons({"likeness": experience_similarities(context)}, meaning)


def experience_similarities(context: RankingContext) -> NDArray[np.float64]:
    """(Y,) cosine, 0…1, of the live frame with the session of each candidate as it looks here.

    Vectors are idf-weighted sets of words. A session's set is the union over its nodes within
    2 m, or its nearest node where none is that near.
    """
    words = context.background.words
    sessions = context.sessions
    if words is None or context.live_words is None or len(sessions) == 0:
        return np.zeros(len(sessions))
    similarity_to = _Similarity(words, context.live_words())
    result = np.empty(len(sessions))
    distance_m = context.neighbourhood.distance_m
    for session in np.unique(sessions):
        rows = np.flatnonzero(sessions == session)
        within = rows[distance_m[rows] <= max(_HERE_M, distance_m[rows].min())]
        nodes = context.neighbourhood.nodes[within]
        result[rows] = similarity_to([words.of_node(int(node)) for node in nodes])
    return result


class _Similarity:
    """Cosine with one frame's words."""

    def __init__(self, words: WordSource, live: NDArray[np.int32]) -> None:
        self._weights = words.idf**2
        self._seen = np.zeros(len(self._weights))
        self._seen[live] = self._weights[live]
        self._norm = float(np.sqrt(self._seen.sum()))

    def __call__(self, sets: list[NDArray[np.int32]]) -> float:
        union = sets[0] if len(sets) == 1 else np.unique(np.concatenate(sets))
        norm = self._norm * float(np.sqrt(self._weights[union].sum()))
        return float(self._seen[union].sum()) / norm if norm > 0 else 0.0
