"""Ranking policies Γ: the order in which to attempt the candidates (method §4).

Each policy is one file and an entry of `POLICIES`. Other packages add policies by entry points of
the group `ENTRY_POINTS`, each a callable without arguments that makes the policy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from engram.errors import ConfigError
from engram.ranking.background import Background
from engram.ranking.context import Foreseen, RankingContext, RankingPolicy, looks_ahead, uses_words
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
ENTRY_POINTS = "engram.policies"


@cache
def _brought() -> dict[str, EntryPoint]:
    """Policies of other installed packages, not yet imported."""
    return {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}


def policy_names() -> list[str]:
    """All policies that `policy_named` knows: Engram's own, then those of other packages."""
    return [*POLICIES, *(name for name in _brought() if name not in POLICIES)]


def policy_named(name: str) -> RankingPolicy:
    """A new policy of that name.

    Raises:
        ConfigError: the name is unknown; the message lists the known ones.
    """
    if name in POLICIES:
        return POLICIES[name]()
    if name in _brought():
        policy: RankingPolicy = _brought()[name].load()()
        return policy
    raise ConfigError(f"no ranking policy '{name}'; known: {', '.join(sorted(policy_names()))}")


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
    "policy_named",
    "policy_names",
    "reasons_of",
    "uses_words",
]
