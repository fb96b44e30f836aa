"""How far a gyroscope turned by the time of an image."""

from __future__ import annotations

import numpy as np

from engram_bridge import rigid
from engram_bridge.wheels import Wheels

_KEPT = 2000
# A rate holds since the one before; after a longer pause the turn is unknown.
_HOLDS_NS = 500_000_000


class Gyro:
    """The sum of a gyroscope's rates: how the robot turned since the start, drift and all."""

    def __init__(self) -> None:
        self._turns = Wheels(_KEPT)
        self._turn, self._stamp_ns = np.eye(4), None
        self._whole = True

    def add(self, stamp_ns: int, rates_rad_s) -> None:
        """Takes turn rates around the axes of the robot, (3,)."""
        since_ns = None if self._stamp_ns is None else stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        if since_ns is not None and 0 < since_ns <= _HOLDS_NS:
            turn = rigid.of_turn(1e-9 * since_ns * np.asarray(rates_rad_s, np.float64))
            self._turn = self._turn @ turn
        elif since_ns is not None:
            self._whole = False
        self._turns.add(stamp_ns, [0.0, 0.0, 0.0], rigid.quaternion(self._turn))

    def at(self, stamp_ns: int):
        """``start_from_base`` (4, 4) at a time, without a shift; None if it is unknown.

        And None once after a pause: between the images around it, nobody knows the turn.
        """
        whole, self._whole = self._whole, True
        return self._turns.at(stamp_ns) if whole else None
