"""Jumps: images that go on elsewhere, though their stamps go on.

A robot is carried on unseen, a player skips, a buffer lags behind. Odometry then finds next to
nothing between two frames, and as much as ever before and after them. A guess by the last speed
would be wrong without a bound there, and all that is tied to the position with it. Wipers, drops
and flashes make steps fail, too, but again and again, or two in a row: they spoil a frame.
"""

from __future__ import annotations

import statistics
from collections import deque

_FRAMES_BEFORE = 20
# Where steps before had less than this share of their median, it is the frames that are poor.
_STEADY_SHARE = 0.3


class Jumps:
    """Tells jumps by the inliers of odometry's steps.

    Args:
        share: a step with less than this share of the inliers on either side of it is a jump.
        least: fewest inliers on either side: where landmarks are few steps fail by themselves.
    """

    def __init__(self, share: float, least: int) -> None:
        self._share, self._least = share, least
        # Inliers of the last steps, the newest last.
        self._steps: deque[int] = deque(maxlen=_FRAMES_BEFORE + 1)

    def jumped(self, inliers: int) -> bool:
        """Whether the step before the one that has so many inliers was a jump."""
        steps = list(self._steps)
        self._steps.append(inliers)
        if len(steps) < 2:
            return False
        *before, last = steps
        usual = statistics.median(before)
        beside = min(usual, inliers)
        if beside < self._least or last >= self._share * beside:
            return False
        return min(before) >= _STEADY_SHARE * usual
