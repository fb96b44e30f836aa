"""Ranking policies Γ: in which order to attempt the candidates (SPEC §4).

Every policy is one file and stands in `POLICIES`.
"""

from __future__ import annotations

from collections.abc import Callable

from engram.errors import ConfigError
from engram.ranking.context import Foreseen, RankingContext, RankingPolicy
from engram.ranking.distance import DistancePolicy
from engram.ranking.path import PathPolicy
from engram.ranking.path_literal import PathLiteralPolicy
from engram.ranking.random import RandomPolicy
from engram.ranking.recent import IterationUnit, Observations, RecentAttempts, RecentConfig

POLICIES: dict[str, Callable[[], RankingPolicy]] = {
    "distance": DistancePolicy,
    "path": PathPolicy,
    "path-literal": PathLiteralPolicy,
    "random": RandomPolicy,
}


def policy_named(name: str) -> RankingPolicy:
    """A new policy of that name.

    Raises:
        ConfigError: there is none; the message lists those that there are.
    """
    try:
        return POLICIES[name]()
    except KeyError:
        raise ConfigError(
            f"no ranking policy '{name}'; there are: {', '.join(sorted(POLICIES))}"
        ) from None


__all__ = [
    "POLICIES",
    "Foreseen",
    "IterationUnit",
    "Observations",
    "RankingContext",
    "RankingPolicy",
    "RecentAttempts",
    "RecentConfig",
    "policy_named",
]
