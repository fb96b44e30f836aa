"""Optics: whether camera and baseline suit the scene."""

from __future__ import annotations

import math

import numpy as np

from engram.doctor.examination import Evidence


def px_per_deg(seen: Evidence) -> float | None:
    """Pixels per degree at the middle of the image."""
    return None if seen.camera is None else math.radians(seen.camera.fx)


def other_size(seen: Evidence) -> float | None:
    """How far off the middle the principal point is, in half images; 0 where the axes disagree.

    Images that were resized without their calibration shift it alike on both axes; a lens or a
    strip cut from the image shifts it on one.
    """
    if seen.camera is None:
        return None
    across = 2 * seen.camera.cx / (seen.camera.width - 1) - 1
    down = 2 * seen.camera.cy / (seen.camera.height - 1) - 1
    return min(abs(across), abs(down)) if across * down > 0 else 0.0


def disparity_px(seen: Evidence) -> float | None:
    """Median disparity of the landmarks."""
    known = [one for one in seen.disparity_px if one > 0]
    return float(np.median(known)) if len(known) >= seen.config.least_frames else None


def focal_too_long(seen: Evidence) -> float | None:
    """By what share the focal length is too long, by a map."""
    return _above(seen.rematched.focal_factor)


def focal_too_short(seen: Evidence) -> float | None:
    """By what share it is too short."""
    return _below(seen.rematched.focal_factor)


def baseline_too_long(seen: Evidence) -> float | None:
    """By what share the baseline is too long, by a map."""
    return _above(seen.rematched.baseline_factor)


def baseline_too_short(seen: Evidence) -> float | None:
    """By what share it is too short."""
    return _below(seen.rematched.baseline_factor)


def _above(factor: float | None) -> float | None:
    return None if factor is None else max(factor - 1, 0.0)


def _below(factor: float | None) -> float | None:
    return None if factor is None else max(1 - factor, 0.0)
