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
        depth_m = _median(frame.landmarks.points_in_cam[rows, 2])
        spreads.append((math.sqrt(width * height), share, depth_m))
    return Spread(*(min(values) for values in zip(*spreads, strict=True)))


def _extent(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """From the 10th to the 90th percentile, along the first axis.

    As `np.percentile` has it, to the bit, in a tenth of its time.
    """
    ordered = np.sort(values, axis=0)
    extent: NDArray[np.floating] = _percentile(ordered, 90) - _percentile(ordered, 10)
    return extent


def _median(values: NDArray[np.floating]) -> float:
    """As `np.median` has it, to the bit, in a fifth of its time."""
    ordered = np.sort(values)
    middle = len(ordered) // 2
    odd = len(ordered) % 2
    return float(ordered[middle] if odd else (ordered[middle - 1] + ordered[middle]) / 2)


def _percentile(ordered: NDArray[np.floating], percent: int) -> NDArray[np.floating]:
    place = percent / 100 * (len(ordered) - 1)
    below = math.floor(place)
    low, high = ordered[below], ordered[min(below + 1, len(ordered) - 1)]
    share = np.float64(place - below)
    value: NDArray[np.floating] = (
        high - (high - low) * (1 - share) if share >= 0.5 else low + (high - low) * share
    )
    return value
