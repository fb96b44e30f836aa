"""Γ(bag-of-words): experiences that look like the live frame first [MacTavish 2017]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.graph.model import NodeId
from engram.places.words import NodeWords
from engram.ranking.context import RankingContext
from engram.ranking.reasons import Reasons
from engram_lab.policies.turns import IN_TURNS, round_robin

# An experience looks like its nodes within so many metres do (method §4).
_HERE_M = 2.0


class BagOfWordsPolicy:
    """By the cosine of the live frame's words and each experience's words here, round robin.

    Source: method §4; MacTavish, Paton, Barfoot, Visual triage: a bag-of-words experience selector
    for long-term visual route following, ICRA 2017. Without a vocabulary all are alike.
    """

    name = "bag-of-words"
    uses_words = True

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context, -experience_similarities(context))

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        meaning = {"likeness": "cosine of the frame's words and those of the node's drive here"}
        rule = f"{IN_TURNS}; most alike first within a turn"
        return Reasons({"likeness": experience_similarities(context)}, meaning, rule=rule)


def experience_similarities(context: RankingContext) -> NDArray[np.float64]:
    """(Y,) cosine, 0…1, of the live frame with the session of each candidate as it looks here.

    Vectors are idf-weighted sets of words. A session's set is the union over its nodes within
    2 m, or its nearest node where none is that near.
    """
    words, sessions = context.background.words, context.sessions
    result = np.zeros(len(sessions))
    if words is None or context.live_words is None or len(sessions) == 0:
        return result
    likeness_of = _Likeness(words, context.live_words())
    distance_m, nodes = context.neighbourhood.distance_m, context.neighbourhood.nodes
    nearest_first = np.lexsort((distance_m, sessions))
    bounds = np.flatnonzero(np.diff(sessions[nearest_first])) + 1
    for rows in np.split(nearest_first, bounds):
        away_m = distance_m[rows]
        within = int(np.searchsorted(away_m, max(_HERE_M, away_m[0]), side="right"))
        result[rows] = likeness_of(
            [context.graph.node(node).id for node in nodes[rows[:within]].tolist()]
        )
    return result


class _Likeness:
    """Cosine, 0…1, of idf-weighted sets of words with those of one frame."""

    def __init__(self, words: NodeWords, live: NDArray[np.int32]) -> None:
        self._words = words
        self._weights = words.idf**2
        self._seen = np.zeros(len(self._weights))
        self._seen[live] = self._weights[live]
        self._norm = float(np.sqrt(self._seen.sum()))
        # By word: whether a node before has it. A union by sorting takes several times as long.
        self._met = np.zeros(len(self._weights), np.bool_)

    def __call__(self, nodes: list[NodeId]) -> float:
        """Of all that some nodes show together."""
        shared = whole = 0.0
        found = (self._words.of_node(node) for node in nodes)
        sets = [one for one in found if one is not None]
        for one in sets:
            fresh = one if len(sets) == 1 else one[~self._met[one]]
            self._met[fresh] = True
            shared += float(self._seen[fresh].sum())
            whole += float(self._weights[fresh].sum())
        for one in sets:
            self._met[one] = False
        norm = self._norm * float(np.sqrt(whole))
        return shared / norm if norm > 0 else 0.0
