"""Γ(bandit): learns from this run alone; has no path memory at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, order_by
from engram.ranking.reasons import Reasons
from engram_lab.policies.evidence import decay, failure_weights

Array = NDArray[np.float64]

# Source of all four: method §4.
_MEMORY_M = 8.0
_REDUNDANCY = 0.8
# Of a session that this run has not tried yet, and how many attempts that is worth.
PRIOR_RATE = 0.3
PRIOR_ATTEMPTS = 1.0


class BanditPolicy:
    """p = (a + 0.3) / (a + b + 1) · g(d), picked greedily and diversely (method §4).

    a and b are this run's successes and failures on the session that saved the candidate, decayed
    by exp(−Δs / 8 m), failures weighted by g of their distance. After each pick the other nodes
    of its session count 1 − 0.8 p, where p is what the pick itself counted then.
    """

    name = "bandit"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return _pick_diversely(context, _chances(context, *session_tallies(context)))

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        a, b = session_tallies(context)
        meaning = {
            "successes": "of this run on the node's drive, decayed over 8 m",
            "failures": "likewise, each as much as a match was likely",
        }
        return Reasons(
            {"successes": a, "failures": b},
            meaning,
            _chances(context, a, b),
            rule="best chance first; each pick takes from the chances of its own drive's others, "
            "so that a less likely node of another drive may come before them",
        )


def session_tallies(context: RankingContext) -> tuple[Array, Array]:
    """Decayed successes and failures (Y,) of this run on the session that saved each candidate."""
    graph, run = context.graph, context.run
    attempted, sessions = graph.sessions_of(run.nodes), context.sessions
    weights, count = decay(run, _MEMORY_M), graph.session_count
    successes = np.bincount(attempted, weights * run.accepted, count)[sessions]
    failures = np.bincount(attempted, weights * failure_weights(run), count)[sessions]
    return successes.astype(np.float64), failures.astype(np.float64)


def _chances(context: RankingContext, successes: Array, failures: Array) -> Array:
    rates = (successes + PRIOR_RATE * PRIOR_ATTEMPTS) / (successes + failures + PRIOR_ATTEMPTS)
    return rates * context.success_rates()


def _pick_diversely(context: RankingContext, p: NDArray[np.float64]) -> NDArray[np.int64]:
    canonical = order_by(context)  # the first of equals is the nearest, then by UUID
    left = p[canonical]
    sessions = context.sessions[canonical]
    picked = np.empty(len(left), np.int64)
    for place in range(len(left)):
        best = int(np.argmax(left))
        picked[place] = canonical[best]
        left[sessions == sessions[best]] *= 1 - _REDUNDANCY * left[best]
        left[best] = -np.inf
    return picked
