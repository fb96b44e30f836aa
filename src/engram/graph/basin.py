"""The match basin, and the error of a chain of edges.

Uncertainty of a chain of edges: a 6×6 covariance reduced to moments that add up along a chain. The
error of a transform is modelled as a small rotation, of variance v about any axis, about a *pivot*,
and a small translation of variance τ along any axis. At a point p it gives

    variance(p) = τ + v·|p − pivot|²        (m² along the worst axis)

so that the errors of a chain add as moments: Στ, Σv, Σv·pivot, Σv·|pivot|². The pivot is essential:
a heading error made 100 m ago moves everything since, and does so again on the next metre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.errors import InputError
from engram.geometry.se3 import SE3, skew

Array = NDArray[np.float64]

BIN_M = 0.5
BIN_COUNT = 48  # up to 24 m
BASIN_LEVEL = 0.6
DEFAULT_RADIUS_M = 8.0

# Attempts count for one direction if their offset in the other, and the uncertainty of their
# prediction, are below this: half a metre aside costs nothing.
_ASIDE_M = 1.0
_GREATEST_SIGMA_M = 1.0
# An experience is compatible if it was matched within the last 5 m: ten iterations of 0.5 m each.
_COMPATIBLE_ITERATIONS = 10


@dataclass(frozen=True, slots=True)
class BasinConfig:
    """The prior of the match basin. Source: `lab/reports/constants.md`."""

    prior_attempts: Annotated[
        float,
        Meta(
            gt=0,
            description="weight of the prior in attempts per bin: a few dozen real attempts "
            "outweigh it",
        ),
    ] = 10.0
    success_at_zero: Annotated[
        float,
        Meta(gt=BASIN_LEVEL, lt=1, description="success rate at zero offset, similar appearance"),
    ] = 0.97
    softness: Annotated[
        float, Meta(gt=0, description="steepness of the prior, as a share of the basin")
    ] = 0.28

    def __post_init__(self) -> None:
        check_bounds(self)


@lru_cache(maxsize=64)
def prior_basin_m(focal_px: float) -> float:
    """Shipped prior of the basin, a power law: 2 m for f = 256 px, 8 m for 707 px (method §3.1).

    Raises:
        InputError: the focal length is not finite and positive.
    """
    if not (np.isfinite(focal_px) and focal_px > 0):
        raise InputError(f"focal length is {focal_px} px, must be finite and > 0")
    return float(2.0 * (focal_px / 256.0) ** (np.log(4.0) / np.log(707.0 / 256.0)))


@dataclass(frozen=True, slots=True, eq=False)
class BasinCounts:
    """Remembered attempts by distance, from which match basins are learnt.

    Attributes:
        attempts: (2, BIN_COUNT) int64; row 0 along the viewing direction, row 1 across; bin k
            holds offsets from ``k`` to ``k + 1`` times `BIN_M`, the last bin all larger ones.
        successes: (2, BIN_COUNT) int64, accepted attempts.
    """

    attempts: NDArray[np.int64]
    successes: NDArray[np.int64]

    @staticmethod
    def empty() -> BasinCounts:
        """No attempts yet."""
        zeros = np.zeros((2, BIN_COUNT), dtype=np.int64)
        return BasinCounts(zeros, zeros)

    def __add__(self, other: BasinCounts) -> BasinCounts:
        """Those of other drives counted, too."""
        return BasinCounts(self.attempts + other.attempts, self.successes + other.successes)

    def __sub__(self, other: BasinCounts) -> BasinCounts:
        """Without those of some of the drives."""
        return BasinCounts(self.attempts - other.attempts, self.successes - other.successes)


@dataclass(frozen=True, slots=True, eq=False)
class MatchBasin:
    """g(d): the success rate of an attempt against distance, if the appearance is compatible.

    Attributes:
        focal_px: focal length of the live camera.
        counts: the attempts learnt from.
        rates: (2, BIN_COUNT) float64, success rate in the middle of each bin, along and across,
            decreasing with distance (isotonic regression over counts and prior).
        basin_m: the farthest distance along the viewing direction with g >= 0.6, metres.
    """

    focal_px: float
    counts: BasinCounts
    rates: Array
    basin_m: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "basin_m", _basin_m(self.rates[0]))

    @staticmethod
    def of(
        focal_px: float,
        counts: BasinCounts | None = None,
        config: BasinConfig = BasinConfig(),
    ) -> MatchBasin:
        """The basin from the prior and the attempts so far.

        Raises:
            InputError: the focal length is not finite and positive.
        """
        counts = BasinCounts.empty() if counts is None else counts
        prior = _prior_rates(prior_basin_m(focal_px), config)
        attempts = counts.attempts + config.prior_attempts
        raw = (counts.successes + config.prior_attempts * prior) / attempts
        rates = np.stack([_falling(raw[row], attempts[row]) for row in (0, 1)])
        return MatchBasin(focal_px, counts, rates)

    def success_rate(self, along_m: Array, across_m: Array) -> Array:
        """The rate g at offsets along and across the viewing direction.

        The two directions count as independent: ``g_along · g_across / g(0)``.

        Args:
            along_m, across_m: (N,) float64, metres in the node's frame; other shapes, too.

        Returns:
            (N,) float64, or of that shape: success rate, 0…1.
        """
        along = np.ascontiguousarray(along_m, dtype=np.float64)
        across = np.ascontiguousarray(across_m, dtype=np.float64)
        rates = _core.success_rates(self.rates, BIN_M, along.reshape(-1), across.reshape(-1))
        return rates.reshape(along.shape)

    def search_radius_m(
        self, sigma_m: float, least_m: float = DEFAULT_RADIUS_M, most_m: float = math.inf
    ) -> float:
        """Radius of the neighbourhood search for a position with this standard deviation.

        Never less than the basin or `least_m`, even if `most_m` is.
        """
        basin_m = self.basin_m
        return max(least_m, basin_m + min(2 * sigma_m, max(most_m - basin_m, 0.0)))


def count_attempts(
    drives: NDArray[np.int64],
    experiences: NDArray[np.int64],
    iterations: NDArray[np.int64],
    offsets_m: tuple[Array, Array],
    sigma_m: Array,
    accepted: NDArray[np.bool_],
) -> BasinCounts:
    """Counts of the attempts on experiences that the drive had matched within the last 5 m.

    Left out are attempts on an experience without a match in the ten iterations before, which
    depend on appearance more than on distance, and attempts with an uncertain prediction. Only
    earlier iterations count, so that no match confirms itself.

    Args:
        drives: (A,) int64, the drive of each attempt, numbered from 0.
        experiences: (A,) int64, the experience of its node, numbered from 0.
        iterations: (A,) int64, its iteration.
        offsets_m: (A,) float64 each, predicted offsets along and across the viewing direction.
        sigma_m: (A,) float64, standard deviation of the prediction.
        accepted: (A,) bool, whether it was a success.
    """
    if len(iterations) == 0:
        return BasinCounts.empty()
    # Drive, experience and iteration in one number: sorted, the last match precedes its attempt.
    chain = drives.astype(np.int64) * (int(experiences.max()) + 1) + experiences
    span = int(iterations.max() - iterations.min()) + 1
    when = chain * span + (iterations - iterations.min())
    matched = np.r_[-1, np.sort(when[accepted])]
    counted = np.asarray(sigma_m <= _GREATEST_SIGMA_M)
    sure = when[counted]
    last = matched[np.searchsorted(matched, sure) - 1]
    recent = sure - last <= _COMPATIBLE_ITERATIONS
    counted[counted] = (last >= chain[counted] * span) & recent
    along_m, across_m = (np.abs(offset.astype(np.float64)) for offset in offsets_m)
    counts = np.zeros((2, 2, BIN_COUNT), dtype=np.int64)
    for direction, (offset_m, aside_m) in enumerate(((along_m, across_m), (across_m, along_m))):
        bins = np.minimum(offset_m / BIN_M, BIN_COUNT - 1).astype(np.int64)
        here = counted & (aside_m <= _ASIDE_M)
        for row, some in enumerate((here, here & accepted)):
            counts[row, direction] = np.bincount(bins[some], minlength=BIN_COUNT)
    return BasinCounts(counts[0], counts[1])


def _falling(values: Array, weights: Array) -> Array:
    """The nearest (N,) values that never rise (isotonic regression), by weighted squares.

    As `scipy.optimize` has it, to the bit; to load that takes a hundred times as long.
    Source: Busing, Monotone Regression, J. Stat. Softw. 102, 2022, algorithm 1.
    """
    pools: list[tuple[float, float, int]] = []  # value, weight and length, from the last bin on
    left = list(zip(values.tolist(), weights.tolist(), strict=True))
    while left:
        value, weight = left.pop()
        length = 1
        if pools and pools[-1][0] >= value:
            before, its_weight, its_length = pools.pop()
            total = its_weight * before + weight * value
            weight, length = weight + its_weight, length + its_length
            value = total / weight
            while left and value >= left[-1][0]:
                other, its_weight = left.pop()
                total, weight, length = total + its_weight * other, weight + its_weight, length + 1
                value = total / weight
            while pools and pools[-1][0] >= value:
                before, its_weight, its_length = pools.pop()
                total += its_weight * before
                weight, length = weight + its_weight, length + its_length
                value = total / weight
        pools.append((value, weight, length))
    return np.repeat([one[0] for one in pools], [one[2] for one in pools])[::-1]


def _basin_m(rates: Array) -> float:
    """Where (BIN_COUNT,) rates fall below `BASIN_LEVEL`, metres."""
    below = np.flatnonzero(rates < BASIN_LEVEL)
    if len(below) == 0:
        return BIN_M * BIN_COUNT
    first = int(below[0])
    if first == 0:
        return float(_BIN_CENTRES_M[0] * rates[0] / BASIN_LEVEL)
    share = (rates[first - 1] - BASIN_LEVEL) / (rates[first - 1] - rates[first])
    return float(_BIN_CENTRES_M[first - 1] + share * BIN_M)


def _prior_rates(basin_m: float, config: BasinConfig) -> Array:
    """(BIN_COUNT,) a logistic curve through `BASIN_LEVEL` at the basin."""
    softness, at_zero = config.softness * basin_m, config.success_at_zero
    centre = basin_m - softness * np.log(at_zero / BASIN_LEVEL - 1)
    return np.asarray(at_zero / (1 + np.exp((_BIN_CENTRES_M - centre) / softness)))


_BIN_CENTRES_M = (np.arange(BIN_COUNT) + 0.5) * BIN_M


@dataclass(frozen=True, slots=True, eq=False)
class PivotedError:
    """The error of a transform ``a_from_b`` in the model above.

    Attributes:
        translation_var: τ, m².
        rotation_var: v, rad².
        pivot_in_a: (3,) float64, metres, the centre of the rotation error.
    """

    translation_var: float
    rotation_var: float
    pivot_in_a: Array

    def covariance(self) -> Array:
        """The (6, 6) covariance, left perturbation, [translation, rotation], of this model."""
        lever = skew(self.pivot_in_a)
        covariance = np.zeros((6, 6))
        # A rotation r about the pivot c moves the origin by -r × c = [c]× r.
        covariance[:3, :3] = self.translation_var * np.eye(3) + self.rotation_var * lever @ lever.T
        covariance[:3, 3:] = self.rotation_var * lever
        covariance[3:, :3] = covariance[:3, 3:].T
        covariance[3:, 3:] = self.rotation_var * np.eye(3)
        return covariance

    def seen_from(self, other_from_a: SE3) -> PivotedError:
        """The same error in another frame."""
        return PivotedError(self.translation_var, self.rotation_var, other_from_a @ self.pivot_in_a)


@dataclass(frozen=True, slots=True, eq=False)
class ChainError:
    """Summed error of a chain of transforms, in one frame: the moments of its edges' errors.

    Attributes:
        moments: (6,) float64: Στ m², Σv rad², Σv·pivot (3), Σv·|pivot|².
    """

    moments: Array

    def __add__(self, other: ChainError) -> ChainError:
        """The two chains together, both in the same frame and independent."""
        return ChainError(self.moments + other.moments)

    def pivoted(self, default_pivot: Array) -> PivotedError:
        """The error of one transform equal to the chain's.

        Args:
            default_pivot: (3,) float64, metres; the pivot of a chain without rotation error.
        """
        tau, v, *_, second = self.moments
        if v <= 0:
            return PivotedError(float(tau), 0.0, default_pivot)
        pivot = self.moments[2:5] / v
        spread = max(float(second - v * (pivot @ pivot)), 0.0)
        return PivotedError(float(tau) + spread, float(v), pivot)


def edge_error_rows(edges: Sequence[tuple[SE3, Array]]) -> Array:
    """(E, 8) float64: τ, v, pivot in a, pivot in b of each edge, for the search kernels.

    An edge's pivot is the point of its smallest translational error; τ and v are the variances
    along the worst axis there.

    Args:
        edges: E times ``a_from_b`` with its (6, 6) covariance, left perturbation,
            [translation, rotation].

    Raises:
        InputError: a covariance has the wrong shape, is not finite or not positive semi-definite.
    """
    stack = _stacked([covariance for _, covariance in edges])
    poses = np.empty((len(edges), 12))
    for row, (a_from_b, _) in zip(poses, edges, strict=True):
        row[:9], row[9:] = a_from_b.rotation.ravel(), a_from_b.translation
    return error_rows_of(poses, stack)


def error_rows_of(poses: Array, covariances: Array) -> Array:
    """`edge_error_rows` of arrays.

    Args:
        poses: (E, 12) float64, ``a_from_b``: rotation in row-major order, then translation.
        covariances: (E, 6, 6) float64 of these, m and rad.

    Raises:
        InputError: a covariance is not finite or not positive semi-definite.
    """
    rows = np.empty((len(poses), 8))
    rows[:, :5], definite = _core.pivoted_errors(covariances)
    _check(covariances[definite == 0])
    if len(poses):
        rotations, translations = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:]
        # As a_from_b.inverse() @ pivot has it.
        transposed = rotations.transpose(0, 2, 1)
        moved = (transposed @ translations[:, :, None])[:, :, 0]
        rows[:, 5:] = (rows[:, None, 2:5] @ rotations)[:, 0] - moved
    return rows


def _stacked(covariances: Sequence[Array]) -> Array:
    """(E, 6, 6) float64: a map has tens of thousands."""
    for one in covariances:
        if one.shape != (6, 6):
            raise InputError(f"a covariance must be a finite (6, 6) matrix, not {one.shape}")
    return np.ascontiguousarray(np.reshape(covariances, (-1, 6, 6)), np.float64)


def _check(stack: Array) -> None:
    """Checks (K, 6, 6) covariances that are not surely positive definite."""
    if not len(stack):
        return
    if not np.isfinite(stack).all():
        raise InputError("a covariance must be a finite (6, 6) matrix; it has non-finite entries")
    eigenvalues = np.linalg.eigvalsh(stack)
    bad = eigenvalues[:, 0] < -1e-9 * np.maximum(eigenvalues[:, -1], 1e-12)
    if bad.any():
        raise InputError(
            "a covariance must be positive semi-definite; smallest eigenvalue "
            f"{eigenvalues[bad][0, 0]:.3g}"
        )
