"""FAST-9 and the spread over the grid, in plain NumPy."""

import numpy as np

CIRCLE = [(0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3)]
CIRCLE += [(-x, -y) for x, y in CIRCLE]
BORDER_PX = 17


def fast_scores(image: np.ndarray) -> np.ndarray:
    """(h, w) int: the smallest threshold at which a pixel is no corner; 0 near the image's edge.

    A corner at threshold t has nine successive pixels on the circle that are all brighter than
    centre + t, or all darker than centre - t (Rosten & Drummond, ECCV 2006).
    """
    wide = image.astype(np.int64)
    height, width = image.shape
    centre = wide[3:-3, 3:-3]
    circle = [wide[3 + y : height - 3 + y, 3 + x : width - 3 + x] - centre for x, y in CIRCLE]
    best = np.zeros_like(centre)
    for start in range(16):
        arc = np.stack([circle[(start + k) % 16] for k in range(9)])
        best = np.maximum(best, np.maximum(arc.min(axis=0), (-arc).min(axis=0)))
    scores = np.zeros_like(wide)
    scores[3:-3, 3:-3] = best
    return scores


def detect(image: np.ndarray, threshold: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 2) x, y in raster order, and scores, of 3×3 maxima above the threshold."""
    scores = fast_scores(image)
    found = []
    for y in range(BORDER_PX, image.shape[0] - BORDER_PX):
        for x in range(BORDER_PX, image.shape[1] - BORDER_PX):
            around = scores[y - 1 : y + 2, x - 1 : x + 2].ravel()
            score = around[4]
            if score > threshold and (score >= around[:4]).all() and (score > around[5:]).all():
                found.append((x, y, score))
    table = np.array(found, dtype=np.int64).reshape(-1, 3)
    return table[:, :2], table[:, 2]


def spread_order(positions: np.ndarray, scores: np.ndarray, cell_px: int) -> np.ndarray:
    """Indices: the best corner of every cell by falling score, then the second of every cell …."""
    by_score = np.argsort(-scores.astype(np.int64), kind="stable")
    seen: dict[tuple[int, int], int] = {}
    rounds = np.empty(len(scores), dtype=np.int64)
    for i in by_score:
        cell = (int(positions[i, 0]) // cell_px, int(positions[i, 1]) // cell_px)
        rounds[i] = seen.get(cell, 0)
        seen[cell] = rounds[i] + 1
    return by_score[np.argsort(rounds[by_score], kind="stable")]


def refine(scores: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(N, 2) sub-pixel offsets: peaks of parabolas through the scores smoothed with 1 2 1."""
    weights = np.outer((1, 2, 1), (1, 2, 1))

    def smoothed(x: int, y: int) -> int:
        return int((weights * scores[y - 1 : y + 2, x - 1 : x + 2]).sum())

    offsets = np.zeros((len(positions), 2))
    for row, (x, y) in enumerate(positions):
        for axis, (dx, dy) in enumerate([(1, 0), (0, 1)]):
            before, here, after = (smoothed(x + k * dx, y + k * dy) for k in (-1, 0, 1))
            if 2 * here - before - after > 0:
                peak = 0.5 * (after - before) / (2 * here - before - after)
                offsets[row, axis] = np.clip(peak, -0.45, 0.45)
    return offsets
