"""The table of ranking policies, with Γ(path) and Γ(distance) (method §4)."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import ConfigError
from engram.plugins import PluginGroup, where_from
from engram.ranking.context import (
    RankingContext,
    RankingPolicy,
    Reasons,
    looks_ahead,
    order_by,
)
from engram.ranking.recall import RecallPolicy

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


class DistancePolicy:
    """By the distance of the node from the position estimate, nearest first."""

    name = "distance"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return order_by(context)

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        meaning = {"metres": "distance of the node from the estimated position"}
        return Reasons({"metres": context.neighbourhood.distance_m}, meaning, rule="nearest first")


POLICIES: dict[str, Callable[[], RankingPolicy]] = {
    PathPolicy.name: PathPolicy,
    RecallPolicy.name: RecallPolicy,
    DistancePolicy.name: DistancePolicy,
}


def policy_names() -> list[str]:
    """All policies that `policy_named` accepts: Engram's own, then those of other packages."""
    return [*POLICIES, *(name for name in _PLUGINS.names() if name not in POLICIES)]


def policy_named(name: str) -> RankingPolicy:
    """A new policy of that name."""
    if name in POLICIES:
        return _made(name, POLICIES[name])
    if name in _PLUGINS.names():
        return _PLUGINS.load(name)
    known = ", ".join(sorted(policy_names()))
    raise ConfigError(f"no ranking policy '{name}'{where_from(name)}; known: {known}")


def _made(name: str, make: Any) -> RankingPolicy:
    """The policy that a class or function makes."""
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
    """Refuses a policy that looks ahead: a robot would attempt every candidate to rank them."""
    if looks_ahead(policy_named(name)):
        raise ConfigError(
            f"the policy {name} looks ahead, which only an evaluation can do; use it in "
            "engram lab evaluate of engram-lab, and another policy for a drive"
        )
