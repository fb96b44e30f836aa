"""Poses of a graph's nodes in one frame: along edges, then adjusted to all of them.

The map frame is for messages, display and exports, never for localising. It has x and y
horizontal and z up. Nodes that have a place keep it; new ones are laid out around them, by robust
least squares over all edges. Components whose relative pose is unknown stand side by side.

Robust least squares over poses: what a set of measured transforms says together. Poses are adjusted
by Gauss–Newton on SE(3) with a sparse factorisation. Wrong measurements lose their weight by
graduated non-convexity with the kernel of Geman and McClure: at first all count, then the kernel
narrows to its final width.

Source: Yang, Antonante, Tzoumas and Carlone, Graduated Non-Convexity for Robust Spatial Perception,
RA-L 2020.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram.config import check_bounds
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph, grouped, labels_of
from engram.graph.model import Edge, EdgeKind, NodeId

if TYPE_CHECKING:
    from scipy.cluster.hierarchy import DisjointSet
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


Indices = NDArray[np.int64]

# Forward of the camera (z) along x, its right (x) along −y, its down (y) along −z: REP 103.
MAP_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

# Variance added to edges by kind, so that first guesses lead along odometry, which joins no
# look-alikes, m².
_DOUBT_M2 = {
    EdgeKind.ODOMETRY: 0.0,
    EdgeKind.BRIDGE: 1.0,
    EdgeKind.TIE: 1.0,
    EdgeKind.MATCH: 4.0,
    EdgeKind.PROXIMITY: 4.0,
}


@dataclass(frozen=True, slots=True)
class PlacingConfig:
    """Settings of the map frame.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    adjust: AdjustConfig = field(default_factory=AdjustConfig)
    level_rad: Annotated[
        float,
        Meta(ge=0, description="standard deviation of the slope of the ground, rad; 0: unknown"),
    ] = 0.1
    apart_m: Annotated[
        float, Meta(ge=0, description="gap between components that stand side by side, m")
    ] = 20.0
    fits_m: Annotated[
        float,
        Meta(
            ge=0,
            description="disagreement with the places of its ends up to which an edge holds two "
            "placed parts together, m; parts that nothing holds together are laid out again, "
            "the larger one excepted",
        ),
    ] = 5.0
    moved_m: Annotated[
        float, Meta(ge=0, description="a repair does not move nodes by less than this, m")
    ] = 1.0  # fmt: skip
    same_m: Annotated[float, Meta(gt=0, description="smaller movements are not written, m")] = 0.001

    def __post_init__(self) -> None:
        check_bounds(self)


DEFAULT_CONFIG = PlacingConfig()


