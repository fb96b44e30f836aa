"""Γ(random): the policy without information, to measure others against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, order_by


class RandomPolicy:
    """A shuffle that depends on the seed, the frame's stamp and the set of candidates only."""

    name = "random"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        rng = np.random.default_rng([context.seed, context.stamp_ns % 2**64])
        # From a canonical order, so that it does not matter how the search came upon the rows.
        return rng.permutation(order_by(context))
