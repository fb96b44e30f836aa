"""The frames of the benchmark, decoded and scaled beforehand."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.sequences.opening import open_drive

_SMALL_WIDTH_PX, _SMALL_HEIGHT_PX = 512, 384


@dataclass(frozen=True)
class BenchData:
    """A drive in memory."""

    name: str
    full: tuple[StereoPair, ...]

    @cached_property
    def small(self) -> tuple[StereoPair, ...]:
        """The same pairs, scaled to height 384 and centre-cropped to 512×384."""
        return tuple(scale_and_crop(pair) for pair in self.full)

    def at(self, size: str) -> tuple[StereoPair, ...]:
        """The pairs at size "512" or "full"."""
        return self.small if size == "512" else self.full


def load_bench_data() -> BenchData:
    """The KITTI 06 clip under ``$ENGRAM_DATA``, else a synthetic drive."""
    root = os.environ.get("ENGRAM_DATA")
    if root:
        clip = Path(root) / "kitti_odometry" / "sequences" / "06"
        if clip.is_dir():
            pairs = [entry for entry in open_drive(clip) if isinstance(entry, StereoPair)]
            return BenchData("KITTI odometry 06", tuple(pairs))
    return BenchData("synthetic street", synthetic_drive())


def scale_and_crop(pair: StereoPair) -> StereoPair:
    """The pair at height 384, centre-cropped to 512 px; the calibration follows.

    Pixel centres are at integers: scaling by s maps u to s·(u + ½) − ½.
    """
    camera = pair.camera
    scale = _SMALL_HEIGHT_PX / camera.height
    width = max(_SMALL_WIDTH_PX, round(camera.width * scale))
    across = width / camera.width
    left_edge = (width - _SMALL_WIDTH_PX) // 2
    small = StereoCamera(
        fx=camera.fx * across,
        fy=camera.fy * scale,
        cx=(camera.cx + 0.5) * across - 0.5 - left_edge,
        cy=(camera.cy + 0.5) * scale - 0.5,
        baseline_m=camera.baseline_m,
        width=_SMALL_WIDTH_PX,
        height=_SMALL_HEIGHT_PX,
    )

    def shrink(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        shrinking = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        scaled = cv2.resize(image, (width, _SMALL_HEIGHT_PX), interpolation=shrinking)
        cropped = scaled[:, left_edge : left_edge + _SMALL_WIDTH_PX]
        return np.ascontiguousarray(cropped, dtype=np.uint8)

    return StereoPair(pair.stamp_ns, shrink(pair.left), shrink(pair.right), small)


def to_and_fro(i: int, count: int) -> int:
    """0, 1, …, count - 1, count - 2, …, 1, 0, 1, …."""
    at = i % (2 * count - 2)
    return min(at, 2 * count - 2 - at)


def synthetic_drive(frames: int = 24, step_m: float = 0.8, seed: int = 0) -> tuple[StereoPair, ...]:
    """A straight street: ground, two walls and an end wall, each a textured plane.

    Every plane is warped into each image by its exact homography, so geometry and motion are
    known; the camera moves `step_m` forward between frames. KITTI's focal length and size.
    """
    return tuple(_pair_of_street(index, step_m, seed) for index in range(frames))


@lru_cache(maxsize=64)
def _pair_of_street(index: int, step_m: float, seed: int) -> StereoPair:
    """One pair; read-only, as the newest are kept."""
    camera = StereoCamera(707.0, 707.0, 601.9, 183.1, 0.537, 1226, 370)
    views = [
        _render(_street(seed), camera, np.array([offset, 0.0, index * step_m]))
        for offset in (0.0, camera.baseline_m)
    ]
    for view in views:
        view.setflags(write=False)
    return StereoPair(index * 100_000_000, views[0], views[1], camera)


@dataclass(frozen=True)
class _Plane:
    """A textured rectangle; texture pixel (a, b) lies at corner + scale · (a · along + b · up)."""

    corner: NDArray[np.float64]
    along: NDArray[np.float64]
    up: NDArray[np.float64]
    texture: NDArray[np.uint8]
    metres_per_pixel: float


@lru_cache(maxsize=1)
def _street(seed: int) -> list[_Plane]:
    rng = np.random.default_rng(seed)
    forward, right, down = np.eye(3)[[2, 0, 1]]

    def plane(
        corner: list[float],
        along: NDArray[np.float64],
        up: NDArray[np.float64],
        size_m: list[float],
    ) -> _Plane:
        grain = 0.02
        shape = (int(size_m[1] / grain), int(size_m[0] / grain))
        total = np.zeros(shape, dtype=np.float32)
        for sigma in (1.5, 5.0, 20.0):
            noise = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), sigma)
            total += noise / noise.std()
        grey = np.clip(np.rint(120 + 28 * total), 0, 255).astype(np.uint8)
        return _Plane(np.array(corner), along, up, grey, grain)

    # Far things first: nearer planes are painted over them.
    return [
        plane([-40.0, -18.0, 70.0], right, down, [80.0, 19.6]),
        plane([-7.0, -6.0, -5.0], forward, down, [75.0, 7.6]),
        plane([7.0, -6.0, -5.0], forward, down, [75.0, 7.6]),
        plane([-7.0, 1.6, -5.0], forward, right, [75.0, 14.0]),
    ]


def _render(
    planes: list[_Plane], camera: StereoCamera, centre: NDArray[np.float64]
) -> NDArray[np.uint8]:
    size = (camera.width, camera.height)
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    image = np.full(size[::-1], 200, dtype=np.uint8)
    rows, columns = np.indices(size[::-1])
    rays = np.stack([columns, rows, np.ones_like(rows)]).reshape(3, -1)
    nearest = np.full(size[::-1], np.inf)
    for plane in planes:
        axes = plane.metres_per_pixel * np.column_stack([plane.along, plane.up])
        image_from_texture = intrinsics @ np.column_stack([axes, plane.corner - centre])
        texture_at = np.linalg.inv(image_from_texture) @ rays
        depth = (1 / texture_at[2]).reshape(size[::-1])
        at = (texture_at[:2] / texture_at[2]).astype(np.float32).reshape(2, *size[::-1])
        height, width = plane.texture.shape
        inside = (at[0] >= 0) & (at[0] < width) & (at[1] >= 0) & (at[1] < height)
        shown = inside & (depth > 0.1) & (depth < nearest)
        view = cv2.remap(plane.texture, at[0], at[1], cv2.INTER_LINEAR)
        image[shown] = view[shown]
        nearest[shown] = depth[shown]
    return image
