"""Landmarks as small integers, and back without loss.

The front-end quantises its measurements before any further use, so a frame read back from a log or
a map equals the original bit for bit. A landmark's position takes 7 bytes: u, v and disparity as
uint16 multiples of the pixel quantum, the standard deviation of the disparity as a logarithmic
uint8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import InputError
from engram.frontend.frame import Landmarks
from engram.geometry import StereoCamera

# The best disparities have a standard deviation of 0.05 px: finer than 1/64 px gains nothing.
FINEST_QUANTUM_LOG2 = 6
_LARGEST_CODE = 65535

# σ code c means 2^(c/32 - 6) px: from 1/64 px to 3.9 px in steps of 2.2 %.
SIGMA_TABLE_PX = np.exp2(np.arange(256) / 32 - 6).astype(np.float32)
SIGMA_TABLE_PX.setflags(write=False)
# A value gets the code nearest in logarithm: the borders are geometric means.
_SIGMA_BORDERS_PX = np.exp2((np.arange(255) + 0.5) / 32 - 6).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkCodes:
    """The stored positions of landmarks: a struct of arrays, one row per landmark.

    Attributes:
        pixels: (N, 2) uint16, left u, v in pixel quanta.
        disparity: (N,) uint16, in pixel quanta, ≥ 1.
        sigma: (N,) uint8, index into `SIGMA_TABLE_PX`.
    """

    pixels: NDArray[np.uint16]
    disparity: NDArray[np.uint16]
    sigma: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.pixels)


def pixel_quantum(width: int, height: int = 1) -> float:
    """Step of stored pixels and disparities for an image of this size, px.

    The smallest power of two, at least 1/64, for which the longer side fits into 16 bits.

    Raises:
        InputError: a side is not positive or longer than 65535 px.
    """
    side = max(width, height)
    if min(width, height) < 1 or side > _LARGEST_CODE:
        raise InputError(f"image size {width}×{height} px: each side must be 1 to {_LARGEST_CODE}")
    steps_log2 = min(FINEST_QUANTUM_LOG2, (_LARGEST_CODE // side).bit_length() - 1)
    return float(2.0**-steps_log2)


def quantise(
    pixels: NDArray[np.float32],
    disparity_px: NDArray[np.float32],
    disparity_sigma_px: NDArray[np.float32],
    quantum_px: float,
) -> LandmarkCodes:
    """Round landmarks to the nearest codes.

    Args:
        pixels: (N, 2) float32, left u, v, px, ≥ 0.
        disparity_px: (N,) float32, px, > 0; values that round to zero become one quantum.
        disparity_sigma_px: (N,) float32, px, > 0; limited to the range of `SIGMA_TABLE_PX`.
        quantum_px: `pixel_quantum` of the image.

    Raises:
        InputError: a pixel or disparity is not finite, negative or too large for 16 bits.
    """
    steps_per_px = np.float32(1 / quantum_px)  # a power of two: the product is exact
    pixel_steps = np.rint(pixels * steps_per_px)
    disparity_steps = np.maximum(np.rint(disparity_px * steps_per_px), 1)
    for name, steps in (("pixel", pixel_steps), ("disparity", disparity_steps)):
        if steps.size and not (steps.min() >= 0 and steps.max() <= _LARGEST_CODE):
            raise InputError(
                f"a {name} lies outside 0 to {_LARGEST_CODE * quantum_px} px "
                f"(found {steps.min() * quantum_px} to {steps.max() * quantum_px})"
            )
    return LandmarkCodes(
        pixel_steps.astype(np.uint16),
        disparity_steps.astype(np.uint16),
        np.searchsorted(_SIGMA_BORDERS_PX, disparity_sigma_px).astype(np.uint8),
    )


def dequantise(
    codes: LandmarkCodes, quantum_px: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Pixels (N, 2), disparities (N,) and their σ (N,), all float32 px.

    `quantise` of the result gives the same codes.
    """
    step = np.float32(quantum_px)
    return codes.pixels * step, codes.disparity * step, SIGMA_TABLE_PX[codes.sigma]


def quantised_landmarks(
    pixels: NDArray[np.float32],
    disparity_px: NDArray[np.float32],
    disparity_sigma_px: NDArray[np.float32],
    descriptors: NDArray[np.uint8],
    octaves: NDArray[np.uint8],
    camera: StereoCamera,
) -> Landmarks:
    """N landmarks as they will be stored: `quantise`, then `landmarks_from_codes`, in one call.

    Args:
        pixels: (N, 2) float32, px (x, y) in the left image, from any detector.
        disparity_px, disparity_sigma_px: (N,) float32, px.
        descriptors: (N, B) uint8.
        octaves: (N,) uint8.
        camera: the camera that saw them.

    Raises:
        InputError: a pixel or disparity is not finite, negative or too large for 16 bits.
    """
    quantum_px = pixel_quantum(camera.width, camera.height)
    quantised = _core.quantise_landmarks(
        pixels,
        disparity_px,
        disparity_sigma_px,
        quantum_px,
        SIGMA_TABLE_PX,
        _SIGMA_BORDERS_PX,
        (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m),
    )
    if quantised is None:  # it is said which
        codes = quantise(pixels, disparity_px, disparity_sigma_px, quantum_px)
        return landmarks_from_codes(codes, descriptors, octaves, camera)
    return Landmarks(*quantised, descriptors, octaves)


def landmarks_from_codes(
    codes: LandmarkCodes,
    descriptors: NDArray[np.uint8],
    octaves: NDArray[np.uint8],
    camera: StereoCamera,
) -> Landmarks:
    """N landmarks from their stored codes; all landmarks are made here.

    Args:
        codes: positions of N landmarks, in quanta of the camera's image.
        descriptors: (N, B) uint8.
        octaves: (N,) uint8.
        camera: the camera that saw them; gives the quantum and the points.
    """
    quantum_px = pixel_quantum(camera.width, camera.height)
    pixels, disparity_px, sigma_px = dequantise(codes, quantum_px)
    points = camera.triangulate(pixels, disparity_px)
    return Landmarks(pixels, disparity_px, sigma_px, points, descriptors, octaves)
