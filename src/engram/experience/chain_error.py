"""How uncertain a chain of edges is: a 6×6 covariance boiled down to what adds up along a chain.

The error of a transform is modelled as a small rotation, of variance v about any axis, about a
*pivot*, and a small translation of variance τ along any axis. Seen at a point p it moves things by

    variance(p) = τ + v·|p − pivot|²        (m² along the worst axis)

so that the errors of a chain add as moments: Στ, Σv, Σv·pivot, Σv·|pivot|². The pivot is what an
isotropic model must not drop: a heading error made 100 m ago swings everything since, and the next
metre's error is the same error again, not a fresh one.
"""

from __future__ import annotations

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
        pivot_in_a: (3,) metres, the point about which the rotation error turns.
    """

    translation_var: float
    rotation_var: float
    pivot_in_a: Array

    @staticmethod
    def from_covariance(covariance: Array) -> PivotedError:
        """The model of a (6, 6) covariance, left perturbation, [translation, rotation].

        The pivot is where the translational error is smallest; τ and v are the variances along
        the worst axis there.

        Raises:
            InputError: the covariance has the wrong shape, is not finite or not positive
                semi-definite.
        """
        if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
            raise InputError(f"a covariance is a finite (6, 6) matrix, not {covariance.shape}")
        eigenvalues = np.linalg.eigvalsh(covariance)
        if eigenvalues[0] < -1e-9 * max(eigenvalues[-1], 1e-12):
            raise InputError(
                f"a covariance must be positive semi-definite; smallest eigenvalue "
                f"{eigenvalues[0]:.3g}"
            )
        tau, v, *pivot = _core.pivoted_error(np.ascontiguousarray(covariance))
        return PivotedError(float(tau), float(v), np.array(pivot))

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

    def variance_at(self, point_in_a: Array) -> float:
        """Variance along the worst axis, m², of where a point (3,) carried by the transform is."""
        lever = point_in_a - self.pivot_in_a
        return self.translation_var + self.rotation_var * float(lever @ lever)


@dataclass(frozen=True, slots=True, eq=False)
class ChainError:
    """Summed error of a chain of transforms, in one frame: the moments of its edges' errors.

    Attributes:
        moments: (6,) Στ m², Σv rad², Σv·pivot (3), Σv·|pivot|².
    """

    moments: Array

    def __add__(self, other: ChainError) -> ChainError:
        """The two chains together, both in the same frame and independent."""
        return ChainError(self.moments + other.moments)

    def pivoted(self, default_pivot: Array) -> PivotedError:
        """One transform's error equal to the chain's; `default_pivot` (3,) if no rotation errs."""
        tau, v, *_, second = self.moments
        if v <= 0:
            return PivotedError(float(tau), 0.0, default_pivot)
        pivot = self.moments[2:5] / v
        spread = max(float(second - v * (pivot @ pivot)), 0.0)
        return PivotedError(float(tau) + spread, float(v), pivot)


def edge_error_row(a_from_b: SE3, covariance: Array) -> Array:
    """(8,) τ, v, pivot in a, pivot in b: an edge's row for the search kernels."""
    error = PivotedError.from_covariance(covariance)
    row = np.empty(8)
    row[:2] = error.translation_var, error.rotation_var
    row[2:5] = error.pivot_in_a
    row[5:] = a_from_b.inverse() @ error.pivot_in_a
    return row
