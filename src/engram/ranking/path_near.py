"""Γ(path-near): path memory within the match basin, distance beyond it (method §4)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engram.graph.basin import BASIN_LEVEL
from engram.ranking.context import RankingContext
from engram.ranking.path import PathPolicy, evidence_of
from engram.ranking.reasons import Reasons


class PathNearPolicy:
    """By the formula of [L15 §V] within the match basin; then the rest by distance.

    The formula ignores distance: over the whole search radius it may prefer a node 8 m away to one
    of the same experience at 1 m. So it ranks only within the match basin, where g(d) >= 0.6: one
    reading of the paper's "local metric neighbourhood".
    """

    name = "path-near"

    def __init__(self, alpha: float = 1.0, gamma: float = 1.0) -> None:
        self._alpha, self._gamma = alpha, gamma

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        whole = PathPolicy(self._alpha, self._gamma).reasons(context)
        rule = (
            f"highest score first for g of {BASIN_LEVEL:g} or more; then the others, nearest first"
        )
        return replace(whole, rule=rule)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return context.path_memory.order(
            context.as_seen,
            evidence_of(context, self._alpha, self._gamma),
            context.basin,
            BASIN_LEVEL,
        )
