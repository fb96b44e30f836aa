"""Γ(path) to the letter [L15 §V]: the formula ranks the whole neighbourhood."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, order_by


class PathLiteralPolicy:
    """By p(y = i | Z, θ, π) over path memory, for all of Y (SPEC §4).

    Args:
        alpha: pseudo-count of the likelihood θ.
        gamma: pseudo-count of the prior π.
    """

    name = "path-literal"

    def __init__(self, alpha: float = 1.0, gamma: float = 1.0) -> None:
        self._alpha = alpha
        self._gamma = gamma

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return order_by(context, -self.scores(context, context.neighbourhood.nodes))

    def scores(self, context: RankingContext, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(N,) log posterior of nodes up to a common constant.

        Nodes that share as many paths with as many of W tie to the last bit.
        """
        return context.path_memory.scores(
            nodes,
            context.observations.nodes,
            context.observations.succeeded,
            context.reference,
            excluded=context.own_path,
            alpha=self._alpha,
            gamma=self._gamma,
        )
