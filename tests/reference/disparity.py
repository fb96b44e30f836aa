"""Stereo by search along the row, in plain NumPy: the method of kernels/disparity.hpp."""

import numpy as np

from .brief import halve
from .sides import even_contrast


def _half_costs(window: np.ndarray, image: np.ndarray, row: int, columns: np.ndarray) -> np.ndarray:
    """Truncated SAD of a 7×7 window against windows about `columns`; infinite outside the image."""
    costs = np.full(len(columns), np.inf)
    for k, x in enumerate(columns):
        if 3 <= x < image.shape[1] - 3:
            there = image[row - 3 : row + 4, x - 3 : x + 4].astype(int)
            costs[k] = np.minimum(np.abs(window.astype(int) - there), 36).sum()
    return costs


def search_half(
    left: np.ndarray, right: np.ndarray, x: int, y: int, most_px: int, uniqueness: float
) -> int | None:
    """The unique, mutual best whole disparity at half resolution."""
    disparities = np.arange(min((most_px + 1) // 2, x), -2, -1)
    window = left[y - 3 : y + 4, x - 3 : x + 4]
    costs = _half_costs(window, right, y, x - disparities)
    at = int(np.argmin(costs))
    first = int(np.flatnonzero(np.isfinite(costs))[0])
    if at <= first or at == len(costs) - 1:
        return None
    elsewhere = np.abs(np.arange(len(costs)) - at) > 2
    next_best = min(costs[elsewhere].min(initial=np.inf), 65535)
    if np.float32(costs[at]) >= np.float32(uniqueness) * np.float32(next_best):
        return None
    disparity = int(disparities[at])
    xr = x - disparity
    back = np.sort(disparities)
    costs_back = _half_costs(right[y - 3 : y + 4, xr - 3 : xr + 4], left, y, xr + back)
    near = np.abs(back - disparity) <= 1
    return disparity if costs_back[near].min() == costs_back.min() else None


def _brought(image: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The right image with the brightness and contrast of the left window, given both windows."""
    energy = [left.size * (w.astype(int) ** 2).sum() - w.sum(dtype=int) ** 2 for w in (left, right)]
    gain = np.float32(np.sqrt(energy[0] / max(energy[1], 1)))
    means = [
        np.float32(window.sum(dtype=int)) / np.float32(window.size) for window in (left, right)
    ]
    level = means[0] + np.float32(0.5) + gain * (image.astype(np.float32) - means[1])
    return np.clip(level, 0, 255).astype(np.uint8)


def measure(
    left: np.ndarray,
    right: np.ndarray,
    x: int,
    y: int,
    *,
    max_disparity_px: int,
    min_disparity_px: float,
    uniqueness: float,
    max_residual: float,
    max_sigma_px: float,
    sigma_floor_px: float,
    sigma_scale: float,
    sides_differ: bool = False,
) -> tuple[float, float] | None:
    """Disparity and σ at a corner, px, or None."""
    halves = [halve(left), halve(right)]
    if sides_differ:
        halves = [even_contrast(half) for half in halves]
    coarse = search_half(*halves, x // 2, y // 2, max_disparity_px, uniqueness)
    if coarse is None or x - (2 * coarse + 3) < 8:
        return None
    rows, columns = slice(y - 4, y + 5), np.arange(x - 8, x + 8)
    here = left[rows][:, columns].astype(float)
    gradient = left[rows][:, columns + 1].astype(float) - left[rows][:, columns - 1]
    gradient -= gradient.mean()
    energy = (gradient**2).sum()
    if energy == 0:
        return None

    if sides_differ:
        right = _brought(right, left[rows][:, columns], right[rows][:, columns - 2 * coarse])

    def residual(d: int) -> np.ndarray:
        return here - right[rows][:, columns - d]

    candidates = range(2 * coarse - 2, 2 * coarse + 3)
    whole = min(candidates, key=lambda d: np.abs(residual(d)).sum())

    def along(d: int) -> float:
        return float((gradient * (residual(d) - residual(d).mean())).sum())

    # The kernel decides signs in exact integers; here a rounding error must not flip a zero.
    if round(along(whole) * gradient.size) > 0:
        whole -= 1
    below, above = along(whole), along(whole + 1)
    if round(below * gradient.size) > 0 or round(above * gradient.size) <= 0:
        return None
    fraction = -below / (above - below)
    nearest = residual(whole if fraction < 0.5 else whole + 1)
    nearest = nearest - nearest.mean()
    unexplained = (nearest**2).sum() - (gradient * nearest).sum() ** 2 / energy
    unexplained = max(unexplained, 0.0)
    if unexplained > max_residual * ((here - here.mean()) ** 2).sum():
        return None
    noise = (unexplained / (gradient.size - 2) + 1 / 6) / (energy / 4)
    disparity = whole + fraction
    sigma = float(np.sqrt(sigma_floor_px**2 + sigma_scale**2 * noise))
    usable = min_disparity_px <= disparity <= max_disparity_px and sigma <= max_sigma_px
    return (disparity, sigma) if usable else None
