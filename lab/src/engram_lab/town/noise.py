"""Random fields that tile, from which all textures are cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]

SIDE = 1024  # texels of a field; far larger than what is cut from it, so that cuts differ


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFields:
    """Tiling fields of mean 0 and variance 1, each (SIDE, SIDE) float32.

    Attributes:
        rough: all scales, like weathered plaster.
        soft: only scales beyond about 12 texels, like stains.
        grain: white noise, band-limited to about 4 texels so that it does not beat with pixels.
    """

    rough: Field
    soft: Field
    grain: Field

    @staticmethod
    def of_seed(seed: int) -> NoiseFields:
        """The fields of a town."""
        rng = np.random.default_rng([seed, 0x6E6F])
        return NoiseFields(
            rough=_coloured(rng, exponent=1.15, low_pass=0.45),
            soft=_coloured(rng, exponent=1.6, low_pass=0.04),
            grain=_coloured(rng, exponent=0.0, low_pass=0.28),
        )

    def cut(self, field: Field, rng: np.random.Generator, shape: tuple[int, int]) -> Field:
        """A random window (h, w), perhaps mirrored; wraps where it is larger than the field."""
        top, left = rng.integers(0, SIDE, 2)
        rows = (top + np.arange(shape[0])) % SIDE
        columns = (left + np.arange(shape[1])) % SIDE
        window = field[rows[:, None], columns[None, :]]
        if rng.random() < 0.5:
            window = window[:, ::-1]
        return np.ascontiguousarray(window)

    def tile(self) -> NDArray[np.uint8]:
        """A (256, 256) uint8 tile with a level distribution, for clouds, snow and puddles."""
        rng = np.random.default_rng(7)
        field = _coloured(rng, exponent=1.8, low_pass=0.25, side=256)
        ranks = np.empty(field.size, dtype=np.float64)
        ranks[np.argsort(field, axis=None, kind="stable")] = np.linspace(0, 255, field.size)
        return ranks.reshape(field.shape).astype(np.uint8)


def _coloured(
    rng: np.random.Generator, exponent: float, low_pass: float, side: int = SIDE
) -> Field:
    """Noise of spectrum 1/f^exponent in amplitude, cut off smoothly at low_pass cycles a texel."""
    white = np.fft.rfft2(rng.standard_normal((side, side)))
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])
    # Below 3 cycles a field nothing, so that a cut's mean says nothing about its place.
    gain = np.where(frequency > 3 / side, np.maximum(frequency, 1 / side) ** -exponent, 0)
    gain *= np.exp(-((frequency / low_pass) ** 4))
    field = np.fft.irfft2(white * gain, s=(side, side))
    return np.asarray(field / field.std(), dtype=np.float32)
