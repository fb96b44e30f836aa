"""Γ(nearest-of-each): the experiences in turn, nearest node of each first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, round_robin


class NearestOfEachPolicy:
    """Round robin over the sessions, by distance within each round. A baseline (SPEC §4)."""

    name = "nearest-of-each"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context)
