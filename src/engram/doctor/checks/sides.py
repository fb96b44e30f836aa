"""Left and right: which is which, which way up, whether taken at once and in line."""

from __future__ import annotations

import numpy as np

from engram.doctor.examination import Array, Evidence
from engram.doctor.sides import Alignment, SideMatches, align, rows_off

# Pairs whose alignment is worked out: more add nothing.
_ALIGNED = 24
_LEAST_PAIRS = 4
# Disparities below this have no sign.
_NO_DISPARITY_PX = 1.0
# Part of the image, at its top and bottom, whose nearness is compared, and the share of its matches
# that may be nearer: at the top the sky's edge is far, at the bottom all is road.
_PART = 0.3
_FAR_SHARE = 0.1
_LEAST_IN_PART = 40
# A pair shows a way forwards beyond this many standard deviations.
_SIGNIFICANT = 4.0


def negative_share(seen: Evidence) -> float | None:
    """Share of matches that lie further right in the right image."""
    disparity = _agreeing(seen)[:, 0]
    clear = disparity[np.abs(disparity) > _NO_DISPARITY_PX]
    return float((clear < 0).mean()) if len(clear) >= 2 * _LEAST_IN_PART else None


def upright(seen: Evidence) -> float | None:
    """Logarithm of how much nearer the lower part of the image is than the upper one."""
    matches = _agreeing(seen)
    near, rows = np.abs(matches[:, 0]), matches[:, 1]
    top, bottom = near[rows < _PART], near[rows > 1 - _PART]
    if min(len(top), len(bottom)) < _LEAST_IN_PART:
        return None
    far = [float(np.quantile(one, _FAR_SHARE)) + 1.0 for one in (bottom, top)]
    return float(np.log(far[0] / far[1]))


def swapped(seen: Evidence) -> float | None:
    """The share of negative disparities, if the images are not upside down."""
    return _if_upright(seen, negative_share(seen), wanted=True)


def rotated(seen: Evidence) -> float | None:
    """The share of negative disparities, if the images are upside down."""
    return _if_upright(seen, negative_share(seen), wanted=False)


def upside_down(seen: Evidence) -> float | None:
    """How upright the images are, if left and right are in their places."""
    negative = negative_share(seen)
    if negative is None or negative > seen.config.negative_share:
        return None
    return upright(seen)


def forward_m(seen: Evidence) -> float | None:
    """Way between the instants of left and right: the median over pairs that moved."""
    ways = [
        abs(one.forward_m) if abs(one.forward_m) > _SIGNIFICANT * one.sigma_m else 0.0
        for one in _alignments(seen)
    ]
    return float(np.median(ways)) if len(ways) >= _LEAST_PAIRS else None


def row_jump_px(seen: Evidence) -> float | None:
    """Scatter of the vertical offset from pair to pair: a pitch between two instants."""
    offsets = np.array([one.offset_px for one in _alignments(seen)])
    if len(offsets) < _LEAST_PAIRS:
        return None
    return float(np.median(np.abs(offsets - np.median(offsets))))


def row_offset_px(seen: Evidence) -> float | None:
    """Vertical offset that all pairs share; cannot be told of a pair of two instants.

    The larger of what a shift, a roll and a scale explain, and of what lies in parts of the image.
    """
    jump = row_jump_px(seen)
    if seen.camera is None or jump is None or jump > seen.config.row_jump_px:
        return None
    whole = float(np.median([one.rms_px for one in _alignments(seen)]))
    return max(whole, rows_off(_samples(seen), seen.camera) or 0.0)


def _if_upright(seen: Evidence, value: float | None, *, wanted: bool) -> float | None:
    way_up = upright(seen)
    if value is None or way_up is None:
        return value if wanted else None
    return value if (way_up >= 0) is wanted else 0.0


def _samples(seen: Evidence) -> list[SideMatches]:
    return [one for _, one in seen.matches]


def _agreeing(seen: Evidence) -> Array:
    """(M, 2) disparity, px, and row, as a share of the height, of matches that fit their pair."""
    if seen.camera is None:
        return np.zeros((0, 2))
    parts = [np.zeros((0, 2))]
    for aligned, matches in zip(_alignments(seen), seen.aligned, strict=True):
        rows = matches.pixels[aligned.agree, 1] / seen.camera.height
        parts.append(np.column_stack([matches.shift[aligned.agree, 0], rows]))
    return np.concatenate(parts)


def _alignments(seen: Evidence) -> list[Alignment]:
    """Of some pairs, spread over all; worked out once."""
    if seen.camera is None or not seen.matches:
        return []
    if seen.alignments is None:
        at = np.unique(np.linspace(0, len(seen.matches) - 1, _ALIGNED).round().astype(int))
        tried = [(align(seen.matches[k][1], seen.camera, seed=int(k)), k) for k in at]
        seen.aligned = [seen.matches[k][1] for one, k in tried if one is not None]
        seen.alignments = [one for one, _ in tried if one is not None]
    return seen.alignments
