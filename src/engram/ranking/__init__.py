"""Ranking policies Γ: in which order to attempt the candidates (SPEC §4).

Every policy is one file and stands in `POLICIES`; other installed packages bring theirs by the
entry points `ENTRY_POINTS`, each a callable without arguments that makes the policy.
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
    """Policies of other installed packages; imported when they are asked for."""
    return {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}


def policy_names() -> list[str]:
    """All policies that `policy_named` knows: Engram's own, then those that packages bring."""
    return [*POLICIES, *(name for name in _brought() if name not in POLICIES)]


def policy_named(name: str) -> RankingPolicy:
    """A new policy of that name.

    Raises:
        ConfigError: there is none; the message lists those that there are.
    """
    if name in POLICIES:
        return POLICIES[name]()
    if name in _brought():
        policy: RankingPolicy = _brought()[name].load()()
        return policy
    raise ConfigError(f"no ranking policy '{name}'; there are: {', '.join(sorted(policy_names()))}")


def check_for_robot(name: str) -> None:
    """Refuses a policy that looks ahead: a robot would attempt every candidate to rank them.

    Raises:
        ConfigError: there is no such policy, or only an evaluation may use it.
    """
    if looks_ahead(policy_named(name)):
        raise ConfigError(
            f"the policy {name} knows what will match, which only an evaluation can tell; use it "
            "in engram lab evaluate, and another policy for a drive"
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
