"""A match as a picture: node and live image at full size, inliers as points, some joined."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_GAP_PX = 8
_CAPTION_PX = 28
# Lines over everything hide the images: this many show how they lie to each other.
_LINES = 12
# Images that are wider than this times their height lie one above the other.
_WIDE = 1.6
_WHITE = (230, 230, 230)


def match_picture(
    node_image: Image,
    live_image: Image,
    node_pixels: NDArray[np.float32],
    live_pixels: NDArray[np.float32],
    caption: str,
) -> Image:
    """Node and live image, named, in the live image's size; wide ones one above the other.

    Args:
        node_image: (h, w) uint8 grey, any size; enlarged to that of the live image.
        live_image: (H, W) uint8 grey.
        node_pixels: (K, 2) float32, positions in the node's image as fractions of its width and
            height.
        live_pixels: (K, 2) float32, positions in the live image, px.
        caption: text below the images.

    Returns:
        (H', W', 3) uint8 BGR.
    """
    height, width = live_image.shape
    enlarged = cv2.resize(node_image, (width, height), interpolation=cv2.INTER_CUBIC)
    stacked = width > _WIDE * height
    shift = np.array([0, height + _GAP_PX] if stacked else [width + _GAP_PX, 0])
    canvas = np.zeros((*(np.array([height, width]) + shift[::-1]), 3), dtype=np.uint8)
    canvas[:height, :width] = enlarged[..., None]
    canvas[shift[1] :, shift[0] :] = live_image[..., None]
    ends = np.round(live_pixels).astype(int) + shift
    starts = np.round(node_pixels * (width, height)).astype(int)
    for one in _spread(live_pixels):
        colour = _colour(float(live_pixels[one, 1]) / height)
        cv2.line(canvas, tuple(starts[one]), tuple(ends[one]), colour, 1, cv2.LINE_AA)
    for start, end, live in zip(starts, ends, live_pixels, strict=True):
        colour = _colour(float(live[1]) / height)
        for centre in (start, end):
            cv2.circle(canvas, tuple(centre), 2, colour, -1, cv2.LINE_AA)
    _name(canvas, "node", np.array([0, 0]))
    _name(canvas, "live", shift)
    below = np.zeros((_CAPTION_PX, canvas.shape[1], 3), dtype=np.uint8)
    _write(below, caption, (6, _CAPTION_PX - 9))
    return np.concatenate([canvas, below])


def _spread(pixels: NDArray[np.float32]) -> list[int]:
    """A few of the points, far from each other: each the farthest from those before it."""
    if not len(pixels):
        return []
    chosen = [0]
    distance = np.linalg.norm(pixels - pixels[0], axis=1)
    while len(chosen) < min(_LINES, len(pixels)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(pixels - pixels[chosen[-1]], axis=1))
    return chosen


def _name(canvas: Image, name: str, corner: NDArray[np.int_]) -> None:
    x, y = (int(one) for one in corner)
    cv2.rectangle(canvas, (x, y), (x + 46, y + 20), (0, 0, 0), -1)
    _write(canvas, name, (x + 5, y + 15))


def _write(canvas: Image, text: str, at: tuple[int, int]) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _WHITE, 1, cv2.LINE_AA)


def _colour(fraction: float) -> tuple[int, int, int]:
    """A hue from top to bottom of the image, so that crossing lines stand out."""
    hue = np.array([[[int(170 * min(max(fraction, 0.0), 1.0)), 220, 255]]], dtype=np.uint8)
    blue, green, red = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0]
    return int(blue), int(green), int(red)