@dataclass(frozen=True, slots=True, eq=False)
class Anchored:
    """Known positions of nodes, for re-anchoring.

    Attributes:
        at: (P,) int64, dense indices of the nodes.
        positions: (P, 3) float64, metres in the new frame; NaN for an unknown height.
        sigmas_m: (P,) float64, their standard deviations.
    """

    at: Indices
    positions: Array
    sigmas_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What the layout of new nodes has to know of the map of which a graph is a part.

    Attributes:
        held: (H, 2) int64, dense indices of placed nodes that are connected elsewhere.
        forward: camera → (3,) float64, sum of its odometry translations elsewhere, metres.
        right_m: largest x of a place in the map frame; None if there is none.
    """

    held: Indices
    forward: Mapping[str, Array]
    right_m: float | None


_NOTHING_ELSE = Surroundings(np.zeros((0, 2), np.int64), {}, None)


def place(
    graph: ExperienceGraph,
    placed: Mapping[NodeId, SE3],
    config: PlacingConfig = DEFAULT_CONFIG,
    rest: Surroundings | None = None,
) -> Poses:
    """Lays out the nodes that have no place around those that have one.

    Args:
        graph: the experience graph.
        placed: ``map_from_node`` of nodes that have a place.
        config: settings.
        rest: of a graph that is new nodes and the other ends of their edges; those then keep
            their places. None for the graph of a whole map.

    Returns:
        The pose of every node, by dense index. Placed nodes keep theirs, except where two placed
        parts turn out to belong together: then the smaller one moves.
    """
    poses, fixed = Poses.identity(len(graph)), np.zeros(len(graph), np.bool_)
    for node, pose in placed.items():
        if node in graph:
            poses.set(graph.index(node), pose)
            fixed[graph.index(node)] = True
    return _Placing.of(graph, config, rest).around(poses, fixed)


def replace_after_removal(
    graph: ExperienceGraph,
    placed: Mapping[NodeId, SE3],
    config: PlacingConfig = DEFAULT_CONFIG,
) -> Poses:
    """Lays out what removed edges had put in a wrong place; everything else stays.

    The whole graph is adjusted from where it is. Nodes that this moves by more than
    `PlacingConfig.moved_m` against the rest are laid out again around those that stay.
    """
    poses = place(graph, placed, config)
    placing = _Placing.of(graph, config)
    adjusted = placing.adjusted_whole(poses)
    stays = np.ones(len(graph), np.bool_)
    for members in placing.components():
        apart = _misfit_m(poses, adjusted, members)
        stays[members] = apart <= config.moved_m
    return placing.around(poses, stays) if not stays.all() else poses


# Anchors must be this far apart to determine a direction, metres.
LEAST_APART_M = 5.0


def held_by_anchors(component: Indices, positions_m: Array) -> Indices:
    """Components whose place and direction in the map frame their anchors determine.

    Args:
        component: (A,) int64, that of each anchored node.
        positions_m: (A, 2) float64, their known x and y in the map frame, metres.

    Returns:
        (H,) int64.
    """
    groups = [rows for rows in grouped(component) if farthest_m(positions_m[rows]) >= LEAST_APART_M]
    return component[np.array([rows[0] for rows in groups], np.int64)]


def farthest_m(positions_m: Array) -> float:
    """Largest distance of (A, 2) positions, metres in the map frame, from the first; A >= 1."""
    return float(np.linalg.norm(positions_m - positions_m[0], axis=1).max())


def anchor(
    graph: ExperienceGraph,
    placed: Mapping[NodeId, SE3],
    anchored: Anchored,
    config: PlacingConfig = DEFAULT_CONFIG,
) -> Poses:
    """Lays out the anchored components again, with their anchors at their known positions.

    Other components keep their shape, and are placed next to them.
    """
    poses = place(graph, placed, config)
    placing = _Placing.of(graph, config)
    taken = np.zeros(len(graph), np.bool_)
    for members in placing.components():
        inside = np.isin(anchored.at, members)
        if inside.any():
            part = Anchored(
                anchored.at[inside], anchored.positions[inside], anchored.sigmas_m[inside]
            )
            poses = placing.fitted(poses, members, part)
            taken[members] = True
    for members in placing.components():
        if not taken[members].any():
            poses = placing.set_beside(poses, members, taken)
            taken[members] = True
    return poses


@dataclass(frozen=True, slots=True, eq=False)
class _Placing:
    """The measurements of a graph, and the steps of a layout.

    Attributes:
        edges: E edges that are used.
        ends: (E, 2) int64, dense indices of their ends a and b.
        measured: what they measure.
        ups: (N, 3) float64, the direction in each node's camera that is up.
        labels: (N,) int64, the component of each node.
        config: settings.
        rest: of a part of a map; None for a whole one.
    """

    edges: list[Edge]
    ends: Indices
    measured: Measured
    ups: Array
    labels: Indices
    config: PlacingConfig
    rest: Surroundings | None = None

    @staticmethod
    def of(
        graph: ExperienceGraph, config: PlacingConfig, rest: Surroundings | None = None
    ) -> _Placing:
        """That of a whole graph, or of a part of a map."""
        both = graph.edge_ends.astype(np.int64)[:, ::-1]  # of a and b
        held, forward = (rest or _NOTHING_ELSE).held, (rest or _NOTHING_ELSE).forward
        edges, ends = _used(graph.edges, both, held, len(graph))
        measured = Measured.of(edges, ends, config.adjust)
        ups = _ups([node.camera for node in graph.nodes], edges, ends, forward)
        labels = labels_of(np.concatenate([ends, held]), len(graph))
        return _Placing(edges, ends, measured, ups, labels, config, rest)

    def components(self) -> list[Indices]:
        """Dense indices of each component, the largest first; of equal ones the earlier."""
        return sorted(grouped(self.labels), key=lambda members: -len(members))

    def _parts(self) -> Iterator[tuple[Indices, _Placing]]:
        """The components, as `components` has them, each as a graph of its own.

        A map may fall into thousands: a step on one must not cost a pass over all.
        """
        edges_of = {}
        for rows in grouped(self.labels[self.ends[:, 0]]):
            edges_of[int(self.labels[self.ends[rows[0], 0]])] = rows
        nothing = np.zeros(0, np.int64)
        for members in self.components():
            rows = edges_of.get(int(self.labels[members[0]]), nothing)
            ends = np.searchsorted(members, self.ends[rows])
            measured = replace(self.measured.rows(rows), a=ends[:, 0], b=ends[:, 1])
            part = replace(
                self,
                edges=[self.edges[row] for row in rows.tolist()],
                ends=ends,
                measured=measured,
                ups=self.ups[members],
                labels=np.zeros_like(members),
            )
            yield members, part

    def around(self, poses: Poses, fixed: NDArray[np.bool_]) -> Poses:
        """Lays out the nodes that are not fixed."""
        poses, fixed = poses.copy(), fixed.copy()
        taken = fixed.copy()
        fresh = []
        for members, part in self._parts():
            if not fixed[members].any():
                fresh.append((members, part))
                continue
            inside, placed = poses.some(members), fixed[members]
            if self.rest is None:
                part._keep_largest_part(inside, placed)
            poses.put(members, part._solved(inside, placed))
            taken[members] = True
        right_m = self._right_m(poses, taken)
        for members, part in fresh:
            if len(members) > 1:
                alone = part._laid_out_alone(poses.some(members))
                if right_m is not None:
                    alone.translations[:, 0] += right_m - alone.translations[:, 0].min()
                poses.put(members, alone)
                most_m = float(alone.translations[:, 0].max()) + self.config.apart_m
                right_m = most_m if right_m is None else max(right_m, most_m)
                taken[members] = True
        self._line_up(poses, [int(one[0]) for one, _ in fresh if len(one) == 1], taken)
        return poses

    def _line_up(self, poses: Poses, alone: list[int], taken: NDArray[np.bool_]) -> None:
        """Places nodes without edges next to all others, in one pass: a map may hold thousands."""
        if not alone:
            return
        right_m, apart_m = self._right_m(poses, taken) or 0.0, self.config.apart_m
        for node, up in zip(alone, self.ups[alone] @ MAP_FROM_CAMERA.T, strict=True):
            levelled = _level_turn(up, MAP_FROM_CAMERA[:, 2])
            poses.set(node, SE3(levelled @ MAP_FROM_CAMERA, np.array([right_m, 0.0, 0.0])))
            right_m += apart_m

    def _right_m(self, poses: Poses, taken: NDArray[np.bool_]) -> float | None:
        """Where the next component begins; None for the first."""
        placed_m = [] if self.rest is None or self.rest.right_m is None else [self.rest.right_m]
        if taken.any():
            placed_m.append(float(poses.translations[taken, 0].max()))
        return max(placed_m) + self.config.apart_m if placed_m else None

    def adjusted_whole(self, poses: Poses) -> Poses:
        """All components adjusted from where they are, each with its first node fixed."""
        free = np.ones(len(self.labels), np.bool_)
        for members in grouped(self.labels):
            free[members[0]] = False
        start = poses.copy()
        self._chain(start, ~free)
        priors = self._level()
        return adjust(start, self.measured, free, self.config.adjust, priors).poses

    def fitted(self, poses: Poses, members: Indices, anchored: Anchored) -> Poses:
        """A component moved to its anchors, then adjusted to them."""
        map_from_old = fit_level(poses.translations[anchored.at], anchored.positions)
        for node in members.tolist():
            poses.set(node, map_from_old @ poses.pose(node))
        free = np.zeros(len(self.labels), np.bool_)
        free[members] = True
        level = self._level()
        priors = replace(
            level, at=anchored.at, positions=anchored.positions, sigmas_m=anchored.sigmas_m
        )
        # From here on it is nearly right, so the kernel may be narrow.
        config = replace(self.config.adjust, widest=4.0)
        return adjust(poses, self.measured, free, config, priors).poses

    def set_beside(self, poses: Poses, members: Indices, taken: NDArray[np.bool_]) -> Poses:
        """Moves a component to the right of all others; the first one stays at its origin."""
        right_m = self._right_m(poses, taken)
        if right_m is None:
            return poses
        shift = np.array([right_m - poses.translations[members, 0].min(), 0.0, 0.0])
        poses = poses.copy()
        poses.translations[members] += shift
        return poses

    def _keep_largest_part(self, poses: Poses, fixed: NDArray[np.bool_]) -> None:
        """Of placed parts that no fitting edge holds together only the largest stays."""
        from scipy.cluster.hierarchy import DisjointSet

        inside = fixed.copy()
        both = inside[self.ends].all(axis=1)
        off_m = np.linalg.norm(self.measured.residuals(poses)[:, :3], axis=1)
        fitting = self.ends[both & (off_m <= self.config.fits_m)]
        labels = labels_of(fitting, len(fixed))[inside]
        if (labels == labels[0]).all():
            return  # as nearly always; what follows goes node by node
        parts = DisjointSet(np.flatnonzero(inside).tolist())
        for a, b in fitting.tolist():
            parts.merge(a, b)
        # Through nodes that are not placed a part may hang together, too: those between them.
        largest = max(parts.subsets(), key=lambda part: (len(part), -min(part)))
        if parts.n_subsets > 1:
            self._join_through_new(poses, parts, fixed)
            largest = max(parts.subsets(), key=lambda part: (len(part), -min(part)))
        fixed[inside] = False
        fixed[sorted(largest)] = True

    def _join_through_new(self, poses: Poses, parts: DisjointSet, fixed: NDArray[np.bool_]) -> None:
        """Joins placed parts whose chain through new nodes fits their places."""
        new = ~fixed[self.ends].all(axis=1)
        trial = poses.copy()
        reached = self._chain(trial, fixed)
        off_m = np.linalg.norm(self.measured.residuals(trial)[:, :3], axis=1)
        joined: dict[int, int] = {}

        def root(node: int) -> int | None:
            return node if fixed[node] else joined.get(node)

        for node in np.flatnonzero(~fixed).tolist():
            joined[node] = int(reached[node])
        for row in np.flatnonzero(new & (off_m <= self.config.fits_m)).tolist():
            a, b = (root(int(end)) for end in self.ends[row])
            if a in parts and b in parts:
                parts.merge(a, b)

    def _solved(self, poses: Poses, fixed: NDArray[np.bool_]) -> Poses:
        if fixed.all():
            return poses
        self._chain(poses, fixed)
        return adjust(poses, self.measured, ~fixed, self.config.adjust, self._level()).poses

    def _laid_out_alone(self, poses: Poses) -> Poses:
        """A component by itself: its first node at the origin, level, looking along x."""
        poses.set(0, SE3(MAP_FROM_CAMERA.copy(), np.zeros(3)))
        free = np.ones(len(self.labels), np.bool_)
        free[0] = False
        self._chain(poses, ~free)
        poses = adjust(poses, self.measured, free, self.config.adjust).poses
        up = np.einsum("nij,nj->i", poses.rotations, self.ups)
        levelled = _level_turn(up, poses.rotations[0][:, 2])
        return Poses(levelled @ poses.rotations, poses.translations @ levelled.T)

    def _chain(self, poses: Poses, fixed: NDArray[np.bool_]) -> Indices:
        """Places nodes along the surest chains from fixed ones; returns the root of each."""
        return follow_chains(poses, self.edges, self.ends, (~fixed, fixed))

    def _level(self) -> Priors:
        """Priors that cameras stand upright on the ground, as their motion shows."""
        nothing = Priors.none(len(self.ups))
        return replace(nothing, ups=self.ups, level_rad=self.config.level_rad)


def follow_chains(
    poses: Poses,
    edges: Sequence[Edge],
    ends: Indices,
    wanted_and_fixed: tuple[NDArray[np.bool_], NDArray[np.bool_]],
) -> Indices:
    """Places nodes along the surest chains from fixed ones.

    Args:
        poses: of all nodes; those of the wanted ones are set.
        edges: E edges.
        ends: (E, 2) int64, dense indices of their ends a and b.
        wanted_and_fixed: (N,) bool each.

    Returns:
        (N,) int64: the fixed node from which each one was reached; itself if none.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    wanted, fixed = wanted_and_fixed
    reached, roots = np.arange(len(fixed)), np.flatnonzero(fixed)
    if not len(roots) or not len(edges):
        return reached
    spread = [np.trace(edge.covariance[:3, :3]) + _DOUBT_M2[edge.kind] for edge in edges]
    variance = np.array(spread) + 1e-9
    low, high = ends.min(axis=1), ends.max(axis=1)
    # Of parallel edges the surest counts.
    best = {(int(low[row]), int(high[row])): int(row) for row in np.argsort(-variance)}
    rows = np.array(list(best.values()), np.int64)
    shape = (len(fixed),) * 2
    links = coo_matrix((variance[rows], (low[rows], high[rows])), shape=shape).tocsr()
    distance, before, sources = dijkstra(
        links, directed=False, indices=roots, min_only=True, return_predecessors=True
    )
    for node in np.argsort(distance, kind="stable").tolist():
        if not wanted[node] or not np.isfinite(distance[node]):
            continue
        last = int(before[node])
        row = best[min(node, last), max(node, last)]
        step = edges[row].a_from_b
        step = step if ends[row, 0] == last else step.inverse()
        poses.set(node, (poses.pose(last) @ step).renormalised())
        reached[node] = sources[node]
    return reached


