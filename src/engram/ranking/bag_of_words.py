"""Γ(bag-of-words): experiences that look like the live frame first [MacTavish 2017]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, round_robin
from engram.ranking.likeness import Likeness
from engram.ranking.reasons import IN_TURNS, Reasons

# An experience looks like its nodes within so many metres do (SPEC §4).
_HERE_M = 2.0


class BagOfWordsPolicy:
    """By the cosine of the live frame's words and each experience's words here, round robin.

    Source: SPEC §4; MacTavish, Paton, Barfoot, Visual triage: a bag-of-words experience selector
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
        rule = f"{IN_TURNS}; likest first within a turn"
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
    likeness_of = Likeness(words, context.live_words())
    distance_m, nodes = context.neighbourhood.distance_m, context.neighbourhood.nodes
    nearest_first = np.lexsort((distance_m, sessions))
    bounds = np.flatnonzero(np.diff(sessions[nearest_first])) + 1
    for rows in np.split(nearest_first, bounds):
        away_m = distance_m[rows]
        within = int(np.searchsorted(away_m, max(_HERE_M, away_m[0]), side="right"))
        result[rows] = likeness_of(nodes[rows[:within]].tolist())
    return result
