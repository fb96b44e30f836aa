"""The binary descriptors that landmarks can have, behind one table."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.frontend.frame import DescriptorKind

# OpenCV's TEBLID takes the patch from keypoint size × scale factor; 7 and 5 were measured best for
# corners that have no size of their own.
_TEBLID_SCALE_FACTOR = 5.0
_TEBLID_KEYPOINT_SIZE_PX = 7.0


class Describe(Protocol):
    """Describes points of an image."""

    def __call__(
        self, image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """Descriptors (N, 32) uint8.

        Args:
            image: (h, w) uint8 grey.
            pixels: (N, 2) float32 u, v, px of the full-size image.
            octaves: (N,) uint8, the pyramid level at which each point was found; each level is
                half the size of the one before.
        """
        ...


def describe_brief(
    image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """BRIEF-256, upright; `_core.extract` computes the same in passing.

    Source: Calonder et al., ECCV 2010. Pattern: `src/core/kernels/brief_pattern.inc`.
    """
    descriptors = np.empty((len(pixels), 32), dtype=np.uint8)
    level = image
    for octave in range(int(octaves.max(initial=0)) + 1):
        if octave:
            level = _core.halve(level)
        here = octaves == octave
        positions = np.rint((pixels[here] + 0.5) / 2**octave - 0.5).astype(np.int16)
        descriptors[here] = _core.describe(_core.smooth(level), positions)
    return descriptors


def describe_teblid(
    image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """TEBLID-256, upright, by OpenCV.

    Source: Suárez et al., Revisiting Binary Local Image Description for Resource Limited Devices,
    RA-L 2021.
    """
    import cv2

    if not len(pixels):
        return np.empty((0, 32), dtype=np.uint8)
    extra: Any = cv2.xfeatures2d  # OpenCV's stubs leave TEBLID out
    engine = extra.TEBLID_create(_TEBLID_SCALE_FACTOR, extra.TEBLID_SIZE_256_BITS)
    keypoints = [
        cv2.KeyPoint(float(u), float(v), _TEBLID_KEYPOINT_SIZE_PX * 2 ** int(octave), 0)
        for (u, v), octave in zip(pixels, octaves, strict=True)
    ]
    kept, descriptors = engine.compute(image, keypoints)
    assert len(kept) == len(keypoints), "TEBLID keeps all points inside the image"
    return np.asarray(descriptors, dtype=np.uint8)


DESCRIPTORS: dict[DescriptorKind, Describe] = {
    DescriptorKind.BRIEF: describe_brief,
    DescriptorKind.TEBLID: describe_teblid,
}
