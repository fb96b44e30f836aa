"""A stereo pair as a picture: what both sides share, and what moves with the camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.doctor.sides import align
from engram.frontend import StereoPair
from engram.frontend.sides import match_sides

_LINES = 40
# Matches whose rows differ by more than this, or that lie further right in the right image.
_OFF_PX = 1.5
_GOOD, _BAD = (120, 220, 120), (70, 70, 255)


def side_picture(pair: StereoPair) -> NDArray[np.uint8]:
    """Left above right, (2h, w, 3) uint8 BGR; lines join what both show, red if that is wrong.

    Matches that contradict the pair's alignment are left out, as the doctor leaves them out.
    """
    matches, height = match_sides(pair), pair.camera.height
    aligned = align(matches, pair.camera)
    matches = matches if aligned is None else aligned.agreeing
    both = np.concatenate([pair.left, pair.right])
    picture = cv2.cvtColor(both, cv2.COLOR_GRAY2BGR)
    chosen = np.linspace(0, len(matches) - 1, min(_LINES, len(matches))).astype(int)
    for k in chosen.tolist():
        pixel, shift = matches.pixels[k], matches.shift[k]
        bad = abs(shift[1]) > _OFF_PX or shift[0] < -_OFF_PX
        right = pixel - shift + [0, height]
        colour = _BAD if bad else _GOOD
        ends = [tuple(int(value) for value in np.rint(end)) for end in (pixel, right)]
        cv2.line(picture, ends[0], ends[1], colour, 1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def fixed_picture(pair: StereoPair, seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The left image, (h, w, 3) uint8 BGR, red where it moves with the camera.

    Args:
        pair: the images.
        seen: (h, w) bool, False where the image moves with the camera.
    """
    picture = cv2.cvtColor(pair.left, cv2.COLOR_GRAY2BGR)
    tinted = 0.5 * picture + 0.5 * np.array(_BAD)
    return np.where(seen[..., None], picture, tinted).astype(np.uint8)
