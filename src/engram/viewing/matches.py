"""A match as a picture: node and live image side by side, inliers joined by lines."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_GAP_PX = 8
_CAPTION_PX = 28


def match_picture(
    node_image: Image,
    live_image: Image,
    node_pixels: NDArray[np.float32],
    live_pixels: NDArray[np.float32],
    caption: str,
) -> Image:
    """Node (left) and live image (right), one line per inlier.

    Args:
        node_image: (h, w) uint8 grey, any size; enlarged to the live image's height.
        live_image: (H, W) uint8 grey.
        node_pixels: (K, 2) float32, positions in the node's image as fractions of its width and
            height.
        live_pixels: (K, 2) float32, positions in the live image, px.
        caption: text below the images.

    Returns:
        (H', W', 3) uint8 BGR.
    """
    height, width = live_image.shape
    node_width = round(height * node_image.shape[1] / node_image.shape[0])
    enlarged = cv2.resize(node_image, (node_width, height), interpolation=cv2.INTER_CUBIC)
    canvas = np.zeros((height + _CAPTION_PX, node_width + _GAP_PX + width, 3), dtype=np.uint8)
    canvas[:height, :node_width] = enlarged[..., None]
    canvas[:height, node_width + _GAP_PX :] = live_image[..., None]
    for (u, v), live in zip(node_pixels, live_pixels, strict=True):
        start = (round(float(u) * node_width), round(float(v) * height))
        end = (node_width + _GAP_PX + round(float(live[0])), round(float(live[1])))
        colour = _colour(float(live[1]) / height)
        cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, start, 3, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, end, 3, colour, 1, cv2.LINE_AA)
    origin = (6, height + _CAPTION_PX - 9)
    cv2.putText(
        canvas, caption, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (230, 230, 230), 1, cv2.LINE_AA
    )
    return canvas


def _colour(fraction: float) -> tuple[int, int, int]:
    """A hue from top to bottom of the image, so that crossing lines stand out."""
    hue = np.array([[[int(170 * min(max(fraction, 0.0), 1.0)), 220, 255]]], dtype=np.uint8)
    blue, green, red = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0]
    return int(blue), int(green), int(red)
