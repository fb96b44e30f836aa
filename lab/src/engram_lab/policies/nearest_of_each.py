"""Γ(nearest-of-each): the experiences in turn, nearest node of each first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext
from engram.ranking.reasons import Reasons
from engram_lab.policies.turns import IN_TURNS, round_robin


class NearestOfEachPolicy:
    """Round robin over the sessions, by distance within each round. A baseline (method §4)."""

    name = "nearest-of-each"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context)

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        meaning = {"metres": "distance of the node from where the robot is believed to be"}
        rule = f"{IN_TURNS}; nearest first within a turn"
        return Reasons({"metres": context.neighbourhood.distance_m}, meaning, rule=rule)
