"""What is true of a rendered frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3, StereoCamera
from engram_lab.town.mesh import Kind

# Of another day's drive: these stand elsewhere then.
_PASSING = (Kind.PARKED, Kind.MOVING, Kind.TEMPORARY)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """Truth of one frame.

    Attributes:
        world_from_cam: pose of the left camera; world axes x east, y north, z up.
        camera: the camera.
        depth_m: (height, width) float32, along the optical axis, at each pixel's centre;
            infinite where it sees the sky.
        kinds: (height, width) int32, `Kind` of what is seen there, −1 for the sky.
    """

    world_from_cam: SE3
    camera: StereoCamera
    depth_m: NDArray[np.float32]
    kinds: NDArray[np.int32]

    @property
    def disparity_px(self) -> NDArray[np.float32]:
        """(height, width) float32; 0 for the sky."""
        return np.asarray(self.camera.focal_baseline / self.depth_m, dtype=np.float32)

    @property
    def lasting(self) -> NDArray[np.bool_]:
        """(height, width): what is there for longer than a day."""
        return (self.kinds >= 0) & ~np.isin(self.kinds, [int(kind) for kind in _PASSING])

    def sees(
        self, points_in_world: NDArray[np.float64], tolerance: float = 0.03
    ) -> NDArray[np.bool_]:
        """Which points (N, 3) the left camera sees: in the picture and not behind anything.

        Args:
            points_in_world: metres.
            tolerance: how far a point may lie behind the surface seen, as a share of its depth.
        """
        points = self.world_from_cam.inverse() @ points_in_world
        z = np.maximum(points[:, 2], 1e-6)
        columns = np.rint(points[:, 0] / z * self.camera.fx + self.camera.cx)
        rows = np.rint(points[:, 1] / z * self.camera.fy + self.camera.cy)
        inside = (
            (points[:, 2] > 0.1)
            & (columns >= 0) & (columns < self.camera.width)
            & (rows >= 0) & (rows < self.camera.height)
        )  # fmt: skip
        at = (
            np.where(inside, rows, 0).astype(int),
            np.where(inside, columns, 0).astype(int),
        )
        return np.asarray(inside & (points[:, 2] <= self.depth_m[at] * (1 + tolerance)))
