"""Plain twin of the kernel `kept_rows`: landmarks at the pixels of those of another frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Landmarks


def kept_rows(
    before: Landmarks, now: Landmarks, most_bits: int, most_disparity_px: float
) -> NDArray[np.int32]:
    """See `engram.odometry.fixed.kept_rows`: every landmark with every other."""
    rows = np.full(len(before), -1, np.int32)
    here, there = np.rint(before.pixels), np.rint(now.pixels)
    for i in range(len(before)):
        near = (np.abs(there - here[i]) <= 1).all(1)
        near &= np.abs(now.disparity_px - before.disparity_px[i]) <= most_disparity_px
        bits = np.unpackbits(now.descriptors ^ before.descriptors[i], axis=1).sum(1)
        fits = np.flatnonzero(near & (bits <= most_bits))
        if len(fits):
            rows[i] = fits[np.argmin(bits[fits])]
    return rows
