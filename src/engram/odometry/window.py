"""Settings of the joint optimisation of the last few keyframes [G16 §III-A]."""

from __future__ import annotations

from dataclasses import dataclass

from engram.errors import ConfigError


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """Settings of the joint optimisation.

    Attributes:
        frames: frames optimised together, including the newest. More than seven gain little.
        landmarks: most landmarks, longest tracks first; bounds the time.
        iterations: most iterations; one or two usually suffice. 0 skips the optimisation.
        offset_sigma_px: standard deviation of the change of a rectified camera's disparity offset
            between successive windows. Each window starts from the last estimate, which converges
            within about ten frames.
    """

    frames: int = 7
    landmarks: int = 500
    iterations: int = 5
    offset_sigma_px: float = 0.1

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise ConfigError(f"window: frames is {self.frames}, must be ≥ 2")
        for name, least in (("landmarks", 1), ("iterations", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"window: {name} is {getattr(self, name)}, must be ≥ {least}")
