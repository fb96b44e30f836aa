"""The plain pipeline that Engram is measured against: OpenCV + NumPy + PoseLib, one thread.

It is what a good engineer writes in a day with the usual libraries, every loop over features
vectorised: FAST with a grid, BRIEF, stereo by features found in both images and matched along the
row, sub-pixel by SAD; guided matching, PoseLib's absolute pose, refinement of the stereo
reprojection error; brute-force matching for localisation; SciPy's sparse least squares for the
window. It shares no algorithm with Engram, so it is an independent check of accuracy, too.

Arrays: pixels (N, 2) left u, v; stereo (N, 3) left u, left v, right u; points (N, 3) metres in the
left camera. Poses are 4×4 matrices named target_from_source.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from engram_lab.opencv_contrib import xfeatures2d

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

ROW_TOLERANCE_PX = 1
SAD_RADIUS_PX = 4
STEREO_INLIER_PX = 2.0


@dataclass(frozen=True)
class Camera:
    """A rectified stereo pair: focal length and principal point in px, baseline in metres."""

    fx: float
    fy: float
    cx: float
    cy: float
    baseline_m: float
    width: int
    height: int

    def project(self, points: Floats) -> Floats:
        """Stereo pixels (N, 3) of points (N, 3)."""
        u = self.fx * points[:, 0] / points[:, 2] + self.cx
        v = self.fy * points[:, 1] / points[:, 2] + self.cy
        return np.column_stack([u, v, u - self.fx * self.baseline_m / points[:, 2]])

    def triangulate(self, stereo: Floats) -> Floats:
        """Points (N, 3) of stereo pixels (N, 3)."""
        depth = self.fx * self.baseline_m / (stereo[:, 0] - stereo[:, 2])
        x = (stereo[:, 0] - self.cx) / self.fx * depth
        y = (stereo[:, 1] - self.cy) / self.fy * depth
        return np.column_stack([x, y, depth])

    def as_poselib(self) -> dict[str, object]:
        """The left camera in PoseLib's terms."""
        parameters = [self.fx, self.fy, self.cx, self.cy]
        size = {"width": self.width, "height": self.height}
        return {"model": "PINHOLE", "params": parameters, **size}


@dataclass(frozen=True)
class Features:
    """Landmarks of one stereo pair.

    Attributes:
        stereo: (N, 3) float64 left u, left v, right u, px.
        points: (N, 3) float64 metres.
        words: (N, 4) uint64 BRIEF-256.
    """

    detected: int
    stereo: Floats
    points: Floats
    words: NDArray[np.uint64]


