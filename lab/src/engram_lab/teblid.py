"""The kind of features `teblid`: 256 comparisons of boxes, learned, by OpenCV's contrib modules."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.features import FeatureKind, detect_corners
from engram.frontend.frame import DescriptorKind
from engram_lab.opencv_contrib import xfeatures2d

TEBLID = DescriptorKind("teblid")

# OpenCV's TEBLID takes the patch from keypoint size × scale factor; 7 and 5 suit corners without a
# size best.
_TEBLID_SCALE_FACTOR = 5.0
_TEBLID_KEYPOINT_SIZE_PX = 7.0


def describe_teblid(
    image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """TEBLID-256, upright, by OpenCV: descriptors (N, 32) uint8. For arguments see `Describe`.

    Source: Suárez et al., Revisiting Binary Local Image Description for Resource Limited Devices,
    RA-L 2021.
    """
    if not len(pixels):
        return np.empty((0, 32), dtype=np.uint8)
    extra = xfeatures2d("the feature kind teblid")
    engine = extra.TEBLID_create(_TEBLID_SCALE_FACTOR, extra.TEBLID_SIZE_256_BITS)
    keypoints = [
        cv2.KeyPoint(float(u), float(v), _TEBLID_KEYPOINT_SIZE_PX * 2 ** int(octave), 0)
        for (u, v), octave in zip(pixels, octaves, strict=True)
    ]
    kept, descriptors = engine.compute(image, keypoints)
    assert len(kept) == len(keypoints), "TEBLID keeps all points inside the image"
    return np.asarray(descriptors, dtype=np.uint8)


KIND = FeatureKind(
    TEBLID,
    32,
    detect_corners,
    describe_teblid,
    good_at="much as brief; needs OpenCV's contrib modules",
    vocabulary=Path(__file__).parent / "data" / "teblid.safetensors",
)
