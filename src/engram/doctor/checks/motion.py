"""Motion: odometry, a stream that stands still, a scale that does not fit."""

from __future__ import annotations

import numpy as np

from engram.doctor.examination import Evidence, Look
from engram.frontend import FrameStatus

_MOVING_M = 0.02
# A repeated image without contrast is darkness, not an old picture.
_CONTRAST = 4.0
# So many equal pairs are no robot at rest before a camera without noise.
_LONG = 30
_LEAST_WAY_M = 5.0


def without_odometry(seen: Evidence) -> float | None:
    """Share of frames without odometry."""
    if len(seen) < seen.config.least_frames:
        return None
    return 1.0 - float(np.mean(seen.odometry))


def frozen_frames(seen: Evidence) -> float | None:
    """Most images in a row that repeat the one before.

    Two equal pairs while the robot rests say nothing: a simulated camera may have no noise.
    """
    if not seen.looks or len(seen.looks) != len(seen):
        return None
    longest = [0, 0]
    run, moving = [0, 0], False
    for number, look in enumerate(seen.looks):
        step = seen.moved[number]
        still = all(look.repeats)
        if step is not None and not any(look.repeats):
            moving = step.distance_m > _MOVING_M
        for side in (0, 1):
            run[side] = run[side] + 1 if _repeats(look, side) else 0
            if not still or moving or run[side] >= _LONG or _frozen(seen, number):
                longest[side] = max(longest[side], run[side])
    return float(max(longest))


def scale_off(seen: Evidence) -> float | None:
    """How far odometry's scale is from that of motion from outside, as a share."""
    ways = np.array([way for way in seen.outside_m if min(way) > 0.1]).reshape(-1, 2)
    if len(ways) < 3 or ways[:, 0].sum() < _LEAST_WAY_M:
        return None
    return float(abs(np.median(ways[:, 1] / ways[:, 0]) - 1))


def _repeats(look: Look, side: int) -> bool:
    return look.repeats[side] and look.contrast[side] > _CONTRAST


def _frozen(seen: Evidence, number: int) -> bool:
    return seen.statuses[number] is FrameStatus.FROZEN
