"""BRIEF-256 (Calonder et al., ECCV 2010) in plain NumPy, and the pattern's origin."""

import numpy as np

HALF_PATCH_PX = 15


def sampling_pattern() -> np.ndarray:
    """(256, 4) int8: x0, y0, x1, y1 of each test, relative to the corner, px.

    Both points of a test are drawn from an isotropic normal distribution with σ = patch / 5, the
    paper's best arrangement (G II), rounded and clipped to the 31×31 patch; equal points are drawn
    again. Seed 256. The table in src/core/kernels/brief_pattern.inc is this one.
    """
    rng = np.random.default_rng(256)
    sigma_px = (2 * HALF_PATCH_PX + 1) / 5
    tests: list[np.ndarray] = []
    while len(tests) < 256:
        test = np.clip(np.rint(rng.normal(0, sigma_px, 4)), -HALF_PATCH_PX, HALF_PATCH_PX)
        if (test[:2] != test[2:]).any():
            tests.append(test)
    return np.array(tests, dtype=np.int8)


def smooth(image: np.ndarray) -> np.ndarray:
    """Binomial 5×5 blur, rounded to nearest; the outer two pixels are zero."""
    wide = image.astype(np.int64)
    weights = (1, 4, 6, 4, 1)
    height, width = image.shape
    rows = sum(w * wide[k : height - 4 + k] for k, w in enumerate(weights))
    total = sum(w * rows[:, k : width - 4 + k] for k, w in enumerate(weights))
    result = np.zeros_like(image)
    result[2:-2, 2:-2] = (total + 128) >> 8
    return result


def halve(image: np.ndarray) -> np.ndarray:
    """Mean of 2×2 pixels, rounded half up."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    blocks = image[: 2 * height, : 2 * width].reshape(height, 2, width, 2).astype(np.int64)
    return ((blocks.sum(axis=(1, 3)) + 2) >> 2).astype(np.uint8)


def describe(smoothed: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(N, 32) uint8 descriptors at integer corners (N, 2) x, y: bit t set where p0 < p1."""
    x0, y0, x1, y1 = sampling_pattern().T.astype(np.int64)
    x, y = corners.T.astype(np.int64)[..., None]
    bits = smoothed[y + y0, x + x0] < smoothed[y + y1, x + x1]
    return np.packbits(bits, axis=1, bitorder="little")
