"""Which of two is better (SPEC §8)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from engram.measures.failure import Drive, failure_curve, longest_gap_m

# Source: SPEC §8: P_A ≤ P_B up to 20 m, and A's longest gap at most 1.5 times B's.
_UP_TO_M = 20.0
_STEP_M = 0.5
_LONGEST_GAP_RATIO = 1.5


def beats(a: Sequence[Drive], b: Sequence[Drive]) -> bool:
    """Whether A beats B (SPEC §8); equal results beat each other.

    A's failure curve is nowhere above B's up to 20 m, and its longest gap is at most 1.5 times B's.
    """
    at_m = np.arange(0.0, _UP_TO_M + _STEP_M / 2, _STEP_M)
    # Sums of the same gaps in another order differ in the last bits.
    below = failure_curve(a, at_m) <= failure_curve(b, at_m) + 1e-12
    return bool(below.all()) and longest_gap_m(a) <= _LONGEST_GAP_RATIO * longest_gap_m(b)
