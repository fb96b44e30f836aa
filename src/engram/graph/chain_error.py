"""Uncertainty of a chain of edges: a 6×6 covariance reduced to moments that add up along a chain.

The error of a transform is modelled as a small rotation, of variance v about any axis, about a
*pivot*, and a small translation of variance τ along any axis. At a point p it gives

    variance(p) = τ + v·|p − pivot|²        (m² along the worst axis)

so that the errors of a chain add as moments: Στ, Σv, Σv·pivot, Σv·|pivot|². The pivot is essential:
a heading error made 100 m ago moves everything since, and does so again on the next metre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.errors import InputError
from engram.geometry import SE3, skew

Array = NDArray[np.float64]


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
