"""Γ(distance): nearest first [L15 §III-C]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, order_by
from engram.ranking.reasons import Reasons


class DistancePolicy:
    """By the distance of the node from the position estimate, nearest first."""

    name = "distance"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return order_by(context)

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        meaning = {"metres": "distance of the node from the estimated position"}
        return Reasons({"metres": context.neighbourhood.distance_m}, meaning, rule="nearest first")
