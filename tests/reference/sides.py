"""How much two sides differ, and images freed of it, in plain NumPy: kernels/sides.hpp."""

import numpy as np

from .brief import halve

_BLOCK, _WINDOW, _STEP, _UNSEEN = 8, (5, 10), (2, 5), 3


def _window_sums(values: np.ndarray) -> np.ndarray:
    """Of the 15×15 window about each pixel, as much of it as lies in the image."""
    height, width = values.shape
    total = np.zeros((height + 1, width + 1), np.int64)
    total[1:, 1:] = values.astype(np.int64).cumsum(0).cumsum(1)
    (top, bottom), (left, right) = (
        (np.maximum(np.arange(side) - 7, 0), np.minimum(np.arange(side) + 8, side))
        for side in (height, width)
    )
    lower = total[bottom][:, right] - total[bottom][:, left]
    upper = total[top][:, right] - total[top][:, left]
    return np.asarray((lower - upper).astype(np.float32))


def even_contrast(image: np.ndarray) -> np.ndarray:
    """Each pixel's distance from the mean of the 15×15 window about it, in its deviations."""
    pixels = _window_sums(np.ones_like(image))
    mean = _window_sums(image) / pixels
    variance = _window_sums(image.astype(np.int64) ** 2) / pixels - mean * mean
    spread = np.sqrt(np.maximum(variance, 0) + np.float32(1))
    level = np.float32(128.5) + np.float32(32) * ((image.astype(np.float32) - mean) / spread)
    return np.clip(level, 0, 255).astype(np.uint8)


def side_difference(
    left: np.ndarray, right: np.ndarray, max_disparity_px: int, mask: np.ndarray | None = None
) -> float:
    """What a quarter of the windows of the right image differ by at least."""
    halves = halve(left), halve(right)
    down, across = (side // _BLOCK for side in halves[0].shape)
    if not down or not across:
        return 0.0
    hidden = np.zeros((down, across), bool)
    if mask is not None:
        whole = ~mask[: 2 * _BLOCK * down, : 2 * _BLOCK * across]
        hidden = whole.reshape(down, 2 * _BLOCK, across, 2 * _BLOCK).any(axis=(1, 3))
    rows, columns = min(_WINDOW[0], down), min(_WINDOW[1], across)

    def moments(half: np.ndarray, y: int, x: int) -> tuple[float, float]:
        part = half[y * _BLOCK : (y + rows) * _BLOCK : 2, x * _BLOCK : (x + columns) * _BLOCK]
        return part.mean(), part.std()

    found = []
    for y in range(0, down - rows + 1, _STEP[0]):
        for x in range(0, max(across - columns + 1 - _UNSEEN, 1), _STEP[1]):
            last = min(x + max_disparity_px // (2 * _BLOCK) + 2, across - columns + 1)
            if hidden[y : y + rows, x : last - 1 + columns].any():
                continue
            mean, spread = moments(halves[1], y, x)
            there = [moments(halves[0], y, at) for at in range(x, last)]
            found.append(min(np.hypot(mean - m, spread - s) / (s + 5) for m, s in there))
    return float(np.sort(found)[3 * (len(found) - 1) // 4]) if found else 0.0
