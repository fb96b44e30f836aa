"""Images: exposure, sharpness, depth of grey."""

from __future__ import annotations

import numpy as np

from engram.doctor.examination import Evidence


def saturated(seen: Evidence) -> float | None:
    """Share of frames too much of which is white."""
    return _spoilt([look.saturated > seen.config.saturated for look in seen.looks])


def black(seen: Evidence) -> float | None:
    """Share of frames too much of which is black."""
    return _spoilt([look.black > seen.config.black for look in seen.looks])


def exposure_step(seen: Evidence) -> float | None:
    """Largest change of brightness from one frame to the next, in factors of two."""
    if len(seen.looks) < seen.config.least_frames or len(seen.looks) != len(seen):
        return None
    bright = np.log2([max(look.brightness[0], 1.0) for look in seen.looks])
    steps = np.abs(np.diff(bright))[~np.array(seen.first[1:], np.bool_)]
    return float(steps.max()) if len(steps) else None


def exposure_difference(seen: Evidence) -> float | None:
    """Difference of brightness between left and right, in factors of two: the median."""
    if len(seen.looks) < seen.config.least_frames:
        return None
    bright = np.log2(np.maximum([look.brightness for look in seen.looks], 1.0))
    return float(np.median(np.abs(bright[:, 0] - bright[:, 1])))


def sharpness(seen: Evidence) -> float | None:
    """Mean square of the second difference along rows over the variance: the median."""
    return float(np.median(seen.sharpness)) if len(seen.sharpness) >= 3 else None


def bits(seen: Evidence) -> float | None:
    """Bits of the brightest pixel of 16-bit images."""
    return None if seen.facts.bits is None else float(seen.facts.bits)


def fixed_share(seen: Evidence) -> float | None:
    """Share of the image that moves with the camera."""
    return seen.fixed_share if len(seen) >= seen.config.least_frames else None


def doubted(seen: Evidence) -> float | None:
    """Share of frames that leave open whether the robot or part of the image stood still."""
    return seen.doubted / len(seen) if len(seen) >= seen.config.least_frames else None


def _spoilt(frames: list[bool]) -> float | None:
    return float(np.mean(frames)) if frames else None


def bad_pairs(seen: Evidence) -> float | None:
    """Pairs that were left out because an image cannot be used."""
    return float(len(seen.bad))
