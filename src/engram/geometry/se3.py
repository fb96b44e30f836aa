"""Rigid transforms between named frames: ``target_from_source``.

``points_in_target = target_from_source @ points_in_source``; equal names touch when transforms
are chained, and the inverse swaps the names. Tangent vectors are ``[translation, rotation]``
(metres, radians) and perturb on the left: ``exp(tangent) @ target_from_source``, so that a 6×6
covariance lives in the target frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engram import _core
from engram.errors import InputError

Array = NDArray[np.float64]

_ORIGIN = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class SE3:
    """A rigid transform ``target_from_source``.

    Attributes:
        rotation: (3, 3) float64, a rotation: orthonormal with determinant 1.
        translation: (3,) float64, metres; the source's origin in the target frame.
    """

    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> SE3:
        """The identity."""
        return SE3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> SE3:
        """From a (4, 4) or (3, 4) matrix; the rotation is projected onto SO(3).

        A block that is a rotation to within rounding is kept bit for bit, so that stored transforms
        are read back unchanged.

        Raises:
            InputError: the shape is wrong, a value is not finite, or the upper left 3×3 block is
                further than 1e-3 from a rotation.
        """
        values = np.asarray(matrix, dtype=np.float64)
        if values.shape not in {(4, 4), (3, 4)}:
            raise InputError(f"a transform has shape (4, 4) or (3, 4), not {values.shape}")
        if not np.isfinite(values).all():
            raise InputError("a transform must be finite")
        given = values[:3, :3]
        if np.abs(given @ given.T - np.eye(3)).max() < 1e-12 and np.linalg.det(given) > 0:
            return SE3(given.copy(), values[:3, 3].copy())
        left, _, right = np.linalg.svd(given)
        rotation = left @ right
        if np.linalg.det(rotation) < 0 or np.abs(rotation - given).max() > 1e-3:
            raise InputError("the upper left 3×3 block of a transform must be a rotation")
        return SE3(rotation, values[:3, 3].copy())

    @staticmethod
    def from_quaternion(wxyz: ArrayLike, translation: ArrayLike) -> SE3:
        """From a quaternion (4,) in the order w, x, y, z (normalised here) and a (3,) position.

        Raises:
            InputError: a shape is wrong, a value is not finite, or the quaternion is zero.
        """
        quaternion = np.asarray(wxyz, dtype=np.float64)
        position = np.array(translation, dtype=np.float64)
        norm = np.linalg.norm(quaternion)
        if quaternion.shape != (4,) or not np.isfinite(norm) or norm < 1e-9:
            raise InputError("a quaternion is four finite numbers w, x, y, z, not all zero")
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InputError("a position is three finite numbers")
        w, x, y, z = quaternion / norm
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return SE3(rotation, position)

    @staticmethod
    def exp(tangent: ArrayLike) -> SE3:
        """The transform of a (6,) tangent vector [translation m, rotation rad]."""
        return SE3(*_core.transform_of(np.ascontiguousarray(tangent, dtype=np.float64)))

    def log(self) -> Array:
        """The (6,) tangent vector [translation m, rotation rad]; inverse of `exp`."""
        return _tangent(self.rotation, self.translation)

    @overload
    def __matmul__(self, other: SE3) -> SE3: ...
    @overload
    def __matmul__(self, other: Array) -> Array: ...
    def __matmul__(self, other: SE3 | Array) -> SE3 | Array:
        """Chain with a transform, or map points (..., 3) from the source to the target frame."""
        if isinstance(other, SE3):
            return SE3(
                self.rotation @ other.rotation,
                self.rotation @ other.translation + self.translation,
            )
        return other @ self.rotation.T + self.translation

    def inverse(self) -> SE3:
        """``source_from_target``."""
        transposed = self.rotation.T
        return SE3(transposed, -(transposed @ self.translation))

    def renormalised(self) -> SE3:
        """The transform with its rotation orthonormalised, for the end of long products.

        One Newton step towards the nearest rotation squares the error.
        """
        return SE3(_core.orthonormalised(self.rotation), self.translation)

    def matrix(self) -> Array:
        """The (4, 4) float64 matrix, homogeneous; translation in m."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def chain(self, covariance: Array, other: SE3, other_covariance: Array) -> tuple[SE3, Array]:
        """``self @ other`` with its covariance, in one call: see `propagate_covariance`.

        Args:
            covariance, other_covariance: (6, 6) float64 of the two, left perturbation,
                [translation m, rotation rad].
        """
        rotation, translation, both = _core.chain(
            self.rotation,
            self.translation,
            covariance,
            other.rotation,
            other.translation,
            other_covariance,
        )
        return SE3(rotation, translation), both

    def adjoint(self) -> Array:
        """(6, 6) float64: carries tangent vectors (m, rad) from the source to the target frame."""
        adjoint = np.zeros((6, 6))
        adjoint[:3, :3] = self.rotation
        adjoint[:3, 3:] = skew(self.translation) @ self.rotation
        adjoint[3:, 3:] = self.rotation
        return adjoint

    def quaternion_wxyz(self) -> Array:
        """The (4,) unit quaternion w, x, y, z with w >= 0."""
        vector = _rotation_log(self.rotation)
        angle = _length(vector)
        half_sinc = 0.5 * np.sinc(angle / (2 * np.pi))
        quaternion = np.concatenate([[np.cos(angle / 2)], half_sinc * vector])
        return np.asarray(quaternion / np.linalg.norm(quaternion))

    @property
    def distance_m(self) -> float:
        """Length of the translation, metres."""
        return _length(self.translation)

    @property
    def angle_rad(self) -> float:
        """Angle of the rotation, radians, in [0, π]."""
        return _length(_rotation_log(self.rotation))

    @property
    def yaw_rad(self) -> float:
        """Heading of the source's optical axis in the target's x-z plane, radians, right positive.

        Camera axes are x right, y down, z forward (method §1), so this is the turn about y.
        """
        return float(np.arctan2(self.rotation[0, 2], self.rotation[2, 2]))


def _length(vector: Array) -> float:
    """Length of a (3,) vector: that of `np.linalg.norm` to the bit, in a sixth of its time."""
    return math.sqrt(vector @ vector)


def skew(vector: Array) -> Array:
    """The (3, 3) matrix, in the unit of its (3,) vector, with ``skew(a) @ b == cross(a, b)``."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def propagate_covariance(a_from_b: SE3, covariance_ab: Array, covariance_bc: Array) -> Array:
    """Covariance (6, 6) of ``a_from_b @ b_from_c`` from those of its two factors.

    First order, independent errors, left perturbation; order [translation m, rotation rad].
    """
    adjoint = a_from_b.adjoint()
    return covariance_ab + adjoint @ covariance_bc @ adjoint.T


def _rotation_log(rotation: Array) -> Array:
    """The rotation vector (3,) of a rotation matrix, angle in [0, π]."""
    return _tangent(rotation, _ORIGIN)[3:]


def _tangent(rotation: Array, translation: Array) -> Array:
    """The tangent vector (6,) of a transform. The angle is NumPy's: libm's differs in bits."""
    return _core.tangent_of(rotation, translation, float(np.arctan2(*_core.turn_of(rotation))))
