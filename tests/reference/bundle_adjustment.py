"""A plain twin of `_core.adjust_window`: NumPy residuals, SciPy's solver, dense everything."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3


def project(camera: StereoCamera, points_in_cam: np.ndarray) -> np.ndarray:
    """(N, 3) left u, left v, disparity."""
    x, y, z = points_in_cam.T
    return np.column_stack(
        [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, camera.focal_baseline / z]
    )


def chi2_of(
    camera: StereoCamera,
    world_from_cam: list[SE3],
    points: np.ndarray,
    frame: np.ndarray,
    track: np.ndarray,
    stereo: np.ndarray,
    sigmas: np.ndarray,
    offset: float,
) -> np.ndarray:
    """(K, 3) residuals in standard deviations; `sigmas` is (K, 3)."""
    in_cam = np.array(
        [world_from_cam[f].inverse() @ points[t] for f, t in zip(frame, track, strict=True)]
    )
    return (project(camera, in_cam) + np.array([0, 0, offset]) - stereo) / sigmas


def adjust(
    camera: StereoCamera,
    world_from_cam: list[SE3],
    points: np.ndarray,
    frame: np.ndarray,
    track: np.ndarray,
    stereo: np.ndarray,
    sigmas: np.ndarray,
    *,
    fixed: int,
    scale: float,
    offset_sigma: float,
) -> tuple[list[SE3], float, float, np.ndarray]:
    """Minimises Σ χ² / (1 + χ²/scale) + (offset/σ)² over free poses, points and offset.

    Returns:
        The poses, the offset, the cost, and the covariance of the free poses by plain inversion of
        the dense Gauss–Newton matrix with Geman–McClure weights.
    """
    free = len(world_from_cam) - fixed
    observations = (frame, track, stereo, sigmas)

    def parts(x: np.ndarray) -> np.ndarray:
        poses, moved = _moved(x[1:], world_from_cam, points, fixed)
        r = chi2_of(camera, poses, moved, *observations, x[0])
        chi2 = (r**2).sum(axis=1, keepdims=True)
        # Residuals whose squares sum to the robust cost.
        return np.append((r / np.sqrt(1 + chi2 / scale)).ravel(), x[0] / offset_sigma)

    start = np.zeros(1 + 6 * free + 3 * len(points))
    x = least_squares(parts, start, method="trf", x_scale="jac", xtol=1e-12, ftol=1e-12).x
    poses, moved = _moved(x[1:], world_from_cam, points, fixed)
    covariance = _covariance(camera, poses, moved, *observations, x[0], fixed, scale, offset_sigma)
    return poses, x[0], float((parts(x) ** 2).sum()), covariance


def _moved(
    x: np.ndarray, poses: list[SE3], points: np.ndarray, fixed: int
) -> tuple[list[SE3], np.ndarray]:
    free = len(poses) - fixed
    steps = x[: 6 * free].reshape(-1, 6)
    free_poses = [SE3.exp(step) @ pose for step, pose in zip(steps, poses[fixed:], strict=True)]
    return poses[:fixed] + free_poses, points + x[6 * free :].reshape(-1, 3)


def _covariance(
    camera, poses, points, frame, track, stereo, sigmas, offset, fixed, scale, offset_sigma
) -> np.ndarray:
    free = len(poses) - fixed

    def whitened(x: np.ndarray) -> np.ndarray:
        moved_poses, moved = _moved(x[1:], poses, points, fixed)
        return chi2_of(camera, moved_poses, moved, frame, track, stereo, sigmas, offset + x[0])

    step = 1e-6
    size = 1 + 6 * free + 3 * len(points)
    jacobian = np.empty((3 * len(frame), size))
    for i in range(size):
        at = np.zeros(size)
        at[i] = step
        jacobian[:, i] = ((whitened(at) - whitened(-at)) / (2 * step)).ravel()
    chi2 = (whitened(np.zeros(size)) ** 2).sum(axis=1)
    weights = np.repeat((1 + chi2 / scale) ** -2, 3)
    information = jacobian.T @ (weights[:, None] * jacobian)
    information[0, 0] += offset_sigma**-2
    return np.linalg.inv(information)[1 : 1 + 6 * free, 1 : 1 + 6 * free]
