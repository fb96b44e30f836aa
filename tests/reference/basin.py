"""Counting attempts for the match basin, one after another."""

import numpy as np

BIN_M, BINS, ASIDE_M, SIGMA_M, COMPATIBLE = 0.5, 48, 1.0, 1.0, 10


def counted(attempts, experiences) -> tuple[np.ndarray, np.ndarray]:
    """Attempts and successes by direction and bin, of one drive in the order of iterations."""
    made, good = np.zeros((2, 2, BINS), int)
    for at, attempt in enumerate(attempts):
        vouched = any(
            other.accepted
            and experiences[k] == experiences[at]
            and 0 < attempt.iteration - other.iteration <= COMPATIBLE
            for k, other in enumerate(attempts)
        )
        if not vouched or attempt.sigma_m > SIGMA_M:
            continue
        offsets = abs(attempt.along_m), abs(attempt.across_m)
        for direction in (0, 1):
            if offsets[1 - direction] <= ASIDE_M:
                place = min(int(offsets[direction] / BIN_M), BINS - 1)
                made[direction, place] += 1
                good[direction, place] += attempt.accepted
    return made, good
