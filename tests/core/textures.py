"""Synthetic stereo pairs with known disparity."""

import cv2
import numpy as np


def texture(height: int, width: int, seed: int, contrast: float = 1.0) -> np.ndarray:
    """A (height, width) uint8 image with detail at several scales: blurred noise, summed."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width), dtype=np.float32)
    for sigma in (1.0, 2.0, 5.0):
        layer = cv2.GaussianBlur(
            rng.standard_normal((height, width), dtype=np.float32), (0, 0), sigma
        )
        total += layer / layer.std()
    grey = 128 + contrast * 30 * total
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def shifted_pair(
    height: int, width: int, disparity_px: float, seed: int, noise: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Left and right uint8 views of a plane of constant disparity, by sampling a finer texture.

    Both views are area means over 4×4 fine pixels, so a disparity that is a multiple of 1/4 px is
    exact and neither view is interpolated.
    """
    fine = texture(4 * height, 4 * (width + 128), seed).astype(np.float32)
    fine = cv2.GaussianBlur(fine, (0, 0), 3.0)
    fine = 128 + (fine - 128) * 40 / fine.std()
    shift = round(4 * disparity_px)
    assert shift == 4 * disparity_px
    rng = np.random.default_rng(seed + 1)
    views = []
    for start in (4 * 64, 4 * 64 + shift):  # the right camera sees what lies further right
        view = fine[:, start : start + 4 * width].reshape(height, 4, width, 4).mean(axis=(1, 3))
        view = view + noise * rng.standard_normal(view.shape)
        views.append(np.clip(np.rint(view), 0, 255).astype(np.uint8))
    return views[0], views[1]
