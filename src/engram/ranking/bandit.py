"""Γ(bandit): learns from this run alone; has no path memory at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, order_by
from engram.ranking.reasons import Reasons
from engram.ranking.run import RunAttempts

# Source of all four: SPEC §4.
_MEMORY_M = 8.0
_PRIOR_SUCCESSES = 0.3
_PRIOR_ATTEMPTS = 1.0
_REDUNDANCY = 0.8
# Of a session that this run has not tried yet.
PRIOR_RATE = _PRIOR_SUCCESSES / _PRIOR_ATTEMPTS


class BanditPolicy:
    """p = (a + 0.3) / (a + b + 1) · g(d), picked greedily and diversely (SPEC §4).

    a and b are this run's successes and failures on the session that saved the candidate, decayed
    by exp(−Δs / 8 m), failures weighted by g of their distance. After each pick the other nodes
    of its session count 1 − 0.8 p, where p is what the pick itself counted then.
    """

    name = "bandit"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        rates = session_rates(context, context.run, _MEMORY_M)
        return _pick_diversely(context, rates * context.success_rates())

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        a, b = session_tallies(context, context.run, _MEMORY_M)
        rates = session_rates(context, context.run, _MEMORY_M)
        meaning = {
            "successes": "of this run on the node's drive, decayed over 8 m",
            "failures": "likewise, each as much as a match was likely",
        }
        return Reasons(
            {"successes": a, "failures": b},
            meaning,
            rates * context.success_rates(),
            rule="best chance first; each pick takes from the chances of its own drive's others, "
            "so that a less likely node of another drive may come before them",
        )


def session_rates(
    context: RankingContext, run: RunAttempts, memory_m: float
) -> NDArray[np.float64]:
    """(Y,) (a + 0.3) / (a + b + 1), with a and b of `session_tallies`."""
    a, b = session_tallies(context, run, memory_m)
    return (a + _PRIOR_SUCCESSES) / (a + b + _PRIOR_ATTEMPTS)


def session_tallies(
    context: RankingContext, run: RunAttempts, memory_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Decayed successes and failures (Y,) of a run on the session that saved each candidate."""
    graph = context.graph
    attempted, sessions = graph.sessions[run.nodes], context.sessions
    weights, count = run.decay(memory_m), graph.session_count
    successes = np.bincount(attempted, weights * run.accepted, count)[sessions]
    failures = np.bincount(attempted, weights * run.failure_weights(), count)[sessions]
    return successes.astype(np.float64), failures.astype(np.float64)


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
