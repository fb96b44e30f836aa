"""Jumps: consecutive frames taken at different places.

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
    """Detects jumps by the inliers of odometry's steps.

    Args:
        share: a step with less than this share of the inliers on either side of it is a jump.
        least: fewest inliers on either side: where landmarks are few steps fail by themselves.

    Attributes:
        suspected: whether the last step may be one, which the next step decides.
    """

    def __init__(self, share: float, least: int) -> None:
        self._share, self._least = share, least
        # Inliers of the last steps and the time that they took, the newest last.
        self._steps: deque[tuple[int, float]] = deque(maxlen=_FRAMES_BEFORE)
        self.suspected = False

    def jumped(self, inliers: int, seconds: float) -> bool:
        """Takes a step; whether the one before it was a jump.

        Args:
            inliers: of this step; 0 if it failed.
            seconds: that it took.
        """
        jumped = (
            self.suspected and inliers >= self._least and self._steps[-1][0] < self._share * inliers
        )
        self.suspected = self._is_suspect(inliers, seconds)
        self._steps.append((inliers, seconds))
        return jumped

    def _is_suspect(self, inliers: int, seconds: float) -> bool:
        """Whether a step fails after many that did not, and in the usual time."""
        if not self._steps:
            return False
        before = [count for count, _ in self._steps]
        usual, usual_s = statistics.median(before), statistics.median(s for _, s in self._steps)
        return (
            usual >= self._least
            and inliers < self._share * usual
            and min(before) >= _STEADY_SHARE * usual
            and seconds <= _GAP_RATIO * usual_s
        )
