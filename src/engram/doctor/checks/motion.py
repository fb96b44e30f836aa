"""Motion: odometry, a stream that stands still, a scale that does not fit."""

from __future__ import annotations

import math

import numpy as np

from engram.doctor.examination import Evidence, Look
from engram.frontend import FrameStatus
from engram.geometry import SE3

_MOVING_M = 0.02
# A repeated image without contrast is darkness, not an old picture.
_CONTRAST = 4.0
# So many equal pairs are no robot at rest before a camera without noise.
_LONG = 30
# Steps that turn by more than odometry's noise.
_TURNING_RAD = math.radians(0.3)
# Ways are compared over stretches of this length, metres, and at least so many of them.
_WAY_M = 2.0
_LEAST_WAYS = 3
# Their median counts beyond so many of its standard errors by the spread of the ways, and beyond
# this share of what odometry claims of one way.
_SIGNIFICANT, _COMMON = 3.0, 0.5
# In rain all ways are too short, by up to a fifth: that counts only where odometry claims to know
# them better than this share.
_SURE = 0.065
# Standard error of the median of n normal values: times their median absolute deviation, over √n.
_OF_MEDIAN = 1.4826 * math.sqrt(math.pi / 2)


def without_odometry(seen: Evidence) -> float | None:
    """Share of frames without odometry."""
    if len(seen) < seen.config.least_frames:
        return None
    return 1.0 - float(np.mean(seen.odometry))


def frozen_frames(seen: Evidence) -> float | None:
    """Most images in a row that repeat the one before.

    Equal pairs while the robot rests, or before it has moved, say nothing: a simulated camera may
    have no noise. Where odometry last failed, or wheels turn, the robot counts as moving.
    """
    if not seen.looks or len(seen.looks) != len(seen):
        return None
    longest = [0, 0]
    run, moving = [0, 0], False
    for number, look in enumerate(seen.looks):
        step, told = seen.moved[number], seen.outside[number]
        still = all(look.repeats)
        turns = told is not None and told.distance_m > _MOVING_M
        if not any(look.repeats):
            moving = number > 0 if step is None else step.distance_m > _MOVING_M
        for side in (0, 1):
            old = _repeats(look, side) or (turns and _frozen(seen, number))
            run[side] = run[side] + 1 if old else 0
            if not still or moving or turns or run[side] >= _LONG:
                longest[side] = max(longest[side], run[side])
    return float(max(longest))


def scale_off(seen: Evidence) -> float | None:
    """How far odometry's scale is from that of motion from outside, as a share.

    None where odometry is too unsure to decide: in rain its steps are uncertain, and too short.
    """
    ways: list[tuple[float, float]] = []
    nowhere = SE3.identity(), SE3.identity(), 0.0
    measured, outside, variance = nowhere
    for step, sigma_m, told in zip(seen.moved, seen.sigma_m, seen.outside, strict=True):
        if step is None or told is None:
            measured, outside, variance = nowhere
            continue
        measured, outside, variance = measured @ step, outside @ told, variance + sigma_m**2
        if outside.distance_m >= _WAY_M:
            way_m = outside.distance_m
            ways.append((measured.distance_m / way_m, math.sqrt(variance) / way_m))
            measured, outside, variance = nowhere
    if len(ways) < _LEAST_WAYS:
        return None
    ratios, sigmas = np.array(ways).T
    ratio, sigma = float(np.median(ratios)), float(np.median(sigmas))
    if ratio < 1 and sigma > _SURE:
        return None
    spread = _OF_MEDIAN * float(np.median(np.abs(ratios - ratio))) / math.sqrt(len(ways))
    unsure, off = max(_SIGNIFICANT * spread, _COMMON * sigma), abs(ratio - 1)
    return off if max(off, seen.config.scale) > unsure else None


def turn_ratio(seen: Evidence) -> float | None:
    """The turn by gyroscope or wheels over that which odometry sees; the median where it turns.

    Axes do not matter to it, so that a mounting that is not known does no harm.
    """
    ratios = [
        turned_rad / step.angle_rad
        for step, turned_rad in zip(seen.moved, seen.turned_rad, strict=False)
        if step is not None and turned_rad is not None and step.angle_rad > _TURNING_RAD
    ]
    return float(np.median(ratios)) if len(ratios) >= seen.config.least_frames else None


def _repeats(look: Look, side: int) -> bool:
    return look.repeats[side] and look.contrast[side] > _CONTRAST


def _frozen(seen: Evidence, number: int) -> bool:
    return seen.statuses[number] is FrameStatus.FROZEN
