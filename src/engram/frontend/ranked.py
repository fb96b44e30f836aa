"""Landmarks in the order in which the front-end chooses them (method §2.1–2.3).

A frame has as many landmarks as its settings say. A frame log of a rendered drive keeps more of
them with their ranks, so that other numbers can be tried without images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.frontend.blobs import quantised_landmarks
from engram.frontend.features import Keypoints, detect_corners, feature_kind, has_our_corners
from engram.frontend.frame import Landmarks, StereoPair
from engram.frontend.frontend import (
    FrontendConfig,
    clear_of_body,
    look_of,
    rows_of,
    without_body,
)


@dataclass(frozen=True, slots=True, eq=False)
class RankedLandmarks:
    """Landmarks of a pair, and how early each was chosen.

    Attributes:
        landmarks: N, in the order of a frame's.
        ranks: (N,) uint16, distinct; the front-end's choice of n are those of a rank below n.
    """

    landmarks: Landmarks
    ranks: NDArray[np.uint16]

    def first(self, count: int) -> Landmarks:
        """The front-end's choice of so many, equal to the bit to extracting them."""
        return self._where(self.ranks < count)

    def further(self, own: int, count: int) -> Landmarks:
        """Those that it chooses after its first `own`, up to `count` in all."""
        return self._where((self.ranks < count) & ~self._own(self.ranks, own))

    def parted(self, count: int) -> tuple[Landmarks, Landmarks]:
        """The `count` landmarks that were chosen first, and the others."""
        own = self._own(self.ranks, count)
        return self._where(own), self._where(~own)

    @staticmethod
    def joined(own: Landmarks, more: Landmarks, ranks: NDArray[np.uint16]) -> RankedLandmarks:
        """Undo `parted`.

        Args:
            ranks: (N,) uint16, of all N in the order of a frame's.

        Raises:
            ValueError: the ranks are of other numbers of landmarks.
        """
        if len(ranks) != len(own) + len(more):
            raise ValueError(
                f"{len(ranks)} ranks are not of {len(own)} landmarks and {len(more)} more"
            )
        is_own = RankedLandmarks._own(ranks, len(own))
        order = np.argsort(np.concatenate([np.flatnonzero(is_own), np.flatnonzero(~is_own)]))
        columns = (
            np.concatenate([getattr(own, name), getattr(more, name)])[order]
            for name in Landmarks.__slots__
        )
        return RankedLandmarks(Landmarks(*columns), ranks)

    @staticmethod
    def _own(ranks: NDArray[np.uint16], count: int) -> NDArray[np.bool_]:
        """Which have the `count` smallest ranks."""
        own = np.zeros(len(ranks), dtype=bool)
        own[np.argsort(ranks)[:count]] = True
        return own

    def _where(self, rows: NDArray[np.bool_]) -> Landmarks:
        return self.landmarks.rows(rows)


def ranked_landmarks(pair: StereoPair, config: FrontendConfig, most: int) -> RankedLandmarks | None:
    """As many landmarks of a pair as there are, up to `most`; None for a kind with own corners.

    Whether a second look is taken is decided by the number of the settings, whatever `most` is.
    """
    kind = feature_kind(config.descriptor)
    if not has_our_corners(kind):
        return None
    pair = without_body(pair)
    own = config.landmarks_for(pair.left.size)
    look = look_of(pair, config)
    found = detect_corners(pair, look.config, max(most, own))
    counted = replace(config, fast_threshold=look.threshold)
    ranks = _ranks(pair.left, found, counted, max(most, own))
    kept = found
    if pair.mask is not None:
        kept = clear_of_body(found, pair.mask)
        ranks = ranks[rows_of(kept, found)]
    landmarks = quantised_landmarks(
        kept.pixels,
        kept.disparity_px,
        kept.sigma_px,
        kind.describe(pair.left, kept.pixels, kept.octaves),
        kept.octaves,
        pair.camera,
    )
    return RankedLandmarks(landmarks, ranks)


def _ranks(
    image: NDArray[np.uint8], found: Keypoints, config: FrontendConfig, most: int
) -> NDArray[np.uint16]:
    """The number of landmarks that each of them takes to be chosen, less one.

    Octave by octave corners are tried in the order of `order_corners`; what an octave leaves of its
    share, 1 : 1/2 : 1/4 …, goes to the next. So each further landmark adds one to one octave.
    """
    ranks = np.zeros(len(found.pixels), dtype=np.uint16)
    numbers = np.arange(most + 1)
    all_shares, taken = (1 << config.octaves) - 1, np.zeros(most + 1, dtype=np.int64)
    level = image
    for octave in range(config.octaves):
        if octave:
            level = _core.halve(level)
        rows = np.flatnonzero(found.octaves == octave)
        so_far = all_shares - ((1 << (config.octaves - 1 - octave)) - 1)
        counts = np.minimum(numbers * so_far // all_shares - taken, len(rows))
        taken += counts
        chosen = rows[np.argsort(_turns(level, found.pixels[rows], octave, config))]
        ranks[chosen] = np.searchsorted(counts, np.arange(1, len(rows) + 1)) - 1
    return ranks


def _turns(
    level: NDArray[np.uint8], pixels: NDArray[np.float32], octave: int, config: FrontendConfig
) -> NDArray[np.intp]:
    """When the corners at pixels (N, 2) of the full-size image are tried in their octave."""
    positions, scores, _ = _core.detect_corners(level, config.fast_threshold)
    height, width = level.shape
    order = _core.order_corners(positions, scores, width, height, config.cell_px)
    turn_at = np.full(level.shape, -1, dtype=np.intp)
    columns, rows = positions[order].T
    turn_at[rows, columns] = np.arange(len(order))
    # Refined by less than half a pixel of the level.
    columns, rows = np.rint((pixels + 0.5) / 2**octave - 0.5).astype(np.intp).T
    return np.asarray(turn_at[rows, columns])
