"""Pictures of matches and of stereo pairs."""

from __future__ import annotations

import textwrap

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.doctor.examination import align
from engram.frontend.features import match_sides
from engram.frontend.frame import StereoPair

Image = NDArray[np.uint8]

_MATCH_GAP_PX = 8
# Height of a line of text, and width of a wide letter.
_LINE_PX, _LETTER_PX = 20, 9
# Lines over everything hide the images: this many show how they lie to each other.
_MATCH_LINES = 12
# Images that are wider than this times their height lie one above the other.
_WIDE = 1.6
_WHITE = (230, 230, 230)


def match_picture(
    node_image: Image,
    live_image: Image,
    node_pixels: NDArray[np.float32],
    live_pixels: NDArray[np.float32],
    names: tuple[str, str],
) -> Image:
    """Node and live image, named, in the larger one's size; wide ones one above the other.

    Args:
        node_image, live_image: (h, w) and (H, W) uint8 grey; the smaller one is enlarged.
        node_pixels: (K, 2) float32, positions in the node's image as fractions of its width and
            height.
        live_pixels: (K, 2) float32, positions in the live image, px.
        names: of the two images.

    Returns:
        (H', W', 3) uint8 BGR.
    """
    scale = max(1.0, node_image.shape[1] / live_image.shape[1])
    height, width = (round(scale * side) for side in live_image.shape)
    enlarged, live_image = (_resized(one, width, height) for one in (node_image, live_image))
    live_pixels = (live_pixels * scale).astype(np.float32)
    stacked = width > _WIDE * height
    shift = np.array([0, height + _MATCH_GAP_PX] if stacked else [width + _MATCH_GAP_PX, 0])
    canvas = np.zeros((*(np.array([height, width]) + shift[::-1]), 3), dtype=np.uint8)
    canvas[:height, :width] = enlarged[..., None]
    canvas[shift[1] :, shift[0] :] = live_image[..., None]
    ends = np.round(live_pixels).astype(int) + shift
    starts = np.round(node_pixels * (width, height)).astype(int)
    for row in _spread(live_pixels):
        colour = _colour(float(live_pixels[row, 1]) / height)
        cv2.line(canvas, tuple(starts[row]), tuple(ends[row]), colour, 1, cv2.LINE_AA)
    for start, end, live in zip(starts, ends, live_pixels, strict=True):
        colour = _colour(float(live[1]) / height)
        for centre in (start, end):
            cv2.circle(canvas, tuple(centre), 2, colour, -1, cv2.LINE_AA)
    _write_name(canvas, names[0], np.array([0, 0]))
    _write_name(canvas, names[1], shift)
    return canvas


def with_caption(picture: Image, caption: str) -> Image:
    """A picture, (h, w, 3) uint8 BGR, above lines of text."""
    most = max(1, (picture.shape[1] - 12) // _LETTER_PX)
    lines = textwrap.wrap(_drawable(caption), most) or [""]
    below = np.zeros((_LINE_PX * len(lines) + 8, picture.shape[1], 3), dtype=np.uint8)
    for number, line in enumerate(lines, start=1):
        _write(below, line, (6, _LINE_PX * number - 4))
    return np.concatenate([picture, below])


def _resized(image: Image, width: int, height: int) -> Image:
    if image.shape == (height, width):
        return image
    enlarged = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(enlarged, np.uint8)


def _drawable(text: str) -> str:
    """The text in the letters that OpenCV draws."""
    return text.replace("→", "->").replace("°", " deg").encode("ascii", "replace").decode()


def _spread(pixels: NDArray[np.float32]) -> list[int]:
    """A few of the points, far from each other: each the farthest from those before it."""
    if not len(pixels):
        return []
    chosen = [0]
    distance = np.linalg.norm(pixels - pixels[0], axis=1)
    while len(chosen) < min(_MATCH_LINES, len(pixels)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(pixels - pixels[chosen[-1]], axis=1))
    return chosen


def _write_name(canvas: Image, name: str, corner: NDArray[np.int_]) -> None:
    x, y = (int(value) for value in corner)
    shown = _drawable(name)
    cv2.rectangle(canvas, (x, y), (x + 10 + _LETTER_PX * len(shown), y + 20), (0, 0, 0), -1)
    _write(canvas, shown, (x + 5, y + 15))


def _write(canvas: Image, text: str, at: tuple[int, int]) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _WHITE, 1, cv2.LINE_AA)


def _colour(fraction: float) -> tuple[int, int, int]:
    """A hue from top to bottom of the image, so that crossing lines stand out."""
    hue = np.array([[[int(170 * min(max(fraction, 0.0), 1.0)), 220, 255]]], dtype=np.uint8)
    blue, green, red = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0]
    return int(blue), int(green), int(red)


_SHARED_LINES = 40
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
    chosen = np.linspace(0, len(matches) - 1, min(_SHARED_LINES, len(matches))).astype(int)
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
        seen: (h, w) bool, False where the image moves with the camera.
    """
    picture = cv2.cvtColor(pair.left, cv2.COLOR_GRAY2BGR)
    tinted = 0.5 * picture + 0.5 * np.array(_BAD)
    return np.where(seen[..., None], picture, tinted).astype(np.uint8)


_EPIPOLAR_LINES = 16
_PAIR_GAP_PX = 4
_PAIR_CAPTION_PX = 26
# Matched corners that are this far apart in height are no match, px.
_MOST_ROWS_PX = 20.0
# ORB descriptors that differ in more bits are of different points.
_MOST_BITS = 32


def row_offsets_px(pair: StereoPair) -> NDArray[np.float64]:
    """(N,) heights of matched corners in the left image minus those in the right, px.

    Near 0 throughout for a good calibration. Independent of the front-end, which only searches
    along the row.
    """
    orb = cv2.ORB.create(1500)
    (left, left_codes), (right, right_codes) = (
        orb.detectAndCompute(image, None) for image in (pair.left, pair.right)
    )
    if not (len(left) and len(right)):
        return np.zeros(0)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_codes, right_codes)
    offsets = [
        left[match.queryIdx].pt[1] - right[match.trainIdx].pt[1]
        for match in matches
        if match.distance <= _MOST_BITS
    ]
    offsets_m = np.array(offsets, dtype=np.float64)
    return offsets_m[np.abs(offsets_m) <= _MOST_ROWS_PX]


def rectified_picture(pair: StereoPair, caption: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR: left and right image, and the rows that a point of one lies on."""
    height, width = pair.left.shape
    canvas = np.zeros((height + _PAIR_CAPTION_PX, 2 * width + _PAIR_GAP_PX, 3), dtype=np.uint8)
    left = pair.left if pair.mask is None else np.where(pair.mask, pair.left, pair.left // 3)
    canvas[:height, :width] = left[..., None]
    canvas[:height, width + _PAIR_GAP_PX :] = pair.right[..., None]
    for number in range(1, _EPIPOLAR_LINES):
        row = number * height // _EPIPOLAR_LINES
        hue = np.array([[[170 * number // _EPIPOLAR_LINES, 200, 255]]], dtype=np.uint8)
        colour = tuple(int(value) for value in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0])
        cv2.line(canvas, (0, row), (2 * width + _PAIR_GAP_PX, row), colour, 1)
    for text, column in ((f"left   {caption}", 6), ("right", width + _PAIR_GAP_PX + 6)):
        origin = (column, height + _PAIR_CAPTION_PX - 8)
        cv2.putText(
            canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (230, 230, 230), 1, cv2.LINE_AA
        )
    return canvas
