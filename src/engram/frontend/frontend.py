"""Stereo pair → `Frame` (SPEC §2.1–2.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.config import config_hash
from engram.errors import ConfigError, SequenceError
from engram.frontend.descriptors import DESCRIPTORS
from engram.frontend.frame import DescriptorKind, Frame, FrameStatus, StereoPair
from engram.frontend.quantisation import landmarks_from_codes, pixel_quantum, quantise

# Goes up whenever the same settings give other landmarks than before.
FRONTEND_VERSION = 1

_THUMBNAIL_WIDTH_PX = 160
_SMALLEST_SIDE_PX = 64


@dataclass(frozen=True, slots=True)
class FrontendConfig:
    """Settings of the front-end.

    Attributes:
        descriptor: kind of descriptor; a map is matched only with its own kind.
        landmarks: at most so many in a 512×384 image; other sizes have more or fewer in proportion
            to area^0.6 (1000 at 1242×375): a larger image shows more, but not another scene.
        octaves: pyramid levels, each half the size of the one before, 1 to 4.
        fast_threshold: least FAST score of a corner, grey levels. Low, so that dark and
            low-contrast images still give corners: the grid keeps the best of each cell anyway,
            and what is only noise fails the stereo match.
        cell_px: side of the grid's cells in which the best corners are taken in turn.
        max_disparity_px: bound of the search, so the nearest landmark.
        min_disparity_px: the farthest landmark.
        uniqueness: best matching cost along the row, as a share of the next best elsewhere.
        max_residual: what may differ between the two matched windows, as a share of the left
            one's variance: 0.7 is a normalised correlation of about 0.55.
        max_sigma_px: landmarks with a less certain disparity are left out.
        sigma_floor_px, sigma_scale: σ² = floor² + (scale · σ from image noise and gradient)².
            Between successive frames of KITTI raw drive 0001 disparities scatter by 0.05 px at
            least. What views of slanted surfaces add, and what all disparities of a camera have in
            common, is the matcher's to allow for (`MatcherConfig`).
        min_landmarks: a frame with fewer is of no use on its own; a match asks for 20 inliers
            (SPEC §3), and rarely are more than half of the landmarks inliers.
        dark_mean: mean grey level below which a useless frame is called dark rather than covered.
        thumbnails: whether frames carry a small picture for people.
    """

    descriptor: DescriptorKind = DescriptorKind.BRIEF
    landmarks: int = 600
    octaves: int = 2
    fast_threshold: int = 7
    cell_px: int = 32
    max_disparity_px: int = 124
    min_disparity_px: float = 0.5
    uniqueness: float = 0.85
    max_residual: float = 0.7
    max_sigma_px: float = 1.0
    sigma_floor_px: float = 0.05
    sigma_scale: float = 1.0
    min_landmarks: int = 40
    dark_mean: float = 16.0
    thumbnails: bool = True

    def __post_init__(self) -> None:
        limits = {
            "landmarks": (1, 100_000),
            "octaves": (1, 4),
            "fast_threshold": (1, 254),
            "cell_px": (4, 4096),
            "max_disparity_px": (1, 500),
            "min_disparity_px": (1 / 64, 500),
            "uniqueness": (0.01, 1),
            "max_residual": (0, 2),
            "max_sigma_px": (1 / 64, 4),
            "sigma_floor_px": (0, 4),
            "sigma_scale": (0, 100),
            "min_landmarks": (0, 100_000),
            "dark_mean": (0, 255),
        }
        for name, (least, most) in limits.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ConfigError(f"frontend.{name} is {value}, must lie in {least} to {most}")


class Frontend:
    """Makes frames of stereo pairs. Keeps nothing between frames; usable from any thread.

    Attributes:
        config: its settings.
        hash: 12 hexadecimal digits of version and settings, recorded in every frame.
    """

    def __init__(self, config: FrontendConfig | None = None) -> None:
        self.config = config or FrontendConfig()
        settings = config_hash(self.config)
        self.hash = config_hash({"version": FRONTEND_VERSION, "settings": settings})

    def extract(self, pair: StereoPair) -> Frame:
        """Corners with a disparity, their descriptors and points; never fails on what it sees.

        Raises:
            SequenceError: the images are no uint8 arrays of the camera's size, or smaller than
                64 px.
        """
        _check_images(pair)
        config = self.config
        fused = config.descriptor is DescriptorKind.BRIEF
        pixels, disparity_px, sigma_px, descriptors, octaves, corners = _core.extract(
            pair.left,
            pair.right,
            landmarks=_landmarks_for(pair.left, config.landmarks),
            octaves=config.octaves,
            fast_threshold=config.fast_threshold,
            cell_px=config.cell_px,
            with_descriptors=fused,
            max_disparity_px=config.max_disparity_px,
            min_disparity_px=config.min_disparity_px,
            uniqueness=config.uniqueness,
            max_residual=config.max_residual,
            max_sigma_px=config.max_sigma_px,
            sigma_floor_px=config.sigma_floor_px,
            sigma_scale=config.sigma_scale,
        )
        if not fused:
            descriptors = DESCRIPTORS[config.descriptor](pair.left, pixels, octaves)
        quantum_px = pixel_quantum(pair.camera.width, pair.camera.height)
        codes = quantise(pixels, disparity_px, sigma_px, quantum_px)
        return Frame(
            stamp_ns=pair.stamp_ns,
            camera=pair.camera,
            landmarks=landmarks_from_codes(codes, descriptors, octaves, pair.camera),
            descriptor=config.descriptor,
            frontend=self.hash,
            status=self._status(pair, len(pixels), corners),
            thumbnail=make_thumbnail(pair.left) if config.thumbnails else None,
        )

    def _status(self, pair: StereoPair, landmarks: int, corners: int) -> FrameStatus:
        """Why a frame has too few landmarks to be of use, from plain facts about its images.

        Dark: there is no light. Covered: there is light, but nothing in focus, so no corners in the
        left image or next to no contrast in the right one (a wall without texture looks the same).
        Else there are corners, but they have no match in the right image.
        """
        if landmarks >= self.config.min_landmarks:
            return FrameStatus.OK
        left, right = pair.left[::8, ::8], pair.right[::8, ::8]
        if min(left.mean(), right.mean()) < self.config.dark_mean:
            return FrameStatus.DARK
        # The noise of a smooth 8-bit image stays below two or three grey levels.
        if corners < self.config.min_landmarks or right.std() < 4:
            return FrameStatus.COVERED
        return FrameStatus.TOO_FEW_LANDMARKS


def make_thumbnail(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The (h, w) uint8 image, halved until it is at most 160 px wide."""
    small = image
    while small.shape[1] > _THUMBNAIL_WIDTH_PX and small.shape[0] > 1:
        small = _core.halve(small)
    return small if small is not image else image.copy()


def _landmarks_for(image: NDArray[np.uint8], at_512x384: int) -> int:
    relative_area = image.size / (512 * 384)
    return max(1, round(at_512x384 * float(relative_area**0.6)))


def _check_images(pair: StereoPair) -> None:
    expected = (pair.camera.height, pair.camera.width)
    for name, image in (("left", pair.left), ("right", pair.right)):
        if image.dtype != np.uint8 or image.shape != expected:
            raise SequenceError(
                f"{name} image at {pair.stamp_ns} ns is {image.dtype} {image.shape}; the camera "
                f"expects uint8 {expected} (height, width)"
            )
        if min(expected) < _SMALLEST_SIDE_PX:
            raise SequenceError(
                f"{name} image is {expected[1]}×{expected[0]} px, the front-end needs at least "
                f"{_SMALLEST_SIDE_PX} px in both directions"
            )
