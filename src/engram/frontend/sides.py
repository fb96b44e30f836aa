"""Corners that the left and the right image share, wherever they lie.

The front-end searches along the row and to the left only, as a calibrated pair demands. Here
nothing is demanded, so that what is wrong with a pair shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.frontend.frame import StereoPair

Array = NDArray[np.float64]

_CORNERS = 400
_FAST_THRESHOLD = 7
_CELL_PX = 32
# Most different bits of a BRIEF descriptor of 256: a random pair differs in 128 ± 8.
_MOST_BITS = 64
_RATIO = 0.85
# Vertical offsets further than this from the usual one are wrong matches.
_WRONG_PX = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class SideMatches:
    """Corners that both images show.

    Attributes:
        pixels: (M, 2) float64, left u, v, px.
        shift: (M, 2) float64, left minus right u and v, px: disparity and vertical offset.
    """

    pixels: Array
    shift: Array

    def __len__(self) -> int:
        return len(self.pixels)


def match_sides(pair: StereoPair) -> SideMatches:
    """Mutually nearest corners of a pair, the wrong ones mostly removed."""
    (left, of_left), (right, of_right) = _corners(pair.left), _corners(pair.right)
    if min(len(left), len(right)) < 2:
        return SideMatches(np.zeros((0, 2)), np.zeros((0, 2)))
    bits = _core.hamming_matrix(of_left, of_right)
    nearest = bits.argmin(axis=1)
    rows = np.arange(len(left))
    best = bits[rows, nearest].astype(np.float64)
    bits[rows, nearest] = 999
    kept = (best <= _MOST_BITS) & (best < _RATIO * bits.min(axis=1))
    bits[rows, nearest] = best
    kept &= bits.argmin(axis=0)[nearest] == rows
    pixels, shift = left[kept], left[kept] - right[nearest[kept]]
    near = np.abs(shift[:, 1] - np.median(shift[:, 1])) < _WRONG_PX if len(shift) else kept[:0]
    return SideMatches(pixels[near], shift[near])


def _corners(image: NDArray[np.uint8]) -> tuple[Array, NDArray[np.uint8]]:
    """The best corners of each cell, (N, 2) px, with their descriptors (N, 32)."""
    positions, scores, offsets = _core.detect_corners(image, _FAST_THRESHOLD)
    height, width = image.shape
    best = _core.order_corners(positions, scores, width, height, _CELL_PX)[:_CORNERS]
    described = _core.describe(_core.smooth(image), np.ascontiguousarray(positions[best]))
    return positions[best].astype(np.float64) + offsets[best], described