class FrontEnd:
    """Stereo pair → `Features`."""

    def __init__(self, camera: Camera, features: int, cell_px: int = 32) -> None:
        self.camera = camera
        self._features = features
        self._cell_px = cell_px
        cells = -(-camera.width // cell_px) * -(-camera.height // cell_px)
        self._per_cell = max(1, round(2.5 * features / cells))
        # At a lower threshold most of the time goes into corners that the grid throws away.
        self._fast = cv2.FastFeatureDetector.create(20, True)
        self._brief = xfeatures2d("the plain pipeline").BriefDescriptorExtractor.create(32)

    def extract(self, left: Bytes, right: Bytes, max_disparity_px: float = 124.0) -> Features:
        """Corners in both images, matched along the row, disparity to a fraction of a pixel."""
        left_at, left_words = self._describe(left)
        right_at, right_words = self._describe(right)
        pairs = match_rows(left_at, left_words, right_at, right_words, max_disparity_px)
        at = left_at[pairs[:, 0]].astype(np.int64)
        right_u = right_at[pairs[:, 1], 0].astype(np.int64)
        offset, usable = refine_disparity(left, right, at, right_u)
        stereo = np.column_stack([at, right_u + offset])
        usable &= stereo[:, 0] - stereo[:, 2] > 0.5
        stereo, words = stereo[usable], left_words[pairs[usable, 0]]
        return Features(len(left_at), stereo, self.camera.triangulate(stereo), words)

    def _describe(self, image: Bytes) -> tuple[NDArray[np.float32], NDArray[np.uint64]]:
        keypoints = self._fast.detect(image, None)
        at = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32)
        response = np.fromiter((k.response for k in keypoints), np.float32, len(keypoints))
        kept = self._spread(at, response)
        chosen, words = self._brief.compute(image, [keypoints[i] for i in kept])
        return np.asarray(cv2.KeyPoint.convert(chosen), np.float32), words.view(np.uint64)

    def _spread(self, at: NDArray[np.float32], response: NDArray[np.float32]) -> NDArray[np.int64]:
        """The best corners of each cell, then the best of those."""
        columns = -(-self.camera.width // self._cell_px)
        cell = (at[:, 1] // self._cell_px * columns + at[:, 0] // self._cell_px).astype(np.int64)
        order = np.lexsort((-response, cell))
        starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
        rank = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
        kept = order[rank < self._per_cell]
        return kept[np.argsort(-response[kept])[: self._features]]


def match_rows(
    left_at: NDArray[np.float32],
    left_words: NDArray[np.uint64],
    right_at: NDArray[np.float32],
    right_words: NDArray[np.uint64],
    max_disparity_px: float,
) -> NDArray[np.int64]:
    """Pairs (M, 2) of corners on the same row ± 1 px: mutual best, ratio 0.9, at most 80 bits."""
    order = np.argsort(right_at[:, 1], kind="stable")
    rows = right_at[order, 1]
    first = np.searchsorted(rows, left_at[:, 1] - ROW_TOLERANCE_PX, side="left")
    counts = np.searchsorted(rows, left_at[:, 1] + ROW_TOLERANCE_PX, side="right") - first
    a = np.repeat(np.arange(len(left_at)), counts)
    within = np.arange(len(a)) - np.repeat(np.cumsum(counts) - counts, counts)
    b = order[np.repeat(first, counts) + within]
    disparity = left_at[a, 0] - right_at[b, 0]
    near = (disparity >= 0) & (disparity <= max_disparity_px)
    return mutual_best(a[near], b[near], left_words, right_words, 0.9, 80)


def mutual_best(
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    a_words: NDArray[np.uint64],
    b_words: NDArray[np.uint64],
    ratio: float,
    most_bits: int,
) -> NDArray[np.int64]:
    """Of candidate pairs (a, b), those that are each other's best and pass the ratio test."""
    bits = np.bitwise_count(a_words[a] ^ b_words[b]).sum(axis=1).astype(np.int64)
    order = np.lexsort((bits, a))
    a, b, bits = a[order], b[order], bits[order]
    starts = np.flatnonzero(np.diff(a, prepend=-1))
    ends = np.append(starts[1:], len(a))
    second = np.where(ends - starts > 1, bits[np.minimum(starts + 1, len(bits) - 1)], 257)
    best_of_b = np.full(len(b_words), 257)
    np.minimum.at(best_of_b, b, bits)
    a, b, bits = a[starts], b[starts], bits[starts]
    good = (bits <= most_bits) & (bits < ratio * second) & (bits == best_of_b[b])
    return np.column_stack([a[good], b[good]])


def refine_disparity(
    left: Bytes, right: Bytes, at: NDArray[np.int64], right_u: NDArray[np.int64]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Sub-pixel offset of the right position by the parabola through SAD costs at −2 … 2 px.

    The best whole offset must be −1, 0 or 1; windows are 9×9 px.
    """
    around = np.arange(-SAD_RADIUS_PX, SAD_RADIUS_PX + 1)
    rows = at[:, 1, None] + around
    patch = left[rows[:, :, None], (at[:, 0, None] + around)[:, None, :]].astype(np.int16)
    reach = np.arange(-SAD_RADIUS_PX - 2, SAD_RADIUS_PX + 3)
    columns = right_u[:, None] + reach
    usable = (columns[:, 0] >= 0) & (columns[:, -1] < right.shape[1])
    columns = np.clip(columns, 0, right.shape[1] - 1)
    strip = right[rows[:, :, None], columns[:, None, :]].astype(np.int16)
    width = len(around)
    costs = np.stack(
        [np.abs(patch - strip[:, :, k : k + width]).sum(axis=(1, 2)) for k in range(5)], axis=1
    )
    best = np.argmin(costs, axis=1)
    usable &= (best > 0) & (best < 4)
    best = np.clip(best, 1, 3)
    each = np.arange(len(costs))
    low, here, high = costs[each, best - 1], costs[each, best], costs[each, best + 1]
    curvature = np.maximum(low + high - 2 * here, 1)
    return best - 2 + 0.5 * (low - high) / curvature, usable


def match_near(
    reference: Features, live: Features, live_from_reference: Floats, camera: Camera, radius_px: int
) -> NDArray[np.int64]:
    """Pairs (M, 2) of landmarks whose live pixel lies near the predicted one."""
    points = reference.points @ live_from_reference[:3, :3].T + live_from_reference[:3, 3]
    points[:, 2] = np.maximum(points[:, 2], 0.1)
    predicted = camera.project(points).astype(np.float32)
    seen = live.stereo.astype(np.float32)
    near = np.abs(predicted[:, 0, None] - seen[:, 0]) < radius_px
    near &= np.abs(predicted[:, 1, None] - seen[:, 1]) < radius_px
    a, b = np.nonzero(near)
    return mutual_best(a, b, reference.words, live.words, 0.9, 80)


def match_all(reference: Features, live: Features) -> NDArray[np.int64]:
    """Pairs (M, 2) by brute force: mutual best, ratio 0.85, at most 80 bits."""
    # Three times faster than cv2.batchDistance with K = 2 one way and K = 1 the other.
    a, b = reference.words, live.words
    bits = np.bitwise_count(a[:, 0, None] ^ b[:, 0]).astype(np.int16)
    for word in range(1, 4):
        bits += np.bitwise_count(a[:, word, None] ^ b[:, word])
    best = np.argmin(bits, axis=1)
    each = np.arange(len(bits))
    least = bits[each, best]
    good = (least <= 80) & (np.argmin(bits, axis=0)[best] == each)
    rows, own = each[good], best[good]
    rivals = bits[rows]
    rivals[np.arange(len(rows)), own] = 257
    unique = least[rows] < 0.85 * rivals.min(axis=1)
    return np.column_stack([rows[unique], own[unique]])


@dataclass(frozen=True)
class Pose:
    """A pose with the matched pairs (M, 2) that agree with it."""

    live_from_reference: Floats
    inliers: NDArray[np.int64]


def estimate_pose(
    reference: Features, live: Features, pairs: NDArray[np.int64], camera: Camera
) -> Pose | None:
    """PoseLib's RANSAC on 3D–2D, refinement of the stereo reprojection error, stereo inliers."""
    if len(pairs) < 4:
        return None
    points, stereo = reference.points[pairs[:, 0]], live.stereo[pairs[:, 1]]
    found, _ = poselib.estimate_absolute_pose(
        stereo[:, :2],
        points,
        camera.as_poselib(),
        {
            "max_reproj_error": STEREO_INLIER_PX,
            "min_iterations": 20,
            "max_iterations": 1000,
            "success_prob": 0.99,
        },
        {"loss_type": "CAUCHY", "max_iterations": 10},
    )
    pose = np.eye(4)
    pose[:3] = found.Rt
    pose = refine_pose(pose, points, stereo, camera)
    error = stereo_residuals(pose, points, stereo, camera)
    return Pose(pose, pairs[(error**2).sum(axis=1) < STEREO_INLIER_PX**2 * 2])


def stereo_residuals(pose: Floats, points: Floats, stereo: Floats, camera: Camera) -> Floats:
    """Residuals (N, 3), px, of left u, left v, right u; far off for points behind the camera."""
    moved = points @ pose[:3, :3].T + pose[:3, 3]
    behind = moved[:, 2] < 0.1
    moved[behind, 2] = 0.1
    error = camera.project(moved) - stereo
    error[behind] = 1e3
    return error


def refine_pose(
    pose: Floats, points: Floats, stereo: Floats, camera: Camera, iterations: int = 6
) -> Floats:
    """Gauss–Newton with Geman–McClure weights of the stereo reprojection error, left perturbation.

    Tangents are [translation, rotation].
    """
    for _ in range(iterations):
        error = stereo_residuals(pose, points, stereo, camera)
        weights = 1 / (1 + (error**2).sum(axis=1)) ** 2
        moved = points @ pose[:3, :3].T + pose[:3, 3]
        jacobian = stereo_jacobian(moved, camera)
        weighted = jacobian * weights[:, None, None]
        hessian = np.einsum("nki,nkj->ij", weighted, jacobian, optimize=True)
        gradient = np.einsum("nki,nk->i", weighted, error)
        step = -np.linalg.solve(hessian + 1e-9 * np.eye(6), gradient)
        pose = perturbation(step) @ pose
        if np.abs(step).max() < 1e-7:
            break
    return pose


def stereo_jacobian(moved: Floats, camera: Camera) -> Floats:
    """(N, 3, 6): stereo pixels by a left perturbation of the pose, at points already moved."""
    by_point = projection_jacobian(moved, camera)
    x, y, z = moved.T
    zero = np.zeros_like(x)
    by_rotation = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return np.concatenate([by_point, by_point @ by_rotation], axis=2)


def projection_jacobian(points: Floats, camera: Camera) -> Floats:
    """(N, 3, 3): stereo pixels by the point."""
    x, y, z = points.T
    jacobian = np.zeros((len(points), 3, 3))
    jacobian[:, 0, 0] = jacobian[:, 2, 0] = camera.fx / z
    jacobian[:, 1, 1] = camera.fy / z
    jacobian[:, 0, 2] = -camera.fx * x / z**2
    jacobian[:, 1, 2] = -camera.fy * y / z**2
    jacobian[:, 2, 2] = jacobian[:, 0, 2] + camera.fx * camera.baseline_m / z**2
    return jacobian


def perturbation(tangent: Floats) -> Floats:
    """4×4 transform of a small tangent [translation, rotation]."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(tangent[3:]).as_matrix()
    matrix[:3, 3] = tangent[:3]
    return matrix


class Odometry:
    """Frame-to-frame motion under a constant-velocity prediction."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._previous: Features | None = None
        self._velocity = np.eye(4)  # curr_from_prev

    def step(self, features: Features) -> Pose | None:
        """Motion since the previous frame; None for the first one or where none is found."""
        previous, self._previous = self._previous, features
        if previous is None:
            return None
        pairs = match_near(previous, features, self._velocity, self._camera, radius_px=40)
        pose = estimate_pose(previous, features, pairs, self._camera)
        self._velocity = np.eye(4) if pose is None else pose.live_from_reference
        return pose


def attempt(reference: Features, live: Features, camera: Camera) -> Pose | None:
    """One localisation attempt without a prediction."""
    return estimate_pose(reference, live, match_all(reference, live), camera)


def adjust_window(
    cam_from_world: Floats,
    points: Floats,
    frame_of: NDArray[np.int64],
    point_of: NDArray[np.int64],
    stereo: Floats,
    camera: Camera,
) -> tuple[Floats, Floats, float]:
    """Windowed bundle adjustment by SciPy's sparse least squares, the first pose held.

    Args:
        cam_from_world: (F, 4, 4) initial poses.
        points: (P, 3) initial points in the world.
        frame_of: (M,) the frame of each observation.
        point_of: (M,) the point of each observation.
        stereo: (M, 3) what it sees.

    Returns:
        Adjusted poses and points, and the mean squared residual per observation, px².
    """
    frames, count = len(cam_from_world), len(points)
    pose_columns = 6 * (frames - 1)

    def unpack(state: Floats) -> tuple[Floats, Floats]:
        moved = cam_from_world.copy()
        for frame in range(1, frames):
            moved[frame] = perturbation(state[6 * (frame - 1) : 6 * frame]) @ moved[frame]
        return moved, points + state[pose_columns:].reshape(-1, 3)

    def residuals(state: Floats) -> Floats:
        poses, world = unpack(state)
        seen = np.einsum("mij,mj->mi", poses[frame_of, :3, :3], world[point_of])
        return (camera.project(seen + poses[frame_of, :3, 3]) - stereo).ravel()

    def jacobian(state: Floats) -> csr_matrix:
        poses, world = unpack(state)
        rotations = poses[frame_of, :3, :3]
        seen = np.einsum("mij,mj->mi", rotations, world[point_of]) + poses[frame_of, :3, 3]
        by_pose = stereo_jacobian(seen, camera)
        by_point = projection_jacobian(seen, camera) @ rotations
        values = np.concatenate([by_pose, by_point], axis=2)
        values[frame_of == 0, :, :6] = 0
        columns = np.concatenate(
            [
                np.maximum(6 * (frame_of[:, None] - 1), 0) + np.arange(6),
                pose_columns + 3 * point_of[:, None] + np.arange(3),
            ],
            axis=1,
        )
        columns = np.repeat(columns[:, None, :], 3, axis=1)
        row_starts = np.arange(0, values.size + 1, 9)
        shape = (3 * len(stereo), pose_columns + 3 * count)
        return csr_matrix((values.ravel(), columns.ravel(), row_starts), shape=shape)

    start = np.zeros(pose_columns + 3 * count)
    solved = least_squares(
        residuals, start, jacobian, loss="huber", x_scale="jac", ftol=1e-4, max_nfev=10
    )
    poses, world = unpack(solved.x)
    return poses, world, float((solved.fun**2).sum() / len(stereo))
