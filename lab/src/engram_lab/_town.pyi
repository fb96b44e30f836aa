"""The renderer of the simulated town: arrays in, arrays out. Every function releases the GIL.

World axes x east, y north, z up; the records are those of `lab/core/kernels/scene.hpp`.
"""

import numpy as np
from numpy.typing import NDArray

class Light:
    @staticmethod
    def of(
        sun: NDArray[np.float32],
        vehicle: NDArray[np.float32],
        sun_power: float,
        sky_power: float,
        cloud: float,
        cloud_x: float,
        cloud_y: float,
        fog_per_m: float,
        haze: float,
        wet: float,
        snow: float,
        headlights: float,
        windows: float,
        aureole: float,
        mirrors: float = 0.0,
    ) -> Light: ...

class RenderCamera:
    def __init__(
        self,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        width: int,
        height: int,
        baseline_m: float,
        turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None: ...

class Scene:
    def __init__(self, noise: NDArray[np.uint8]) -> None: ...
    def add_texture(self, texels: NDArray[np.uint8], coverage: bool = False) -> int: ...
    def remove_texture(self, texture: int) -> None: ...
    def add_mesh(
        self,
        vertices: NDArray[np.float32],
        uv: NDArray[np.float32],
        textures: NDArray[np.int32],
        flags: NDArray[np.uint32],
        tint: NDArray[np.float32],
        glow: NDArray[np.float32],
        objects: NDArray[np.int32],
    ) -> int: ...
    def remove_mesh(self, mesh: int) -> None: ...
    def set_moving(
        self,
        vertices: NDArray[np.float32],
        uv: NDArray[np.float32],
        textures: NDArray[np.int32],
        flags: NDArray[np.uint32],
        tint: NDArray[np.float32],
        glow: NDArray[np.float32],
        objects: NDArray[np.int32],
    ) -> None: ...
    def set_lamps(self, lamps: NDArray[np.float32]) -> None: ...
    def render(
        self,
        camera: RenderCamera,
        rotation: NDArray[np.float64],
        position: NDArray[np.float64],
        light: Light,
        threads: int = 1,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
    def depth(
        self,
        camera: RenderCamera,
        rotation: NDArray[np.float64],
        position: NDArray[np.float64],
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]: ...
    @property
    def bytes(self) -> int: ...

def develop(
    luminance: NDArray[np.float32],
    gain: float,
    shot: float,
    read: float,
    vignette: float,
    seed: int,
) -> NDArray[np.uint8]: ...
def smear(
    luminance: NDArray[np.float32],
    inverse_depths: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    twist: NDArray[np.float32],
) -> NDArray[np.float32]: ...
