"""A world of points with descriptors, seen by an ideal front-end: frames without images.

Fast and exact: for tests of what comes after the front-end. Each appearance of the world has
descriptors of its own, so that frames of different appearances never match.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from engram.frontend.blobs import landmarks_from_codes, pixel_quantum, quantise
from engram.frontend.frame import BRIEF, Frame, FrameStatus
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.sequences.sequence import LoggedFrame

CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.3, 640, 480)
PERIOD_NS = 50_000_000


@dataclass
class World:
    """Walls of points on both sides of a road that follows `pose_at`.

    Attributes:
        length_m: of the road.
        radius_m: the road is a circle of this radius; infinite for a straight one.
        seed: of points and descriptors.
    """

    length_m: float = 60.0
    radius_m: float = np.inf
    seed: int = 0
    points: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        count = int(60 * self.length_m)
        along = rng.uniform(-10, self.length_m + 40, count)
        side = rng.choice([-1.0, 1.0], count) * rng.uniform(4.0, 7.0, count)
        height = rng.uniform(-4.0, 1.5, count)
        if np.isinf(self.radius_m):
            self.points = np.column_stack([side, height, along])
            return
        self.points = np.array(
            [
                self.pose_at(s) @ np.array([x, y, 0.0])
                for s, x, y in zip(along, side, height, strict=True)
            ]
        )

    def pose_at(self, s_m: float, aside_m: float = 0.0) -> SE3:
        """``world_from_camera`` after `s_m` of road, looking along it."""
        if np.isinf(self.radius_m):
            return SE3(np.eye(3), np.array([aside_m, 0.0, s_m]))
        angle = s_m / self.radius_m
        turn = SE3.exp([0, 0, 0, 0, angle, 0])
        centre = np.array([self.radius_m, 0.0, 0.0])
        arm = turn.rotation @ np.array([-self.radius_m + aside_m, 0.0, 0.0])
        return SE3(turn.rotation, centre + arm)

    def descriptors(self, appearance: int) -> np.ndarray:
        """(P, 32) uint8 of all points in one appearance of the world."""
        return _random_descriptors(len(self.points), self.seed, appearance)


@lru_cache(maxsize=8)
def _random_descriptors(count: int, seed: int, appearance: int) -> np.ndarray:
    rng = np.random.default_rng([seed, appearance])
    drawn = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    drawn.setflags(write=False)
    return drawn


def see(
    world: World,
    world_from_cam: SE3,
    stamp_ns: int,
    appearance: int = 0,
    noise_px: float = 0.3,
    camera: StereoCamera = CAMERA,
    count: int = 400,
) -> Frame:
    """The frame that an ideal front-end would make there, with noise of pixels and bits."""
    rng = np.random.default_rng([world.seed, stamp_ns & 0xFFFFFFFF, appearance])
    points = world_from_cam.inverse() @ world.points
    depth = points[:, 2]
    safe = np.maximum(depth, 0.1)
    u = camera.fx * points[:, 0] / safe + camera.cx
    v = camera.fy * points[:, 1] / safe + camera.cy
    seen = (depth > 2) & (depth < 40) & (u > 5) & (u < camera.width - 6)
    rows = np.flatnonzero(seen & (v > 5) & (v < camera.height - 6))
    rows = rng.permutation(rows)[:count]
    noisy = np.stack([u, v, camera.focal_baseline / safe], axis=1)[rows]
    noisy += rng.normal(0, noise_px, noisy.shape) * [1, 1, 0.5]
    flips = np.packbits(rng.random((len(rows), 256)) < 0.05, axis=1)
    codes = quantise(
        noisy[:, :2].astype(np.float32),
        np.maximum(noisy[:, 2], 0.1).astype(np.float32),
        np.full(len(rows), 0.15, np.float32),
        pixel_quantum(camera.width, camera.height),
    )
    landmarks = landmarks_from_codes(
        codes,
        world.descriptors(appearance)[rows] ^ flips,
        np.zeros(len(rows), np.uint8),
        camera,
    )
    status = FrameStatus.OK if len(rows) >= 30 else FrameStatus.TOO_FEW_LANDMARKS
    return Frame(stamp_ns, camera, landmarks, BRIEF, "synthetic", status)


@dataclass(frozen=True)
class Seen:
    """One step of a simulated drive."""

    frame: Frame
    odometry: OdometryStep
    world_from_live: SE3

    @property
    def logged(self) -> LoggedFrame:
        """As a frame log has it."""
        return LoggedFrame(self.frame, self.odometry)


def drive(
    world: World,
    places_m: np.ndarray,
    appearance: int | np.ndarray = 0,
    aside_m: float = 0.0,
    start_ns: int = 1_000_000_000_000,
    seed: int = 0,
    camera: StereoCamera = CAMERA,
    drift: SE3 | None = None,
) -> list[Seen]:
    """Drives past the places given, with odometry of 1 % and 0.1° of noise a step.

    `drift` is added to every step; the covariance knows nothing of it.
    """
    rng = np.random.default_rng([world.seed, seed])
    appearances = np.broadcast_to(appearance, len(places_m))
    steps: list[Seen] = []
    for i, s in enumerate(places_m):
        truth = world.pose_at(float(s), aside_m)
        frame = see(world, truth, start_ns + i * PERIOD_NS, int(appearances[i]), camera=camera)
        if i == 0:
            odometry = OdometryStep(OdometryStatus.FIRST)
        else:
            motion = steps[-1].world_from_live.inverse() @ truth
            sigma_m = 0.003 + 0.01 * motion.distance_m
            sigma = np.array([sigma_m] * 3 + [np.deg2rad(0.1)] * 3)
            noisy = SE3.exp(rng.normal(0, sigma)) @ motion @ (drift or SE3.identity())
            odometry = OdometryStep(OdometryStatus.OK, noisy, np.diag(sigma**2), 100)
        steps.append(Seen(frame, odometry, truth))
    return steps
