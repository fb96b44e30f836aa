"""Corners that are truly the same, and the patches around them."""

from __future__ import annotations

import numpy as np
from tests.core.textures import texture

from engram.frontend.frame import Landmarks
from engram.geometry.cameras import StereoCamera
from engram_lab.eyes import Patches, same_corners

CAMERA = StereoCamera(300.0, 300.0, 255.5, 191.5, 0.24, 512, 384)


def seen_from(points: np.ndarray, octaves: np.ndarray) -> Landmarks:
    z = points[:, 2]
    pixels = 300.0 * points[:, :2] / z[:, None] + [255.5, 191.5]
    disparity = CAMERA.fx * CAMERA.baseline_m / z
    empty = np.zeros((len(points), 0), np.uint8)
    columns = (pixels, disparity, 0 * disparity, points)
    return Landmarks(*(one.astype(np.float32) for one in columns), empty, octaves)


def test_corners_are_found_again_from_where_the_camera_moved() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([-4, -2, 6], [4, 2, 20], (120, 3))
    octaves = np.zeros(120, np.uint8)
    b_from_a = np.eye(4)
    b_from_a[:3, 3] = [0.2, 0, -0.5]
    order = rng.permutation(120)
    moved = points[order] + b_from_a[:3, 3]
    pairs = same_corners(seen_from(points, octaves), seen_from(moved, octaves), b_from_a, CAMERA)
    right = order[pairs[:, 1]] == pairs[:, 0]
    assert len(pairs) > 100
    assert right.mean() > 0.98
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)


def test_other_depths_and_other_scales_are_not_the_same_corner() -> None:
    points, octaves = np.array([[0.0, 0.0, 8.0]]), np.zeros(1, np.uint8)
    a = seen_from(points, octaves)
    behind = seen_from(points * 1.5, octaves)
    coarse = seen_from(points, octaves + 1)
    assert len(same_corners(a, seen_from(points, octaves), np.eye(4), CAMERA)) == 1
    assert len(same_corners(a, behind, np.eye(4), CAMERA)) == 0
    assert len(same_corners(a, coarse, np.eye(4), CAMERA)) == 0


def test_a_patch_has_its_corner_in_the_middle() -> None:
    image = texture(200, 300, seed=4)
    cut = Patches(image).around(
        np.array([[150.2, 80.4], [2, 3]], np.float32), np.zeros(2, np.uint8)
    )
    assert cut.shape == (2, 64, 64)
    np.testing.assert_array_equal(cut[0], image[80 - 32 : 80 + 32, 150 - 32 : 150 + 32])
    assert cut[1, 32, 32] == image[3, 2]
