"""Slow change of the town itself: what is repainted, built over, felled or put up, and when."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from engram_lab.town.streets import Junction

_MEAN_DAYS_BETWEEN = 4.0  # per kind, town-wide


class AlterationKind(Enum):
    """What happens."""

    REPAINT = 0  # a front gets another tone, for good
    SCAFFOLD = 1  # stands for weeks
    FELLED = 2  # trees go, for good
    NEW_SIGN = 3  # for good


@dataclass(frozen=True, slots=True)
class Alteration:
    """One change; which houses or trees it meets follows from its number."""

    kind: AlterationKind
    number: int
    seed: int

    def chooses(self, block: Junction, item: int) -> bool:
        """Whether it meets one thing of a block: about one in forty."""
        numbers = [self.seed, self.number, self.kind.value, block[0] + 100_000, block[1] + 100_000]
        return bool(np.random.default_rng([*numbers, item]).random() < 1 / 40)


def alterations_on(seed: int, day: int) -> frozenset[Alteration]:
    """What has changed by a day, counted from the day the town was first seen."""
    found = set()
    for kind in AlterationKind:
        rng = np.random.default_rng([seed, 0xA17, kind.value])
        start, number = 0.0, 0
        while (start := start + rng.exponential(_MEAN_DAYS_BETWEEN)) <= day:
            lasts = rng.uniform(14, 45) if kind is AlterationKind.SCAFFOLD else np.inf
            if day < start + lasts:
                found.add(Alteration(kind, number, seed))
            number += 1
    return frozenset(found)
