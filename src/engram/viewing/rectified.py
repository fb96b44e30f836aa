"""A rectified pair with epipolar lines, for the eye; and how well its rows agree."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend import StereoPair

_LINES = 16
_GAP_PX = 4
_CAPTION_PX = 26
# Matched corners that are this far apart in height are no match, px.
_MOST_ROWS_PX = 20.0
# ORB descriptors that differ in more bits are of different points.
_MOST_BITS = 32


def row_offsets_px(pair: StereoPair) -> NDArray[np.float64]:
    """(N,) heights of matched corners in the left image minus those in the right, px.

    Near 0 throughout for a good calibration. Independent of the front-end, which only searches
    along the row.
    """
    orb = cv2.ORB.create(1500)
    (left, left_codes), (right, right_codes) = (
        orb.detectAndCompute(image, None) for image in (pair.left, pair.right)
    )
    if not (len(left) and len(right)):
        return np.zeros(0)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_codes, right_codes)
    offsets = [
        left[one.queryIdx].pt[1] - right[one.trainIdx].pt[1]
        for one in matches
        if one.distance <= _MOST_BITS
    ]
    found = np.array(offsets, dtype=np.float64)
    return found[np.abs(found) <= _MOST_ROWS_PX]


def rectified_picture(pair: StereoPair, caption: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR: left and right image, and the rows that a point of one lies on."""
    height, width = pair.left.shape
    canvas = np.zeros((height + _CAPTION_PX, 2 * width + _GAP_PX, 3), dtype=np.uint8)
    left = pair.left if pair.mask is None else np.where(pair.mask, pair.left, pair.left // 3)
    canvas[:height, :width] = left[..., None]
    canvas[:height, width + _GAP_PX :] = pair.right[..., None]
    for number in range(1, _LINES):
        row = number * height // _LINES
        hue = np.array([[[170 * number // _LINES, 200, 255]]], dtype=np.uint8)
        colour = tuple(int(one) for one in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0])
        cv2.line(canvas, (0, row), (2 * width + _GAP_PX, row), colour, 1)
    for text, column in ((f"left   {caption}", 6), ("right", width + _GAP_PX + 6)):
        origin = (column, height + _CAPTION_PX - 8)
        cv2.putText(
            canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (230, 230, 230), 1, cv2.LINE_AA
        )
    return canvas
