"""Leaves the robot's own body out: no corner on it or at its edge reaches any later stage."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.features import Keypoints
from engram.frontend.frame import StereoPair

# Corners this close to the body, px of their octave, are its outline or lie behind it: FAST looks 3
# px around a corner, and the stereo window reaches 5.
_MARGIN_PX = 5


def without_body(pair: StereoPair) -> StereoPair:
    """The pair with the body painted over in the left image, so that it gives no corners.

    The body would otherwise fill the cells of the corner grid next to it. The paint is the mean of
    what is seen, which makes the weakest edge.
    """
    if pair.mask is None:
        return pair
    left = pair.left.copy()
    left[~pair.mask] = int(pair.left[pair.mask].mean())
    return replace(pair, left=left)


def clear_of_body(found: Keypoints, mask: NDArray[np.bool_]) -> Keypoints:
    """The corners that are clear of the body.

    Args:
        found: N corners.
        mask: (height, width) bool, False on the body.
    """
    clear_px = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    columns, rows = np.rint(found.pixels).astype(np.intp).T
    height, width = mask.shape
    at = clear_px[rows.clip(0, height - 1), columns.clip(0, width - 1)]
    clear = at > _MARGIN_PX * 2.0**found.octaves
    return replace(
        found,
        pixels=found.pixels[clear],
        disparity_px=found.disparity_px[clear],
        sigma_px=found.sigma_px[clear],
        descriptors=None if found.descriptors is None else found.descriptors[clear],
        octaves=found.octaves[clear],
    )
