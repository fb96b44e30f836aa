"""Ranking policies Γ: the order in which to attempt the candidates (method §4).

Each policy is one file and an entry of `POLICIES`. Other packages add policies by entry points of
the group `engram.policies`, each a callable without arguments that makes the policy.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from engram.errors import ConfigError
from engram.plugins import PluginGroup
from engram.ranking.background import Background
from engram.ranking.context import (
    Foreseen,
    RankingContext,
    RankingPolicy,
    looks_ahead,
    order_by,
    uses_words,
)
from engram.ranking.distance import DistancePolicy
from engram.ranking.lessons import Lessons
from engram.ranking.path import PathPolicy
from engram.ranking.path_near import PathNearPolicy
from engram.ranking.reasons import Reasons, reasons_of
from engram.ranking.recall import RecallPolicy
from engram.ranking.recent import IterationUnit, Observations, RecentAttempts, RecentConfig
from engram.ranking.run import RunAttempts, RunLog

POLICIES: dict[str, Callable[[], RankingPolicy]] = {
    PathPolicy.name: PathPolicy,
    PathNearPolicy.name: PathNearPolicy,
    RecallPolicy.name: RecallPolicy,
    DistancePolicy.name: DistancePolicy,
}


def policy_names() -> list[str]:
    """All policies that `policy_named` accepts: Engram's own, then those of other packages."""
    return [*POLICIES, *(name for name in _PLUGINS.names() if name not in POLICIES)]


def policy_named(name: str) -> RankingPolicy:
    """A new policy of that name.

    Raises:
        ConfigError: the name is unknown; the message lists the known ones.
        IncompatibleError: another package adds the policy, and it cannot be used.
    """
    if name in POLICIES:
        return _made(name, POLICIES[name])
    if name in _PLUGINS.names():
        return _PLUGINS.load(name)
    raise ConfigError(f"no ranking policy '{name}'; known: {', '.join(sorted(policy_names()))}")


def _made(name: str, make: Any) -> RankingPolicy:
    """The policy that a class or function makes.

    Raises:
        ConfigError: it is not a policy.
    """
    if not callable(make):
        raise ConfigError(f"{make!r} cannot be called; name the policy's class")
    policy: RankingPolicy = make()
    what = type(policy).__name__
    rank = getattr(policy, "rank", None)
    if not callable(rank):
        raise ConfigError(f"{what} has no method rank(context)")
    try:
        inspect.signature(rank).bind(None)
    except TypeError as error:
        taken = f"{what}.rank{inspect.signature(rank)}"
        raise ConfigError(f"{taken} must take one argument, the context") from error
    if getattr(policy, "name", None) != name:
        raise ConfigError(f"{what}.name is {getattr(policy, 'name', None)!r}, must be {name!r}")
    return policy


_PLUGINS = PluginGroup("engram.policies", "ranking policy", _made)


def check_for_robot(name: str) -> None:
    """Refuses a policy that looks ahead: a robot would attempt every candidate to rank them.

    Raises:
        ConfigError: the policy is unknown, or only for evaluations.
    """
    if looks_ahead(policy_named(name)):
        raise ConfigError(
            f"the policy {name} looks ahead, which only an evaluation can do; use it in "
            "engram lab evaluate of engram-lab, and another policy for a drive"
        )


__all__ = [
    "POLICIES",
    "Background",
    "Foreseen",
    "IterationUnit",
    "Lessons",
    "Observations",
    "RankingContext",
    "RankingPolicy",
    "Reasons",
    "RecentAttempts",
    "RecentConfig",
    "RunAttempts",
    "RunLog",
    "check_for_robot",
    "order_by",
    "policy_named",
    "policy_names",
    "reasons_of",
    "uses_words",
]
