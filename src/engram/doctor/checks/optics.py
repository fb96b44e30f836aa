"""Optics: whether camera and baseline suit the scene."""

from __future__ import annotations

import math

import numpy as np

from engram.doctor.examination import Evidence


def px_per_deg(seen: Evidence) -> float | None:
    """Pixels per degree at the middle of the image."""
    return None if seen.camera is None else math.radians(seen.camera.fx)


def disparity_px(seen: Evidence) -> float | None:
    """Median disparity of the landmarks."""
    known = [one for one in seen.disparity_px if one > 0]
    return float(np.median(known)) if len(known) >= seen.config.least_frames else None
