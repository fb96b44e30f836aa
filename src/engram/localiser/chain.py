"""Keeps new fixes on trial until enough of them agree.

A street repeats, and matches one period off agree with each other for some metres. So the fixes
since a robot was lost, or since its position was set, are on trial. They settle once one of them is
sure by itself, or once they have agreed over some distance. A match that contradicts them before
that withdraws them. If it comes later, the robot was rather carried elsewhere.

The longer a drive stays disconnected, the more look-alike places it passes, some of them alike over
tens of metres. Fixes that join it must agree over a share of that distance, however sure one is.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.localiser.localisation import Position

# A trial ends this far beyond the distance that settles it: nothing came that could contradict.
_PATIENCE_M = 20.0
# Newest fixes that may be withdrawn, and frames that wait for it: a robot may stand for hours on a
# weak match. Ten seconds at 20 Hz.
MOST_ON_TRIAL = 200


class FixChain:
    """The fixes that agree with each other, on trial until they settle.

    Args:
        sure_confidence: log-odds of one fix by itself that settle the chain.
        settle_after_m: distance between agreeing fixes that settles it, metres.
    """

    def __init__(self, sure_confidence: float, settle_after_m: float) -> None:
        self._limits = sure_confidence, settle_after_m
        self._sure, self._after_m = self._limits
        self._on_trial: deque[int] = deque(maxlen=MOST_ON_TRIAL)
        self._moved_m = 0.0
        self.position: Position | None = None

    @property
    def on_trial(self) -> bool:
        """Whether the newest fixes may still be withdrawn."""
        return bool(self._on_trial)

    def begin(
        self, stamp_ns: int, found: Position, alone: float, joins_after_m: float = 0.0
    ) -> tuple[int, ...]:
        """A fix that agrees with none before it; returns the stamps of those on trial.

        Args:
            stamp_ns: stamp of its frame.
            found: where it is.
            alone: its confidence without the fixes before it.
            joins_after_m: distance between agreeing fixes, metres, that joins two parts of a map.
                Where it is longer than what settles any chain, no single fix settles this one.
        """
        self._sure, self._after_m = self._limits
        if joins_after_m > self._after_m:
            self._sure, self._after_m = np.inf, joins_after_m
        before = tuple(self._on_trial)
        self._on_trial.clear()
        self._on_trial.append(stamp_ns)
        self._moved_m, self.position = 0.0, found
        if alone >= self._sure:
            self.settle()
        return before

    def join(self, stamp_ns: int, found: Position, alone: float) -> None:
        """A fix that agrees with those before it; see `begin`."""
        if not self._on_trial:
            return
        self._on_trial.append(stamp_ns)
        self.position = found
        if alone >= self._sure or self._moved_m >= self._after_m:
            self.settle()

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """Carries the trial on by the robot's motion.

        Args:
            prev_from_curr: pose of this frame in the one before.
            covariance: (6, 6) float64 of that pose, left perturbation, [translation in m,
                rotation in rad].
        """
        if self.position is None:
            return
        self.position = self.position.carried_on(prev_from_curr, covariance)
        self._moved_m += prev_from_curr.distance_m
        if self._moved_m > self._after_m + _PATIENCE_M:
            self.settle()

    def settle(self) -> None:
        """The fixes stay, whatever comes."""
        self._on_trial.clear()
        self.position = None
