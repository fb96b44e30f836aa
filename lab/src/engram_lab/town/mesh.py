"""Meshes of convex planar quads, as the renderer takes them, and the truth of a rendered frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import ArrayLike, NDArray

from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3


class SurfaceFlag(IntFlag):
    """How a surface meets light; the values are the core's (`kernels/scene.hpp`)."""

    PLAIN = 0
    CUTOUT = 1
    GLASS = 2
    TRANSLUCENT = 4
    TWO_SIDED = 8
    NO_SHADOW = 16
    ROAD = 32
    CROSSROAD = 64
    SLENDER = 128


class Kind(IntEnum):
    """What a surface belongs to: the truth that comes with every pixel."""

    GROUND = 1
    BUILDING = 2
    FURNITURE = 3
    VEGETATION = 4
    PARKED = 5
    MOVING = 6
    TEMPORARY = 7


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """N quads, one row each; a triangle repeats a vertex.

    Attributes:
        vertices: (N, 4, 3) float32, metres, world axes (x east, y north, z up);
            counter-clockwise seen from outside.
        uv: (N, 4, 2) float32, texture coordinates in units of the texture, v downwards.
        textures: (N,) int32, numbers of the renderer's textures.
        flags: (N,) uint32, `SurfaceFlag`.
        tint: (N,) float32, factor on the albedo.
        glow: (N,) float32, emitted luminance.
        kinds: (N,) int32, `Kind`.
    """

    vertices: NDArray[np.float32]
    uv: NDArray[np.float32]
    textures: NDArray[np.int32]
    flags: NDArray[np.uint32]
    tint: NDArray[np.float32]
    glow: NDArray[np.float32]
    kinds: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.vertices)

    def moved(self, position: ArrayLike, heading_rad: float) -> Mesh:
        """Turned about z by the heading (anticlockwise from east) and shifted to (3,) metres."""
        c, s = np.cos(heading_rad), np.sin(heading_rad)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=np.float32)
        vertices = self.vertices @ turn + np.asarray(position, dtype=np.float32)
        return Mesh(vertices, self.uv, self.textures, self.flags, self.tint, self.glow, self.kinds)

    def tinted(self, factor: float) -> Mesh:
        """With the albedo of all its surfaces scaled."""
        return Mesh(
            self.vertices,
            self.uv,
            self.textures,
            self.flags,
            self.tint * np.float32(factor),
            self.glow,
            self.kinds,
        )

    @staticmethod
    def joined(parts: Sequence[Mesh]) -> Mesh:
        """All parts as one mesh; no parts give an empty one."""
        if not parts:
            return MeshBuilder().build()
        return Mesh(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("vertices", "uv", "textures", "flags", "tint", "glow", "kinds")
            )
        )


@dataclass(slots=True)
class MeshBuilder:
    """Collects quads and boxes."""

    _vertices: list[ArrayLike] = field(default_factory=list)
    _uv: list[ArrayLike] = field(default_factory=list)
    _textures: list[int] = field(default_factory=list)
    _flags: list[int] = field(default_factory=list)
    _tint: list[float] = field(default_factory=list)
    _glow: list[float] = field(default_factory=list)
    _kinds: list[int] = field(default_factory=list)

    def quad(
        self,
        corners: ArrayLike,
        uv: ArrayLike,
        texture: int,
        kind: Kind,
        flags: SurfaceFlag = SurfaceFlag.PLAIN,
        tint: float = 1.0,
        glow: float = 0.0,
    ) -> None:
        """Adds a planar convex quad: corners (4, 3) counter-clockwise from outside, uv (4, 2)."""
        self._vertices.append(corners)
        self._uv.append(uv)
        self._textures.append(texture)
        self._flags.append(int(flags))
        self._tint.append(tint)
        self._glow.append(glow)
        self._kinds.append(int(kind))

    def box(
        self,
        centre: ArrayLike,
        half_axes: ArrayLike,
        texture: int,
        kind: Kind,
        per_m: float = 0.25,
        flags: SurfaceFlag = SurfaceFlag.PLAIN,
        tint: float = 1.0,
        faces: str = "ewnst",
    ) -> None:
        """Adds a box.

        Args:
            centre: (3,) metres.
            half_axes: (3, 3), rows: half its extent along its own east, north and up.
        """
        c = np.asarray(centre, dtype=np.float64)
        a, b, up = np.asarray(half_axes, dtype=np.float64)
        sides = {
            "e": (c + a, b, up),
            "w": (c - a, -b, up),
            "n": (c + b, -a, up),
            "s": (c - b, a, up),
            "t": (c + up, a, b),
            "d": (c - up, a, -b),
        }
        shift = np.abs(c[:2] * 0.37) % 1.0
        for face in faces:
            middle, right, top = sides[face]
            corners = np.array(
                [
                    middle - right - top,
                    middle + right - top,
                    middle + right + top,
                    middle - right + top,
                ]
            )
            width = 2 * per_m * float(np.sqrt(right @ right))
            height = 2 * per_m * float(np.sqrt(top @ top))
            uv = shift + np.array([(0, height), (width, height), (width, 0), (0, 0)])
            self.quad(corners, uv, texture, kind, flags, tint)

    def build(self) -> Mesh:
        """What was collected, as arrays."""
        return Mesh(
            np.array(self._vertices, dtype=np.float32).reshape(-1, 4, 3),
            np.array(self._uv, dtype=np.float32).reshape(-1, 4, 2),
            np.array(self._textures, dtype=np.int32),
            np.array(self._flags, dtype=np.uint32),
            np.array(self._tint, dtype=np.float32),
            np.array(self._glow, dtype=np.float32),
            np.array(self._kinds, dtype=np.int32),
        )


# Of another day's drive: these stand elsewhere then.
_PASSING = (Kind.PARKED, Kind.MOVING, Kind.TEMPORARY)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """Truth of one frame.

    Attributes:
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
