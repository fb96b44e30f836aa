"""The reasons for a policy's order, for people."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, RankingPolicy


@dataclass(frozen=True, slots=True, eq=False)
class Reasons:
    """The parts of a policy's order.

    Attributes:
        terms: name → (Y,) float64, scores by row of the neighbourhood.
        meaning: name → description of the term.
        chances: (Y,) float64, probability of success; None if the policy estimates none.
        by_turn: (Y,) bool, whether a candidate's place is by rotation, not by its score; None if
            the policy has no rotation.
        rule: description of how the terms give the order.
    """

    terms: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    meaning: dict[str, str] = field(default_factory=dict)
    chances: NDArray[np.float64] | None = None
    by_turn: NDArray[np.bool_] | None = None
    rule: str = ""


@runtime_checkable
class Explains(Protocol):
    """A policy that can explain its order."""

    def reasons(self, context: RankingContext) -> Reasons:
        """The parts of the order of this context's candidates."""
        ...


def reasons_of(policy: RankingPolicy, context: RankingContext) -> Reasons:
    """A policy's reasons; empty ones if it explains nothing."""
    return policy.reasons(context) if isinstance(policy, Explains) else Reasons()