def chain_poses(edges: Sequence[Edge], ends: Indices, count: int) -> tuple[Poses, Indices]:
    """Poses of all nodes along the surest chains, and the first node of each component.

    Args:
        edges: E edges.
        ends: (E, 2) indices of their nodes.
        count: number of nodes.

    Returns:
        The poses, each in the frame of its component's first node; (C,) indices of those nodes.
    """
    labels = labels_of(ends, count)
    roots = np.unique(labels, return_index=True)[1]
    fixed = np.zeros(count, np.bool_)
    fixed[roots] = True
    poses = Poses.identity(count)
    follow_chains(poses, edges, ends, (~fixed, fixed))
    return poses, roots


def fit_level(old: Array, new: Array) -> SE3:
    """The turn about the vertical and the shift that bring positions nearest to others.

    Robust: pairs that lie far off after a first fit lose their weight.

    Args:
        old: (P, 3) float64, metres.
        new: (P, 3) float64, metres; NaN for an unknown height.
    """
    heights = np.isfinite(new[:, 2])
    weights = np.ones(len(old))
    for _ in range(20):
        total = weights.sum()
        mean_old, mean_new = (weights @ points[:, :2] / total for points in (old, new))
        x, y = (old[:, :2] - mean_old).T
        u, v = (new[:, :2] - mean_new).T
        yaw = np.arctan2(weights @ (x * v - y * u), weights @ (x * u + y * v))
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        shift = np.append(mean_new, 0.0) - turn @ np.append(mean_old, 0.0)
        off_m = np.linalg.norm((old @ turn.T + shift - new)[:, :2], axis=1)
        scale = max(float(np.median(off_m)), 0.1)
        weights = 1.0 / (1.0 + (off_m / (2 * scale)) ** 2)
    if heights.any():
        shift[2] = np.median(new[heights, 2] - old[heights, 2])
    return SE3(turn, shift)


