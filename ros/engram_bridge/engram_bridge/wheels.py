"""Wheel odometry at the time of an image."""

from __future__ import annotations

from collections import deque

import numpy as np

from engram_bridge import rigid

_KEPT = 200
# Wheels report more often than cameras; further from a report, nothing is known.
_FURTHEST_NS = 100_000_000


class Wheels:
    """The newest poses of wheel odometry, between which the pose at an image's time lies.

    Args:
        kept: poses that are kept.
    """

    def __init__(self, kept: int = _KEPT) -> None:
        # (stamp_ns, translation (3,), quaternion xyzw (4,)), in the order of time.
        self._poses = deque(maxlen=kept)

    def add(self, stamp_ns: int, translation, xyzw) -> None:
        """Takes a pose ``odom_from_base``; one that is not later than the last begins anew."""
        if self._poses and stamp_ns <= self._poses[-1][0]:
            self._poses.clear()
        self._poses.append((stamp_ns, np.array(translation), np.array(xyzw)))

    def at(self, stamp_ns: int):
        """``odom_from_base`` (4, 4) at a time, on from the last two poses if it is later than both.

        None if the poses are too far from that time.
        """
        after = len(self._poses) - 1
        while after > 0 and self._poses[after - 1][0] >= stamp_ns:
            after -= 1
        if after < 1:
            return None
        (a_ns, a, a_turn), (b_ns, b, b_turn) = self._poses[after - 1], self._poses[after]
        if min(abs(stamp_ns - a_ns), abs(stamp_ns - b_ns)) > _FURTHEST_NS or b_ns - a_ns > 10**9:
            return None
        share = (stamp_ns - a_ns) / (b_ns - a_ns)
        near = b_turn if np.dot(a_turn, b_turn) >= 0 else -b_turn
        return rigid.of_quaternion(a_turn + share * (near - a_turn), a + share * (b - a))
