"""A plain twin of `_core.adjust_window`: NumPy residuals, SciPy's solver, dense everything."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from engram.geometry import SE3, StereoCamera


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
) -> np.ndarray:
    """(K, 3) residuals in standard deviations; `sigmas` is (K, 3)."""
    in_cam = np.array(
        [world_from_cam[f].inverse() @ points[t] for f, t in zip(frame, track, strict=True)]
    )
    return (project(camera, in_cam) - stereo) / sigmas


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
) -> tuple[list[SE3], float, np.ndarray]:
    """Minimises Σ χ² / (1 + χ²/scale) over the free poses and all points.

    Returns:
        The poses, the cost, and the covariance of the free poses by plain inversion of the dense
        Gauss–Newton matrix with Geman–McClure weights.
    """
    free = len(world_from_cam) - fixed

    def unpack(x: np.ndarray) -> tuple[list[SE3], np.ndarray]:
        moved = [
            SE3.exp(step) @ pose
            for step, pose in zip(x[: 6 * free].reshape(-1, 6), world_from_cam[fixed:], strict=True)
        ]
        return world_from_cam[:fixed] + moved, points + x[6 * free :].reshape(-1, 3)

    def whitened(x: np.ndarray) -> np.ndarray:
        return chi2_of(camera, *unpack(x), frame, track, stereo, sigmas)

    def robust(x: np.ndarray) -> np.ndarray:
        # Residuals whose squares sum to the robust cost.
        chi2 = (whitened(x) ** 2).sum(axis=1)
        return np.sqrt(chi2 / (1 + chi2 / scale))

    start = np.zeros(6 * free + 3 * len(points))

    # The square root above has a kink at zero, so its parts are what the solver gets.
    def parts(x: np.ndarray) -> np.ndarray:
        r = whitened(x)
        chi2 = (r**2).sum(axis=1, keepdims=True)
        return (r / np.sqrt(1 + chi2 / scale)).ravel()

    x = least_squares(parts, start, method="trf", x_scale="jac", xtol=1e-12, ftol=1e-12).x
    poses, moved_points = unpack(x)
    return (
        poses,
        float((robust(x) ** 2).sum()),
        _covariance(camera, poses, moved_points, frame, track, stereo, sigmas, fixed, scale),
    )


def _covariance(camera, poses, points, frame, track, stereo, sigmas, fixed, scale) -> np.ndarray:
    free = len(poses) - fixed
    size = 6 * free + 3 * len(points)

    def whitened(x: np.ndarray) -> np.ndarray:
        moved = [
            SE3.exp(step) @ pose
            for step, pose in zip(x[: 6 * free].reshape(-1, 6), poses[fixed:], strict=True)
        ]
        return chi2_of(
            camera,
            poses[:fixed] + moved,
            points + x[6 * free :].reshape(-1, 3),
            frame,
            track,
            stereo,
            sigmas,
        )

    step = 1e-6
    jacobian = np.empty((3 * len(frame), size))
    for i in range(size):
        at = np.zeros(size)
        at[i] = step
        jacobian[:, i] = ((whitened(at) - whitened(-at)) / (2 * step)).ravel()
    chi2 = (whitened(np.zeros(size)) ** 2).sum(axis=1)
    weights = np.repeat((1 + chi2 / scale) ** -2, 3)
    information = jacobian.T @ (weights[:, None] * jacobian)
    return np.linalg.inv(information)[: 6 * free, : 6 * free]
