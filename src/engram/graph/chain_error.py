"""How uncertain a chain of edges is: a 6×6 covariance boiled down to what adds up along a chain.

The error of a transform is modelled as a small rotation, of variance v about any axis, about a
*pivot*, and a small translation of variance τ along any axis. Seen at a point p it moves things by

    variance(p) = τ + v·|p − pivot|²        (m² along the worst axis)

so that the errors of a chain add as moments: Στ, Σv, Σv·pivot, Σv·|pivot|². The pivot is what an
isotropic model must not drop: a heading error made 100 m ago swings everything since, and the next
metre's error is the same error again, not a fresh one.
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
        pivot_in_a: (3,) metres, the point about which the rotation error turns.
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


def edge_error_rows(edges: Sequence[tuple[SE3, Array]]) -> Array:
    """(E, 8) τ, v, pivot in a, pivot in b: the rows of edges for the search kernels.

    An edge's pivot is where its translational error is smallest; τ and v are the variances along
    the worst axis there.

    Args:
        edges: (E) ``a_from_b`` with its (6, 6) covariance, left perturbation,
            [translation, rotation].

    Raises:
        InputError: a covariance has the wrong shape, is not finite or not positive semi-definite.
    """
    _check([covariance for _, covariance in edges])
    rows = np.empty((len(edges), 8))
    for row, (a_from_b, covariance) in zip(rows, edges, strict=True):
        row[:5] = _core.pivoted_error(np.ascontiguousarray(covariance))
        row[5:] = a_from_b.inverse() @ row[2:5]
    return rows


def _check(covariances: Sequence[Array]) -> None:
    """All at once: a map has tens of thousands."""
    for one in covariances:
        if one.shape != (6, 6):
            raise InputError(f"a covariance is a finite (6, 6) matrix, not {one.shape}")
    stack = np.reshape(covariances, (-1, 6, 6))
    if not np.isfinite(stack).all():
        raise InputError("a covariance is a finite (6, 6) matrix; it has numbers that are not")
    eigenvalues = np.linalg.eigvalsh(stack)
    bad = eigenvalues[:, 0] < -1e-9 * np.maximum(eigenvalues[:, -1], 1e-12)
    if bad.any():
        raise InputError(
            "a covariance must be positive semi-definite; smallest eigenvalue "
            f"{eigenvalues[bad][0, 0]:.3g}"
        )
