"""A kind of features: Engram's corners, described in a blurred image."""

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend import DescriptorKind, FeatureKind
from engram.frontend.features import describe_brief, detect_corners


def describe_coarse(
    image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """(N, 32) uint8: BRIEF of the blurred image."""
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8)
    return describe_brief(blurred, pixels, octaves)


COARSE = FeatureKind(
    DescriptorKind("coarse"), 32, detect_corners, describe_coarse, good_at="noisy images"
)
