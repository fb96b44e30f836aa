"""Ranking policies Γ: the order in which to attempt the candidates (method §4).

Other packages add policies by entry points of the group `engram.policies`, each a callable without
arguments that makes the policy.
"""

from engram.ranking.context import RankingContext, RankingPolicy, order_by
from engram.ranking.policies import POLICIES, policy_named, policy_names

__all__ = [
    "POLICIES",
    "RankingContext",
    "RankingPolicy",
    "order_by",
    "policy_named",
    "policy_names",
]
