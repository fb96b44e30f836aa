"""Γ(path): path memory within the match basin, distance beyond it (SPEC §4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.experience.basin import BASIN_LEVEL
from engram.ranking.context import RankingContext, order_by
from engram.ranking.path_literal import PathLiteralPolicy
from engram.ranking.reasons import Reasons


class PathPolicy:
    """By the formula of [L15 §V] among the candidates that are near enough to match; then the rest.

    The formula knows no distance: over the whole search radius it would put a node of the right
    experience 8 m away before one of the same experience at 1 m. Our reading of the paper's "local
    metric neighbourhood" is the match basin, where g(d) >= 0.6.
    """

    name = "path"

    def __init__(self, alpha: float = 1.0, gamma: float = 1.0) -> None:
        self._formula = PathLiteralPolicy(alpha, gamma)

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`; candidates with g below 0.6 stand behind, by distance."""
        return self._formula.reasons(context)

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        neighbourhood = context.neighbourhood
        rates = context.basin.success_rate(neighbourhood.along_m, neighbourhood.across_m)
        within = rates >= BASIN_LEVEL
        if np.count_nonzero(within) == len(within):
            return self._formula.rank(context)
        scores = np.zeros(len(neighbourhood))
        scores[within] = self._formula.scores(context, neighbourhood.nodes[within])
        return order_by(context, ~within, -scores)
