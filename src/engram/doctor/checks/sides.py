"""Left and right: which is which, which way up, whether taken at once and in line."""

from __future__ import annotations

from itertools import compress

import numpy as np
from numpy.typing import NDArray

from engram.doctor.examination import Array, Evidence
from engram.doctor.sides import Alignment, align, rows_off
from engram.geometry import SE3

# Pairs whose alignment is worked out: more add nothing.
_ALIGNED = 24
_LEAST_PAIRS = 4
# Disparities below this have no sign.
_NO_DISPARITY_PX = 1.0
# The scene reaches as far up, or down, as this share of the matches there; and the fewest of them.
_REACH = 0.9
_LEAST_REACHING = 20
_LEAST_CLEAR = 80
# Most frames that a side may be late, by how much the sides' changes then correlate better than
# at once, and the fewest steps of a moving robot that tell.
_MOST_LATE = 5
_CLEARER = 0.25
_LEAST_STEPS = 15
_AT_REST_M = 0.02
# Added to the spread of the rows, grey levels: in the dark there is only noise.
_LEAST_SPREAD = 1.0
# A pair shows a way forwards beyond this many standard deviations.
_SIGNIFICANT = 4.0


def negative_share(seen: Evidence) -> float | None:
    """Share of matches that lie further right in the right image."""
    disparity = _agreeing(seen)[:, 0]
    clear = disparity[np.abs(disparity) > _NO_DISPARITY_PX]
    return float((clear < 0).mean()) if len(clear) >= _LEAST_CLEAR else None


def upright(seen: Evidence) -> float | None:
    """Logarithm of how much further up than down the scene reaches, from the camera's axis.

    The ground ends it below, in all light; above nothing does.
    """
    disparity, down = _agreeing(seen).T
    # In baselines; far things count less, as their distance is uncertain.
    reach = down / (np.abs(disparity) + _NO_DISPARITY_PX)
    above, below = -reach[down < 0], reach[down > 0]
    if min(len(above), len(below)) < _LEAST_REACHING:
        return None
    return float(np.log(np.quantile(above, _REACH) / np.quantile(below, _REACH)))


def swapped(seen: Evidence) -> float | None:
    """The share of negative disparities, if the images are not upside down."""
    return 0.0 if (upright(seen) or 0) < 0 else negative_share(seen)


def rotated(seen: Evidence) -> float | None:
    """The share of negative disparities, if the images are upside down."""
    return negative_share(seen) if (upright(seen) or 0) < 0 else 0.0


def upside_down(seen: Evidence) -> float | None:
    """How upright the images are, if left and right are in their places."""
    negative = negative_share(seen)
    if negative is None or negative > seen.config.negative_share:
        return None
    return upright(seen)


def frames_late(seen: Evidence) -> float | None:
    """Frames by which one side shows what the other has shown before; 0 if both are at once.

    What a robot that drives sees in a row of the image changes in both sides alike, whatever the
    disparities: the changes correlate best at the lag between the sides. In rain and in the dark,
    too, where few corners match. Not at rest, nor while a camera looks sideways: there one side
    comes to where the other was a moment before.
    """
    if not seen.looks or len(seen.looks) != len(seen):
        return None
    rests = seen.moved_m < _AT_REST_M
    if sum(map(_aside, compress(seen.moved, ~rests))) > 0.5 * np.count_nonzero(~rests):
        return None
    change = np.diff([_unexposed(one.rows) for one in seen.looks], axis=0)
    change[np.array(seen.first[1:], np.bool_) | rests[1:]] = 0
    if np.count_nonzero(change.any(axis=(1, 2))) < _LEAST_STEPS:
        return None
    left, right = change.swapaxes(0, 1)
    late = [_alike(left, right, lag) for lag in range(_MOST_LATE + 1)]
    early = [_alike(right, left, lag) for lag in range(_MOST_LATE + 1)]
    alike = np.maximum(late, early)
    return float(alike.argmax()) if alike.max() > max(alike[0], 0) + _CLEARER else 0.0


def forward_m(seen: Evidence) -> float | None:
    """Distance between the instants of left and right: the median over pairs that moved."""
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
    """Vertical offset shared by all pairs; undetermined if pairs were taken at two instants.

    The larger of what a shift, a roll and a scale explain, and of what lies in parts of the image.
    """
    jump = row_jump_px(seen)
    if seen.camera is None or jump is None or jump > seen.config.row_jump_px:
        return None
    whole = float(np.median([one.rms_px for one in _alignments(seen)]))
    return max(whole, rows_off([one for _, one in seen.matches], seen.camera) or 0.0)


def _aside(moved: SE3 | None) -> bool:
    return moved is not None and bool(abs(moved.translation[0]) > abs(moved.translation[2]))


def _unexposed(rows: NDArray[np.float32]) -> Array:
    """Rows (2, R) of each side free of its exposure, which may change on its own."""
    spread = rows.std(axis=1, keepdims=True)
    return np.asarray((rows - rows.mean(axis=1, keepdims=True)) / (spread + _LEAST_SPREAD))


def _alike(ahead: Array, behind: Array, lag: int) -> float:
    """Correlation of the changes of one side with those of the other some frames later."""
    ahead, behind = ahead[: len(ahead) - lag], behind[lag:]
    size = float(np.linalg.norm(ahead) * np.linalg.norm(behind))
    return float((ahead * behind).sum()) / max(size, 1e-9)


def _agreeing(seen: Evidence) -> Array:
    """(M, 2) px: disparity and rows below the principal point, of matches that fit their pair."""
    middle = 0.0 if seen.camera is None else seen.camera.cy
    parts = [one.agreeing for one in _alignments(seen)]
    both = [np.column_stack([one.shift[:, 0], one.pixels[:, 1] - middle]) for one in parts]
    return np.concatenate([np.zeros((0, 2)), *both])


def _alignments(seen: Evidence) -> list[Alignment]:
    """Of some pairs, spread over all; worked out once."""
    if seen.camera is None or not seen.matches:
        return []
    if seen.alignments is None:
        at = np.unique(np.linspace(0, len(seen.matches) - 1, _ALIGNED).round().astype(int))
        tried = [align(seen.matches[k][1], seen.camera, seed=int(k)) for k in at]
        seen.alignments = [one for one in tried if one is not None]
    return seen.alignments
