"""Frames of a random cloud of points, with noise as the front-end has it, and known poses."""

from __future__ import annotations

import numpy as np

from engram.frontend.frame import BRIEF, Frame, FrameStatus, Landmarks
from engram.frontend.matching import MatcherConfig
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3

CAMERA = StereoCamera(fx=300.0, fy=300.0, cx=255.0, cy=190.0, baseline_m=0.3, width=512, height=384)
# What the scenes' noise is: independent, without a common offset.
AS_SIMULATED = MatcherConfig(
    pixel_sigma_px=0.5,
    disparity_sigma_px=1e-6,
    offset_sigma_px=1e-3,
    offset_drift_px=1e-3,
    independent_landmarks=1e9,
    few_inliers=0,
    displaced_m=0,
    offset_doubt=0,
    calibration_share=0,
    calibration_m=0,
    calibration_rad=0,
)


class Scene:
    """Points in the world, each with a descriptor of its own."""

    def __init__(self, count: int, seed: int, camera: StereoCamera = CAMERA) -> None:
        self.rng = np.random.default_rng(seed)
        depth = self.rng.uniform(4, 25, count)
        u = self.rng.uniform(0, camera.width, count)
        v = self.rng.uniform(0, camera.height, count)
        self.points = np.column_stack(
            [(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth]
        )
        self.descriptors = self.rng.integers(0, 256, (count, 32), dtype=np.uint8)

    def seen_from(
        self,
        world_from_cam: SE3,
        camera: StereoCamera = CAMERA,
        *,
        pixel_sigma_px: float = 0.5,
        disparity_sigma_px: float = 0.15,
        offset_px: float = 0.0,
        flipped_bits: float = 0.08,
        outliers: float = 0.0,
        stamp_ns: int = 0,
    ) -> tuple[Frame, np.ndarray]:
        """A frame, and for each landmark the row of its point (−1 for an outlier).

        `offset_px` is what all disparities are too large by. An outlier has the descriptor of a
        point and the place of another.
        """
        rng = self.rng
        points = world_from_cam.inverse() @ self.points
        z = points[:, 2]
        front = z > 0.5
        pixels = np.zeros((len(points), 2))
        pixels[front, 0] = camera.fx * points[front, 0] / z[front] + camera.cx
        pixels[front, 1] = camera.fy * points[front, 1] / z[front] + camera.cy
        inside = front & (pixels >= 0).all(axis=1)
        inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        rows = np.flatnonzero(inside)
        rng.shuffle(rows)
        pixels = pixels[rows] + rng.normal(0, pixel_sigma_px, (len(rows), 2))
        disparity = (
            camera.focal_baseline / z[rows]
            + offset_px
            + rng.normal(0, disparity_sigma_px, len(rows))
        )
        disparity = np.maximum(disparity, 0.3).astype(np.float32)
        flips = rng.random((len(rows), 256)) < flipped_bits
        descriptors = self.descriptors[rows] ^ np.packbits(flips, axis=1)
        wrong = np.flatnonzero(rng.random(len(rows)) < outliers)
        descriptors[wrong] = descriptors[np.roll(wrong, 1)]
        rows[wrong] = -1
        pixels = pixels.astype(np.float32)
        sigma = np.full(len(rows), disparity_sigma_px, np.float32)
        return (
            Frame(
                stamp_ns=stamp_ns,
                camera=camera,
                landmarks=Landmarks(
                    pixels=pixels,
                    disparity_px=disparity,
                    disparity_sigma_px=sigma,
                    points_in_cam=camera.triangulate(pixels, disparity),
                    descriptors=descriptors,
                    octaves=np.zeros(len(rows), np.uint8),
                ),
                descriptor=BRIEF,
                frontend="test",
                status=FrameStatus.OK,
            ),
            rows,
        )


def normalised_error(found: SE3, covariance: np.ndarray, truth: SE3) -> float:
    """Squared Mahalanobis distance of the error; its mean is 6 where the covariance is honest."""
    error = (found @ truth.inverse()).log()
    return float(error @ np.linalg.solve(covariance, error))
