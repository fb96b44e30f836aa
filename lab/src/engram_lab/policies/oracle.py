"""Γ(oracle): is given what will match. The bound that any policy can reach."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.ranking.context import RankingContext, order_by


class OraclePolicy:
    """By whether the attempt would succeed, then inliers, then distance (method §4)."""

    name = "oracle"
    looks_ahead = True

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`.

        Raises:
            ConfigError: nobody can tell what will match, as on a robot.
        """
        if context.foresee is None:
            raise ConfigError(
                "the policy oracle needs the matches in advance, and this context has none; "
                "use it in engram lab evaluate, and another policy for a drive"
            )
        known = context.foresee()
        return order_by(context, ~known.accepted, -known.inliers)
