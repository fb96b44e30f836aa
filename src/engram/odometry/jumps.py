"""Jumps: images that go on elsewhere, though their stamps go on.

A robot is carried on unseen, a player skips, a buffer lags behind. Odometry then finds next to
nothing between two frames, and as much as ever before and after them. A guess by the last speed
would be wrong without a bound there, and all that is tied to the position with it. Wipers, drops
and flashes make steps fail, too, but again and again, or two in a row: they spoil a frame. And
where frames are missing the time that passed bounds the guess.
"""

from __future__ import annotations

import statistics
from collections import deque

_FRAMES_BEFORE = 20
# Where steps before had less than this share of their median, it is the frames that are poor.
_STEADY_SHARE = 0.3
# Frames are missing if one comes later than this many usual intervals after the last.
_GAP_RATIO = 1.5


class Jumps:
    """Tells jumps by the inliers of odometry's steps.

    Args:
        share: a step with less than this share of the inliers on either side of it is a jump.
        least: fewest inliers on either side: where landmarks are few steps fail by themselves.
    """

    def __init__(self, share: float, least: int) -> None:
        self._share, self._least = share, least
        # Inliers of the last steps and the time that they took, the newest last.
        self._steps: deque[tuple[int, float]] = deque(maxlen=_FRAMES_BEFORE + 1)

    def jumped(self, inliers: int, seconds: float) -> bool:
        """Whether the step before this one was a jump.

        Args:
            inliers: of this step; 0 if it failed.
            seconds: that it took.
        """
        steps = list(self._steps)
        self._steps.append((inliers, seconds))
        if len(steps) < 2:
            return False
        before = [count for count, _ in steps[:-1]]
        last, took_s = steps[-1]
        if took_s > _GAP_RATIO * statistics.median(at_s for _, at_s in steps[:-1]):
            return False
        usual = statistics.median(before)
        beside = min(usual, inliers)
        if beside < self._least or last >= self._share * beside:
            return False
        return min(before) >= _STEADY_SHARE * usual
