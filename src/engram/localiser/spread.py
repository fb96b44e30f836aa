"""Extent of the inliers of a match: one facade or one car is not a place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.frontend import Frame
from engram.frontend.matching import Match


@dataclass(frozen=True, slots=True)
class Spread:
    """Extent of a match's inliers, from their 10th to their 90th percentile.

    Attributes:
        image: share of the image: geometric mean of the shares of its width and its height.
        height: extent along the camera's y axis, as a share of that of all landmarks of the frame.
        depth_m: median depth in front of the camera, metres.
    """

    image: float
    height: float
    depth_m: float


def inlier_spread(match: Match, reference: Frame, live: Frame) -> Spread:
    """The extent of a match's inliers; of each measure, the smaller of the two frames."""
    if match.inliers == 0:
        return Spread(0.0, 0.0, 0.0)
    spreads = []
    for frame, rows in ((reference, match.reference_rows), (live, match.live_rows)):
        size = (frame.camera.width, frame.camera.height)
        width, height = _extent(frame.landmarks.pixels[rows] / size).tolist()
        height_m = frame.landmarks.points_in_cam[:, 1]
        whole_m = max(float(_extent(height_m)), np.finfo(np.float64).tiny)
        share = float(_extent(height_m[rows])) / whole_m
        depth_m = float(np.median(frame.landmarks.points_in_cam[rows, 2]))
        spreads.append((math.sqrt(width * height), share, depth_m))
    return Spread(*(min(values) for values in zip(*spreads, strict=True)))


def _extent(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """From the 10th to the 90th percentile, along the first axis."""
    low, high = np.percentile(values, [10, 90], axis=0)
    extent: NDArray[np.floating] = high - low
    return extent
