"""Why a policy orders candidates as it does, for people."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, RankingPolicy


@dataclass(frozen=True, slots=True, eq=False)
class Reasons:
    """What a policy's order is made of.

    Attributes:
        terms: name → (Y,) float64, by row of the neighbourhood.
        meaning: name → what the term says, in plain words.
        chances: (Y,) float64 of success; None where the policy reckons none.
        by_turn: (Y,) bool, whether a candidate has its place not for its merits, but because its
            turn has come; None where the policy has no turns.
        rule: how the terms make the order, in plain words.
    """

    terms: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    meaning: dict[str, str] = field(default_factory=dict)
    chances: NDArray[np.float64] | None = None
    by_turn: NDArray[np.bool_] | None = None
    rule: str = ""


@runtime_checkable
class Explains(Protocol):
    """A policy that can say more than distance."""

    def reasons(self, context: RankingContext) -> Reasons:
        """What the order of this context's candidates is made of."""
        ...


def reasons_of(policy: RankingPolicy, context: RankingContext) -> Reasons:
    """A policy's reasons; none where distance or chance is all there is."""
    return policy.reasons(context) if isinstance(policy, Explains) else Reasons()
