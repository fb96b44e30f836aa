"""The plain twin of `src/core/kernels/patch_network.cpp`: one patch after the other, in int64."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Whole = NDArray[np.int64]

SIDE = 24
ZERO = 128


def describe(
    weights: Mapping[str, NDArray], image: NDArray[np.uint8], pixels: NDArray[np.float32],
    octaves: NDArray[np.uint8],
) -> NDArray[np.uint8]:  # fmt: skip
    """Descriptors (N, bits / 8) of points (N, 2) of an image, each at its octave."""
    rows = [
        bits_of(weights, patch_at(level(image, int(octave)), point, int(octave)))
        for point, octave in zip(pixels, octaves, strict=True)
    ]
    return np.packbits(
        np.array(rows, dtype=bool).reshape(len(rows), len(weights["thresholds"])), axis=1
    )


def level(image: NDArray[np.uint8], octave: int) -> NDArray[np.uint8]:
    for _ in range(octave):
        h, w = (side // 2 * 2 for side in image.shape)
        whole = image[:h, :w].astype(int)
        image = (
            (whole[::2, ::2] + whole[1::2, ::2] + whole[::2, 1::2] + whole[1::2, 1::2] + 2) // 4
        ).astype(np.uint8)
    return image


def patch_at(image: NDArray[np.uint8], point: NDArray[np.float32], octave: int) -> Whole:
    """The 24×24 sums of 2×2 pixels around the pixel nearest to a point; edges are repeated."""
    at = np.rint((point + np.float32(0.5)) / np.float32(2**octave) - np.float32(0.5)).astype(int)
    columns, rows = (np.clip(centre + np.arange(-SIDE, SIDE), 0, side - 1)
                     for centre, side in zip(at, image.shape[::-1], strict=True))  # fmt: skip
    cut = image[np.ix_(rows, columns)].astype(np.int64)
    return cut.reshape(SIDE, 2, SIDE, 2).sum((1, 3))


def normalised(sums: Whole) -> Whole:
    count, total = sums.size, int(sums.sum())
    variance = count * int((sums**2).sum()) - total**2
    divisor = math.isqrt(variance) + 8 * count
    factor, offset = (24 * count << 16) // divisor, (24 * total << 16) // divisor
    return np.clip(ZERO + ((sums * factor - offset + (1 << 15)) >> 16), 0, 255)


def convolved(inputs: Whole, kernel: NDArray[np.int8], padding: int, around: int) -> Whole:
    """Stride 2: inputs (h, w, C) and kernel (O, k, k, C) → sums (h / 2, w / 2, O)."""
    padded = np.pad(
        inputs, ((padding, padding), (padding, padding), (0, 0)), constant_values=around
    )
    side = kernel.shape[1]
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side), axis=(0, 1))[::2, ::2]
    return np.einsum("yxcij,oijc->yxo", windows, kernel.astype(np.int64))


def rescaled(sums: Whole, scaling: NDArray[np.int32], drop: int, shift: int) -> Whole:
    bias, factor = scaling.astype(np.int64).T
    kept = np.clip(sums + bias, 0, 2 ** (drop + 15) - 1) >> drop
    return np.minimum((kept * factor + 2 ** (shift - 1)) >> shift, 255)


def bits_of(weights: Mapping[str, NDArray], sums: Whole) -> NDArray[np.bool_]:
    layer = normalised(sums)[:, :, None]
    for number, name in enumerate(("first", "second", "third")):
        drop, shift = (int(each) for each in weights["shifts"][number])
        padding, around = (2, ZERO) if number == 0 else (1, 0)
        found = convolved(layer, weights[name], padding, around)
        layer = rescaled(found, weights[f"{name}_scaling"], drop, shift)
    outputs = np.einsum("yxc,oyxc->o", layer, weights["linear"].astype(np.int64))
    return outputs > weights["thresholds"]
