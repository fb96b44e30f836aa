"""The matcher by which the world's difficulty is judged: OpenCV only, and never tuned.

FAST corners spread by a grid, BRIEF, brute force with ratio and mutual test, PnP-RANSAC. It is
deliberately none of ours, so that a better matcher of ours does not move the world.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import StereoPair
from engram.frontend.opencv_contrib import xfeatures2d
from engram.geometry.se3 import SE3

_FAST_THRESHOLD = 8
_CELL_PX = (64, 48)
_PER_CELL = 14  # about 600 corners at 512×384
_STEREO_HAMMING = 45
_HAMMING = 50
_RATIO = 0.9
_REPROJECTION_PX = 2.0
_ITERATIONS = 300
_WINDOW = 5  # of the block search for sub-pixel disparity, half side, px

SUCCESS_INLIERS = 20
SUCCESS_ERROR_M = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceFrame:
    """What the reference makes of a pair.

    Attributes:
        corners: number of corners found in the left image.
        pixels: (N, 2) float32, those with depth.
        descriptors: (N, 32) uint8.
        points_in_cam: (N, 3) float64, metres.
        camera_matrix: (3, 3).
    """

    corners: int
    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    points_in_cam: NDArray[np.float64]
    camera_matrix: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ReferenceMatch:
    """Inliers of the pose, and the pose; None where there is none."""

    inliers: int
    live_from_map: SE3 | None

    def succeeds(self, true_live_from_map: SE3) -> bool:
        """20 inliers, and the camera within 0.25 m of where it is."""
        return self.right_inliers(true_live_from_map) >= SUCCESS_INLIERS

    def right_inliers(self, true_live_from_map: SE3) -> int:
        """The inliers, 0 where the pose is wrong."""
        if self.live_from_map is None:
            return 0
        error = self.live_from_map.inverse() @ true_live_from_map
        return self.inliers if error.distance_m < SUCCESS_ERROR_M else 0


def reference_frame(pair: StereoPair) -> ReferenceFrame:
    """Corners with depth."""
    camera = pair.camera
    left, left_descriptors = _describe(pair.left)
    right, right_descriptors = _describe(pair.right)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    pixels, kept, disparities = [], [], []
    for a, b in _stereo_matches(left, left_descriptors, right, right_descriptors):
        disparity = _refined_disparity(pair, left[a], right[b])
        if disparity is not None:
            pixels.append(left[a])
            kept.append(a)
            disparities.append(disparity)
    points = camera.triangulate(
        np.array(pixels, dtype=np.float32).reshape(-1, 2), np.array(disparities, dtype=np.float32)
    )
    return ReferenceFrame(
        len(left),
        np.array(pixels, dtype=np.float32).reshape(-1, 2),
        left_descriptors[kept],
        points.astype(np.float64),
        matrix,
    )


def reference_match(live: ReferenceFrame, node: ReferenceFrame) -> ReferenceMatch:
    """Matches a live frame to a map's: the node's points onto the live frame's pixels."""
    pairs = _mutual(node.descriptors, live.descriptors)
    if len(pairs) < 8:
        return ReferenceMatch(0, None)
    points = node.points_in_cam[pairs[:, 0]]
    pixels = live.pixels[pairs[:, 1]].astype(np.float64)
    cv2.setRNGSeed(1)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points, pixels, live.camera_matrix, None, iterationsCount=_ITERATIONS,
        reprojectionError=_REPROJECTION_PX, confidence=0.999, flags=cv2.SOLVEPNP_P3P,
    )  # fmt: skip
    if not found or len(inliers) < 6:
        return ReferenceMatch(0, None)
    chosen = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(
        points[chosen], pixels[chosen], live.camera_matrix, None, rotation, translation
    )
    turned = np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64)
    pose = SE3(turned, np.asarray(translation, dtype=np.float64)[:, 0])
    return ReferenceMatch(len(chosen), pose)


def _describe(image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    detector = cv2.FastFeatureDetector.create(_FAST_THRESHOLD)
    cells: dict[tuple[int, int], int] = {}
    chosen = []
    for corner in sorted(detector.detect(image, None), key=lambda k: -k.response):
        cell = (int(corner.pt[0]) // _CELL_PX[0], int(corner.pt[1]) // _CELL_PX[1])
        if cells.get(cell, 0) < _PER_CELL:
            cells[cell] = cells.get(cell, 0) + 1
            chosen.append(corner)
    brief = xfeatures2d("the reference matcher").BriefDescriptorExtractor.create(32, False)
    kept, descriptors = brief.compute(image, chosen)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
    pixels = np.array([corner.pt for corner in kept], dtype=np.float32).reshape(-1, 2)
    return pixels, np.asarray(descriptors, dtype=np.uint8)


def _distances(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int32]:
    words_a, words_b = a.view(np.uint64), b.view(np.uint64)
    return np.asarray(np.bitwise_count(words_a[:, None] ^ words_b[None]).sum(-1), dtype=np.int32)


def _stereo_matches(
    left: NDArray[np.float32], left_descriptors: NDArray[np.uint8],
    right: NDArray[np.float32], right_descriptors: NDArray[np.uint8],
) -> NDArray[np.int64]:  # fmt: skip
    if not len(left) or not len(right):
        return np.zeros((0, 2), dtype=np.int64)
    distance = _distances(left_descriptors, right_descriptors)
    shift = left[:, None] - right[None]
    distance[(np.abs(shift[..., 1]) > 1) | (shift[..., 0] < 0.5) | (shift[..., 0] > 160)] = 999
    best = distance.argmin(1)
    rows = np.arange(len(left))
    good = (distance[rows, best] < _STEREO_HAMMING) & (distance.argmin(0)[best] == rows)
    return np.stack([rows[good], best[good]], axis=1)


def _refined_disparity(
    pair: StereoPair, left: NDArray[np.float32], right: NDArray[np.float32]
) -> float | None:
    """Block search around the matched corner with a parabola through the best three."""
    x, y, x_right, w = int(left[0]), int(left[1]), int(right[0]), _WINDOW
    height, width = pair.left.shape
    if min(x, y, x_right - 2) < w or max(x, x_right + 2) >= width - w or y >= height - w:
        return None
    patch = pair.left[y - w : y + w + 1, x - w : x + w + 1].astype(np.float32)
    strip = pair.right[y - w : y + w + 1, x_right - w - 2 : x_right + w + 3].astype(np.float32)
    costs = [float(np.abs(patch - strip[:, s : s + 2 * w + 1]).sum()) for s in range(5)]
    best = int(np.argmin(costs))
    if best in {0, 4}:
        return None
    bend = costs[best - 1] - 2 * costs[best] + costs[best + 1]
    fraction = 0.5 * (costs[best - 1] - costs[best + 1]) / bend if bend > 1e-6 else 0.0
    disparity = x - (x_right + best - 2 + fraction)
    return disparity if disparity >= 0.8 else None


def _mutual(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int64]:
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    distance = _distances(a, b)
    rows = np.arange(len(a))
    best = distance.argmin(1)
    second = np.partition(distance, 1, axis=1)[:, 1]
    good = (
        (distance[rows, best] < _HAMMING)
        & (distance.argmin(0)[best] == rows)
        & (distance[rows, best] < _RATIO * second)
    )
    return np.stack([rows[good], best[good]], axis=1)
