"""Γ(path) as published [L15 §V]: the formula ranks the whole neighbourhood."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.ranking.context import RankingContext, order_by
from engram.ranking.reasons import Reasons

# Mathematically equal posteriors tie, though their logarithms are sums of different numbers; as in
# the core's `path_order`.
_TIE_SCALE = 2.0**30
_MEANING = {
    "score": "log posterior of [L15 §V], up to a common constant",
    "with successes": "paths shared with the recently matched nodes, summed",
    "with failures": "paths shared with the recently failed nodes, summed",
    "with k": "paths shared with the node in which the robot is or was last localised",
}


class PathPolicy:
    """By p(y = i | Z, θ, π) over path memory, for all of Y (method §4).

    Args:
        alpha: pseudo-count of the likelihood θ.
        gamma: pseudo-count of the prior π.
    """

    name = "path"

    def __init__(self, alpha: float = 1.0, gamma: float = 1.0) -> None:
        self._alpha = alpha
        self._gamma = gamma

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        scores = self.scores(context, context.neighbourhood.nodes)
        return order_by(context, -np.rint(scores * _TIE_SCALE))

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        memory, seen = context.path_memory, context.observations
        nodes = context.neighbourhood.nodes
        shared = memory.co_occurrence(nodes, seen.nodes, excluded=context.own_path)
        terms = {
            "score": self.scores(context, nodes),
            "with successes": shared[:, seen.succeeded].sum(axis=1).astype(np.float64),
            "with failures": shared[:, ~seen.succeeded].sum(axis=1).astype(np.float64),
        }
        if context.reference is not None:
            k = np.array([context.reference], np.int32)
            here = memory.co_occurrence(nodes, k, excluded=context.own_path)
            terms["with k"] = here[:, 0].astype(np.float64)
        meaning = {name: _MEANING[name] for name in terms}
        return Reasons(terms, meaning, rule="highest score first; ties by distance")

    def scores(self, context: RankingContext, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(N,) float64: log posterior of nodes up to a common constant.

        Mathematically equal posteriors may differ by rounding; they tie in the ranking.
        """
        evidence = evidence_of(context, self._alpha, self._gamma)
        return context.path_memory.scores(nodes, evidence)


def evidence_of(context: RankingContext, alpha: float, gamma: float) -> _core.PathEvidence:
    """W, z and k of a context, with the pseudo-counts of likelihood and prior."""
    return context.path_memory.evidence(
        context.observations.nodes,
        context.observations.succeeded,
        context.reference,
        excluded=context.own_path,
        alpha=alpha,
        gamma=gamma,
    )
