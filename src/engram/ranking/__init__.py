"""Ranking policies Γ: in which order to attempt the candidates (SPEC §4).

Every policy is one file and stands in `POLICIES`.
"""

from __future__ import annotations

from collections.abc import Callable

from engram.errors import ConfigError
from engram.ranking.background import Background
from engram.ranking.bag_of_words import BagOfWordsPolicy
from engram.ranking.bandit import BanditPolicy
from engram.ranking.collaborative import CollaborativePolicy
from engram.ranking.context import Foreseen, RankingContext, RankingPolicy, uses_words
from engram.ranking.distance import DistancePolicy
from engram.ranking.lessons import Lessons, PastAttempts
from engram.ranking.nearest_of_each import NearestOfEachPolicy
from engram.ranking.oracle import OraclePolicy
from engram.ranking.path import PathPolicy
from engram.ranking.path_literal import PathLiteralPolicy
from engram.ranking.random import RandomPolicy
from engram.ranking.reasons import Reasons, reasons_of
from engram.ranking.recall import RecallPolicy
from engram.ranking.recent import IterationUnit, Observations, RecentAttempts, RecentConfig
from engram.ranking.run import RunAttempts, RunLog
from engram.ranking.time_of_day import TimeOfDayPolicy
from engram.ranking.times import SessionTimes
from engram.ranking.words import QuantisedWords, WordSource

POLICIES: dict[str, Callable[[], RankingPolicy]] = {
    "distance": DistancePolicy,
    "path": PathPolicy,
    "path-literal": PathLiteralPolicy,
    "random": RandomPolicy,
    "oracle": OraclePolicy,
    "time-of-day": TimeOfDayPolicy,
    "bag-of-words": BagOfWordsPolicy,
    "collaborative": CollaborativePolicy,
    "nearest-of-each": NearestOfEachPolicy,
    "bandit": BanditPolicy,
    "recall": RecallPolicy,
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


def check_for_robot(name: str) -> None:
    """Refuses a policy that looks ahead: a robot would attempt every candidate to rank them.

    Raises:
        ConfigError: only an evaluation may use this policy.
    """
    if name == OraclePolicy.name:
        raise ConfigError(
            "the policy oracle knows what will match, which only an evaluation can tell; use it in "
            "engram evaluate, and another policy for a drive"
        )


__all__ = [
    "POLICIES",
    "Background",
    "Foreseen",
    "IterationUnit",
    "Lessons",
    "Observations",
    "PastAttempts",
    "QuantisedWords",
    "RankingContext",
    "RankingPolicy",
    "Reasons",
    "RecentAttempts",
    "RecentConfig",
    "RunAttempts",
    "RunLog",
    "SessionTimes",
    "WordSource",
    "check_for_robot",
    "policy_named",
    "reasons_of",
    "uses_words",
]
