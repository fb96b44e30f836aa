"""How the right image of a pair is aligned with the left one, by corners seen in both."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.frontend.sides import SideMatches
from engram.geometry import StereoCamera

Array = NDArray[np.float64]

# Fewest matches that must agree on the alignment of a pair, or of a part of the image.
_LEAST_MATCHES = 20
_LEAST_SHARE = 0.4
_LEAST_CELLS = 3
_AGREE_PX = 1.5
_LEAST_SCATTER_PX = 0.3
_SAMPLES = 200
_FURTHEST_M = 3.0
# Of offset, roll, scale and way forwards; far points alone cannot tell the last two apart.
_DAMPING = np.diag([0.05, 0.05, 0.5, 0.05])
# A match that decides the fit by itself is likelier a wrong one.
_MOST_LEVERAGE = 0.3
_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """How the right image of one pair is aligned with the left one.

    Attributes:
        offset_px: vertical offset, left minus right, at the principal point.
        slope_px: (2,) change of that over the width and the height of the image: roll and scale.
        forward_m: distance forwards from where the left image was taken to where the right one was.
        sigma_m: standard deviation of that.
        agreeing: the matches that agree.
    """

    offset_px: float
    slope_px: tuple[float, float]
    forward_m: float
    sigma_m: float
    agreeing: SideMatches

    @property
    def rms_px(self) -> float:
        """Root of the mean square of the vertical offset over the image."""
        return math.sqrt(self.offset_px**2 + sum(one**2 for one in self.slope_px) / 12)


def align(matches: SideMatches, camera: StereoCamera, seed: int = 0) -> Alignment | None:
    """Fits the vertical offsets of one pair's matches; None if too few agree.

    If the right image is taken t_z further ahead, rays meet where dv = −t_z·(y·d − x·dv)/b, with
    x, y the left pixel from the principal point over f (the epipolar constraint of a translation
    (b, 0, t_z)). An offset, a roll and a scale shift rows, too. The best of random quadruples,
    refined: far points, whose offset says nothing of t_z, are often the majority.
    """
    if len(matches) < _LEAST_MATCHES:
        return None
    across = (matches.pixels[:, 0] - camera.cx) / camera.fx
    down = (matches.pixels[:, 1] - camera.cy) / camera.fy
    disparity, offset = matches.shift.T
    nearness = (down * disparity - across * offset) / camera.baseline_m
    rows = np.column_stack([np.ones_like(across), across, down, -nearness])
    found = _consensus(rows, offset, np.random.default_rng(seed))
    for _ in range(_ROUNDS):
        agree = np.abs(offset - rows @ found) < _AGREE_PX
        if agree.sum() < max(_LEAST_MATCHES, _LEAST_SHARE * len(rows)):
            return None
        normal = rows[agree].T @ rows[agree] + _DAMPING
        agree &= np.sum(rows @ np.linalg.inv(normal) * rows, axis=1) < _MOST_LEVERAGE
        normal = rows[agree].T @ rows[agree] + _DAMPING
        found = np.linalg.solve(normal, rows[agree].T @ offset[agree])
    scatter = max(float(np.std((offset - rows @ found)[agree])), _LEAST_SCATTER_PX)
    sigma = scatter * float(np.sqrt(np.linalg.inv(normal)[3, 3]))
    slope_px = (
        float(found[1]) * camera.width / camera.fx,
        float(found[2]) * camera.height / camera.fy,
    )
    agreeing = SideMatches(matches.pixels[agree], matches.shift[agree])
    return Alignment(float(found[0]), slope_px, float(found[3]), sigma, agreeing)


def _consensus(rows: Array, values: Array, rng: np.random.Generator) -> Array:
    """The solution of one quadruple of rows, or 0, that fits most rows."""
    drawn = rng.integers(0, len(rows), (_SAMPLES, 4))
    sound = np.abs(np.linalg.det(rows[drawn])) > 1e-6
    solved = np.linalg.solve(rows[drawn][sound], values[drawn][sound][..., None])[..., 0]
    tried = np.vstack([solved[np.abs(solved[:, 3]) < _FURTHEST_M], np.zeros(4)])
    misfit = np.minimum(np.abs(values - tried @ rows.T), _AGREE_PX).sum(axis=1)
    best: Array = tried[int(misfit.argmin())]
    return best


def rows_off(samples: list[SideMatches], camera: StereoCamera) -> float | None:
    """Root of the mean square, over a 4×3 grid of the image, of the vertical offset there, px.

    Cells where no offset has a majority of the matches of all pairs do not count; None without
    any.
    """
    pixels = np.concatenate([np.zeros((0, 2)), *(one.pixels for one in samples)])
    offset = np.concatenate([np.zeros(0), *(one.shift[:, 1] for one in samples)])
    cells = (pixels[:, 0] * 4 // camera.width) * 3 + pixels[:, 1] * 3 // camera.height
    means = []
    for cell in np.unique(cells):
        here = offset[cells == cell]
        near = here[np.abs(here - np.median(here)) < _AGREE_PX]
        if len(near) >= max(_LEAST_MATCHES, 0.6 * len(here)):
            means.append(float(near.mean()))
    return float(np.sqrt(np.mean(np.square(means)))) if len(means) >= _LEAST_CELLS else None