def _used(
    edges: Sequence[Edge], ends: Indices, held: Indices, count: int
) -> tuple[list[Edge], Indices]:
    """The measured edges, and those predicted ones without which parts would be apart."""
    from scipy.cluster.hierarchy import DisjointSet

    derived = np.array([edge.kind is EdgeKind.PROXIMITY for edge in edges], np.bool_)
    measured = labels_of(np.concatenate([ends[~derived], held]), count)
    parts = DisjointSet(range(int(measured.max(initial=-1)) + 1))
    kept = ~derived
    spread = [
        float(np.trace(edges[row].covariance[:3, :3])) for row in np.flatnonzero(derived).tolist()
    ]
    for row in np.flatnonzero(derived)[np.argsort(spread, kind="stable")].tolist():
        a, b = measured[ends[row]].tolist()
        kept[row] = parts.merge(a, b)
    rows = np.flatnonzero(kept)
    return [edges[row] for row in rows.tolist()], ends[rows].reshape(-1, 2)


def _ups(
    cameras: Sequence[str], edges: Sequence[Edge], ends: Indices, moved: Mapping[str, Array]
) -> Array:
    """(N, 3): the direction in each node's camera that is up, as the camera's motion shows."""
    forward = {camera: shift.copy() for camera, shift in moved.items()}
    for edge, (_, b) in zip(edges, ends.tolist(), strict=True):
        if edge.kind is EdgeKind.ODOMETRY:
            known = forward.setdefault(cameras[b], np.zeros(3))
            known += edge.a_from_b.translation
    up_of = {camera: _up(forward.get(camera, np.zeros(3))) for camera in dict.fromkeys(cameras)}
    return np.array([up_of[camera] for camera in cameras]).reshape(-1, 3)


def _misfit_m(before: Poses, after: Poses, members: Indices) -> Array:
    """How far nodes moved against the others, by a robust fit of one to the other."""
    old, new = after.translations[members], before.translations[members]
    fitted = fit_level(old, new)
    return np.asarray(np.linalg.norm(fitted @ old - new, axis=1))


def _up(forward: Array) -> Array:
    """The direction in a camera that is up: against its y axis, square to how it moves."""
    up = np.array([0.0, -1.0, 0.0])
    length = float(np.linalg.norm(forward))
    if length > 1.0:
        along = forward / length
        up = up - (up @ along) * along
    return np.asarray(up / np.linalg.norm(up))


def _level_turn(up: Array, forward: Array) -> Array:
    """(3, 3): the turn that brings `up` to z, and `forward` over x."""
    z = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-9 else np.array([0.0, 0.0, 1.0])
    x = forward - (forward @ z) * z
    length = np.linalg.norm(x)
    x = x / length if length > 1e-6 else np.cross(z, np.array([0.0, 1.0, 0.0]))
    return np.stack([x, np.cross(z, x), z])
