"""Corners that are truly the same in two views, and the grey patches around corners."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from engram import _core
from engram.frontend import Landmarks
from engram.geometry import StereoCamera

PATCH_PX = 64
_HALF = PATCH_PX // 2
# A corner counts as the same within so many pixels of its octave, with disparities that agree to
# within their noise, and patches whose metric sizes differ by less than one octave.
_SAME_PX = 1.5
_DISPARITY_PX, _DISPARITY_SHARE = 0.35, 0.04
_SIZES = 1.9


def same_corners(
    a: Landmarks,
    b: Landmarks,
    b_from_a: NDArray[np.float64],
    camera: StereoCamera,
    within_px: float = _SAME_PX,
) -> NDArray[np.int64]:
    """Rows (M, 2) of landmarks of `a` and of `b` that show the same corner.

    Args:
        a, b: landmarks of two views.
        b_from_a: (4, 4), true pose of the one camera in the other.
        camera: of `b`.
        within_px: largest distance of a corner of `a`, projected, times the octave's scale.
    """
    points = a.points_in_cam.astype(np.float64) @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    seen = np.flatnonzero(points[:, 2] > 0.5)
    depth_m = points[seen, 2]
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    pixels = focal * points[seen, :2] / depth_m[:, None] + middle
    if not len(seen) or not len(b):
        return np.empty((0, 2), np.int64)
    largest = 2.0 ** max(a.octaves.max(), b.octaves.max())
    near = cKDTree(pixels).sparse_distance_matrix(
        cKDTree(b.pixels.astype(np.float64)), within_px * largest, output_type="ndarray"
    )
    row, j, away_px = near["i"], near["j"], near["v"]
    i = seen[row]
    scale_a, scale_b = 2.0 ** a.octaves[i], 2.0 ** b.octaves[j]
    scale = np.maximum(scale_a, scale_b)
    disparity_px = camera.fx * camera.baseline_m / depth_m[row]
    slack_px = _DISPARITY_PX + _DISPARITY_SHARE * b.disparity_px[j]
    sizes = depth_m[row] * scale_a / (b.points_in_cam[j, 2] * scale_b)
    good = (away_px <= within_px * scale) & (np.abs(disparity_px - b.disparity_px[j]) <= slack_px)
    good &= (sizes < _SIZES) & (sizes > 1 / _SIZES)
    return _mutual(i[good], j[good], (away_px / scale)[good])


def _mutual(
    i: NDArray[np.int64], j: NDArray[np.int64], cost: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Of the pairs (i, j), those that are the cheapest of both i and j."""
    order = np.argsort(cost, kind="stable")
    i, j = i[order], j[order]
    first_i, first_j = (np.zeros(len(order), bool) for _ in range(2))
    first_i[np.unique(i, return_index=True)[1]] = True
    first_j[np.unique(j, return_index=True)[1]] = True
    both = first_i & first_j
    return np.stack([i[both], j[both]], axis=1).astype(np.int64)


class Patches:
    """Cuts patches around the corners of an image, at the octave of each.

    Args:
        image: (h, w) uint8.
        octaves: how many the front-end uses.
    """

    def __init__(self, image: NDArray[np.uint8], octaves: int = 2) -> None:
        level, self._levels = np.ascontiguousarray(image), []
        for octave in range(octaves):
            level = _core.halve(level) if octave else level
            padded = np.pad(level, _HALF, mode="edge")
            self._levels.append(np.lib.stride_tricks.sliding_window_view(padded, (64, 64)))

    def around(self, pixels: NDArray[np.float32], octaves: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Patches (N, 64, 64) uint8, the corner at [32, 32].

        Args:
            pixels: (N, 2) float32, u, v, px of the full-size image.
            octaves: (N,) uint8.
        """
        out = np.empty((len(pixels), PATCH_PX, PATCH_PX), np.uint8)
        for octave, level in enumerate(self._levels):
            here = octaves == octave
            x, y = corner_at(pixels[here], octave).T
            out[here] = level[y, x]
        return out


def corner_at(pixels: NDArray[np.float32], octave: int) -> NDArray[np.int64]:
    """Pixels (N, 2) of an octave's image nearest to points of the full-size one."""
    centres: NDArray[np.int64] = np.rint((pixels + 0.5) / 2**octave - 0.5).astype(np.int64)
    return centres
