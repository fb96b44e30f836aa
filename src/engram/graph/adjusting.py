"""Robust least squares over poses: what a set of measured transforms says together.

Poses are adjusted by Gauss–Newton on SE(3) with a sparse factorisation. Wrong measurements lose
their weight by graduated non-convexity with the kernel of Geman and McClure: at first all count,
then the kernel narrows to its final width.

Source: Yang, Antonante, Tzoumas and Carlone, Graduated Non-Convexity for Robust Spatial Perception,
RA-L 2020.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.geometry import SE3
from engram.graph.model import Edge, EdgeKind

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

Array = NDArray[np.float64]

# Prior odds: odometry joins frames a moment apart, a tie was made by a robot that was localised; a
# match alone may join look-alikes.
_TRUST = {EdgeKind.ODOMETRY: 4.0, EdgeKind.TIE: 2.0, EdgeKind.BRIDGE: 2.0}


@dataclass(frozen=True, slots=True)
class AdjustConfig:
    """Settings of `adjust`.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    floor_m: Annotated[
        float,
        Meta(
            gt=0,
            description="least standard deviation of a measured translation, m: covariances of "
            "matches and odometry are too small for distant views",
        ),
    ] = 0.05
    floor_share: Annotated[
        float,
        Meta(ge=0, description="the same as a share of its length: systematic error of odometry"),
    ] = 0.02
    floor_rad: Annotated[
        float, Meta(gt=0, description="least standard deviation of a measured rotation, rad")
    ] = 0.005
    kernel_chi2: Annotated[
        float,
        Meta(
            gt=0,
            description="squared, normalised residual at which a measurement has lost half of its "
            "influence: 99.9 % of χ² with six degrees of freedom",
        ),
    ] = 22.5
    widest: Annotated[
        float,
        Meta(
            ge=1,
            description="greatest width of the kernel at the start, times its final width: as wide "
            "as the largest residual needs",
        ),
    ] = 1e5
    narrowing: Annotated[
        float, Meta(gt=1, description="factor by which the kernel narrows after each step")
    ] = 2.0
    steps: Annotated[
        int, Meta(ge=1, description="Gauss–Newton steps with the final width, at most")
    ] = 6
    still_m: Annotated[
        float, Meta(gt=0, description="movement of all poses below which the steps end, m or rad")
    ] = 1e-4

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """N poses ``map_from_node``, a struct of arrays.

    Attributes:
        rotations: (N, 3, 3) float64, rotations.
        translations: (N, 3) float64, metres.
    """

    rotations: Array
    translations: Array

    @staticmethod
    def identity(count: int) -> Poses:
        """N identities."""
        return Poses(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))

    def pose(self, at: int) -> SE3:
        """One of them."""
        return SE3(self.rotations[at].copy(), self.translations[at].copy())

    def set(self, at: int, pose: SE3) -> None:
        """Sets one of them."""
        self.rotations[at], self.translations[at] = pose.rotation, pose.translation

    def copy(self) -> Poses:
        """Arrays of its own."""
        return Poses(self.rotations.copy(), self.translations.copy())

    def some(self, rows: NDArray[np.integer]) -> Poses:
        """Copies of the chosen rows, (n,) indices."""
        return Poses(self.rotations[rows], self.translations[rows])

    def put(self, rows: NDArray[np.integer], poses: Poses) -> None:
        """Sets the chosen rows, (n,) indices."""
        self.rotations[rows], self.translations[rows] = poses.rotations, poses.translations

    def moved(self, step: Array) -> Poses:
        """Each pose times the exponential of its row of (N, 6) steps (m, rad), in its own frame."""
        from scipy.spatial.transform import Rotation

        turned = self.rotations @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
        shifted = np.einsum("nij,nj->ni", self.rotations, step[:, :3])
        return Poses(turned, self.translations + shifted)


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """E measured transforms ``a_from_b`` between poses, a struct of arrays.

    Attributes:
        a, b: (E,) int64, indices of poses.
        rotations: (E, 3, 3) float64, rotations.
        translations: (E, 3) float64, metres.
        whitening: (E, 6, 6) float64: a residual times this has unit covariance.
        trust: (E,) float64, a ratio: how much wider than others its kernel is. Where a cycle does
            not close, what is trusted less gives way.
    """

    a: NDArray[np.int64]
    b: NDArray[np.int64]
    rotations: Array
    translations: Array
    whitening: Array
    trust: Array

    @staticmethod
    def of(edges: Sequence[Edge], ends: NDArray[np.integer], config: AdjustConfig) -> Measured:
        """The measurements of edges.

        Args:
            edges: E edges.
            ends: (E, 2) int, indices of the poses of a and b.
            config: the floors of their covariances.
        """
        count = len(edges)
        rotations = np.array([edge.a_from_b.rotation for edge in edges]).reshape(count, 3, 3)
        translations = np.array([edge.a_from_b.translation for edge in edges]).reshape(count, 3)
        covariances = np.array([edge.covariance for edge in edges]).reshape(count, 6, 6)
        lengths = np.linalg.norm(translations, axis=1)
        floors = np.full((count, 6), config.floor_rad**2)
        floors[:, :3] = (config.floor_m**2 + (config.floor_share * lengths) ** 2)[:, None]
        # A floor under the variances, not a sum: honest covariances stay as they are.
        short = np.maximum(floors - np.einsum("nii->ni", covariances), 0.0)
        covariances = covariances + np.einsum("ni,ij->nij", short, np.eye(6))
        whitening = np.linalg.inv(np.linalg.cholesky(_definite(covariances)))
        return Measured(
            ends[:, 0].astype(np.int64), ends[:, 1].astype(np.int64),
            rotations, translations, whitening,
            np.array([_TRUST.get(edge.kind, 1.0) for edge in edges]),
        )  # fmt: skip

    def rows(self, rows: NDArray[np.bool_] | NDArray[np.integer]) -> Measured:
        """The chosen rows: (n,) indices, or (E,) bool."""
        return Measured(
            self.a[rows], self.b[rows], self.rotations[rows],
            self.translations[rows], self.whitening[rows], self.trust[rows],
        )  # fmt: skip

    def residuals(self, poses: Poses) -> Array:
        """(E, 6) float64: error of each as [translation m, rotation rad], not normalised."""
        return self._errors(poses)[0]

    def chi2(self, poses: Poses) -> Array:
        """(E,) float64: squared residuals in σ²."""
        whitened = np.einsum("nij,nj->ni", self.whitening, self.residuals(poses))
        return np.asarray(np.einsum("ni,ni->n", whitened, whitened))

    def _errors(self, poses: Poses) -> tuple[Array, Array, Array]:
        """Residuals, ``a_from_b`` of the poses, and the rotation error."""
        from scipy.spatial.transform import Rotation

        to_a = poses.rotations[self.a].transpose(0, 2, 1)
        between = to_a @ poses.rotations[self.b]
        offset = np.einsum(
            "nij,nj->ni", to_a, poses.translations[self.b] - poses.translations[self.a]
        )
        error = between @ self.rotations.transpose(0, 2, 1)
        shift = offset - np.einsum("nij,nj->ni", error, self.translations)
        turn = Rotation.from_matrix(error).as_rotvec() if len(error) else np.zeros((0, 3))
        return np.concatenate([shift, turn], axis=1), between, error

    def linearised(self, poses: Poses) -> tuple[Array, Array, Array]:
        """Whitened residuals (E, 6) in σ, and Jacobians (E, 6, 6) by the steps of a and of b."""
        residual, between, error = self._errors(poses)
        by_a, by_b = np.zeros((2, len(residual), 6, 6))
        by_a[:, :3, :3] = by_a[:, 3:, 3:] = -np.eye(3)
        by_a[:, :3, 3:] = skews(residual[:, :3])
        by_b[:, :3, :3] = between
        by_b[:, 3:, 3:] = between
        by_b[:, :3, 3:] = error @ skews(self.translations) @ self.rotations
        residual = np.einsum("nij,nj->ni", self.whitening, residual)
        return residual, self.whitening @ by_a, self.whitening @ by_b


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """Priors of single poses, in addition to the measurements.

    Attributes:
        at: (P,) int64, poses whose position is known.
        positions: (P, 3) float64, metres in the map frame; NaN for an unknown
            coordinate.
        sigmas_m: (P,) float64, their standard deviations.
        ups: (N, 3) float64, the direction in each node's camera that is up on a level road.
        level_rad: standard deviation of the tilt of a camera; 0 to ignore it.
    """

    at: NDArray[np.int64]
    positions: Array
    sigmas_m: Array
    ups: Array
    level_rad: float

    @staticmethod
    def none(count: int) -> Priors:
        """No priors for N poses."""
        nothing = np.zeros(0)
        return Priors(nothing.astype(np.int64), nothing.reshape(0, 3), nothing,
                      np.tile([0.0, -1.0, 0.0], (count, 1)), 0.0)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The result of `adjust`.

    Attributes:
        poses: the adjusted poses.
        chi2: (E,) float64, squared residuals in σ².
        weights: (E,) float64, 0…1: the influence that each measurement kept.
    """

    poses: Poses
    chi2: Array
    weights: Array


def adjust(
    poses: Poses,
    measured: Measured,
    free: NDArray[np.bool_],
    config: AdjustConfig,
    priors: Priors | None = None,
) -> Adjusted:
    """Adjusts poses to measurements, some of which may be wrong.

    Args:
        poses: where to begin.
        measured: the measurements.
        free: (N,) bool, the poses that may move; each needs a chain of measurements, or priors,
            that fix it.
        config: settings.
        priors: what else is known; None for nothing.
    """
    priors = priors or Priors.none(len(free))
    used = measured.rows(free[measured.a] | free[measured.b])
    column = np.full(len(free), -1, np.int64)
    column[free] = np.arange(int(free.sum()))
    largest = 2 * float(used.chi2(poses).max(initial=0.0)) / config.kernel_chi2
    width, left = float(np.clip(largest, 1.0, config.widest)), config.steps
    while free.any() and left and (len(used.a) or len(priors.at)):
        weights = kernel(used.chi2(poses), config.kernel_chi2 * width * used.trust)
        step = _step(poses, used, weights, column, priors)
        poses = poses.moved(step)
        if width == 1.0:
            left = 0 if np.abs(step).max() < config.still_m else left - 1
        width = max(1.0, width / config.narrowing)
    chi2 = measured.chi2(poses)
    return Adjusted(poses, chi2, kernel(chi2, config.kernel_chi2 * measured.trust))


def kernel(chi2: Array, width: float | Array) -> Array:
    """(E,) weights of Geman and McClure, of squared residuals."""
    return np.asarray((width / (width + chi2)) ** 2)


def _step(
    poses: Poses, used: Measured, weights: Array, column: NDArray[np.int64], priors: Priors
) -> Array:
    """(N, 6): the Gauss–Newton step of all poses; 0 of fixed ones."""
    from scipy.sparse.linalg import splu

    residual, by_a, by_b = used.linearised(poses)
    count = int(column.max()) + 1
    gradient = np.zeros((count, 6))
    blocks: list[tuple[NDArray[np.int64], NDArray[np.int64], Array]] = []
    sides = ((used.a, by_a), (used.b, by_b))
    for ends, jacobian in sides:
        at = column[ends]
        rows = at >= 0
        pulled = np.einsum("n,nij,ni->nj", weights, jacobian, residual)
        np.add.at(gradient, at[rows], pulled[rows])
        for others, other in sides:
            to = column[others]
            both = rows & (to >= 0)
            product = np.einsum("n,nki,nkj->nij", weights[both], jacobian[both], other[both])
            blocks.append((at[both], to[both], product))
    for at, pulled, product in _prior_terms(poses, column, priors):
        np.add.at(gradient, at, pulled)
        blocks.append((at, at, product))
    diagonal = np.arange(count)
    blocks.append((diagonal, diagonal, np.tile(1e-6 * np.eye(6), (count, 1, 1))))
    step = np.zeros((len(column), 6))
    solved = splu(
        _sparse(blocks, count), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    ).solve(gradient.ravel())
    step[column >= 0] = -np.clip(solved.reshape(-1, 6), -_LONGEST, _LONGEST)
    return step


# A longer step leaves the range in which the linearisation holds.
_LONGEST = np.array([50.0] * 3 + [0.5] * 3)


def _prior_terms(
    poses: Poses, column: NDArray[np.int64], priors: Priors
) -> list[tuple[NDArray[np.int64], Array, Array]]:
    """Columns, gradients (P, 6) and products (P, 6, 6) of the priors."""
    terms = []
    known = column[priors.at] >= 0
    at, weight = priors.at[known], priors.sigmas_m[known] ** -2
    if len(at):
        error = poses.translations[at] - priors.positions[known]
        given = np.isfinite(error)
        error = np.where(given, error, 0.0)
        chi2 = weight * (error**2).sum(axis=1)
        jacobian = np.zeros((len(at), 3, 6))
        jacobian[:, :, :3] = poses.rotations[at] * given[:, :, None]
        terms.append(_term(column[at], jacobian, error, weight * kernel(chi2, 11.3)))
    if priors.level_rad > 0:
        free = np.flatnonzero(column >= 0)
        up = np.einsum("nij,nj->ni", poses.rotations[free], priors.ups[free])
        jacobian = np.zeros((len(free), 2, 6))
        jacobian[:, :, 3:] = -(poses.rotations[free] @ skews(priors.ups[free]))[:, :2]
        weight = np.full(len(free), priors.level_rad**-2)
        terms.append(_term(column[free], jacobian, up[:, :2], weight))
    return terms


def _term(
    at: NDArray[np.int64], jacobian: Array, error: Array, weight: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    return (
        at,
        np.einsum("n,nki,nk->ni", weight, jacobian, error),
        np.einsum("n,nki,nkj->nij", weight, jacobian, jacobian),
    )


def _sparse(
    blocks: list[tuple[NDArray[np.int64], NDArray[np.int64], Array]], count: int
) -> csc_matrix[np.float64]:
    """The (6N, 6N) matrix of 6×6 blocks; those of one place add up."""
    from scipy.sparse import coo_matrix

    rows = np.concatenate([row for row, _, _ in blocks])
    columns = np.concatenate([column for _, column, _ in blocks])
    values = np.concatenate([value for _, _, value in blocks])
    inner = np.arange(6)
    at = (6 * rows)[:, None, None] + inner[:, None]
    to = (6 * columns)[:, None, None] + inner
    shape = values.shape
    place = (np.broadcast_to(at, shape).ravel(), np.broadcast_to(to, shape).ravel())
    return coo_matrix((values.ravel(), place), shape=(6 * count, 6 * count)).tocsc()


def skews(vectors: Array) -> Array:
    """(N, 3, 3): the cross product with each row of an (N, 3) array, in its unit."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _definite(covariances: Array) -> Array:
    """Covariances, lifted where rounding made them indefinite."""
    lowest = np.linalg.eigvalsh(covariances)[:, 0]
    lift = np.maximum(1e-10 - lowest, 0.0)
    return np.asarray(covariances + np.einsum("n,ij->nij", lift, np.eye(6)))
