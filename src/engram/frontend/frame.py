"""Input and output of the front-end: `StereoPair` → `Frame`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NewType

import numpy as np
from numpy.typing import NDArray

from engram.geometry.cameras import StereoCamera

# Key in `FEATURES`. Different kinds never match.
DescriptorKind = NewType("DescriptorKind", str)

BRIEF = DescriptorKind("brief")


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """One rectified, synchronised stereo pair.

    Attributes:
        stamp_ns: capture time, ns.
        left, right: (height, width) uint8 grey images, C-contiguous.
        camera: the camera of both images.
        mask: (height, width) bool, False where the left image shows the robot's own body; None if
            all of it is used.
    """

    stamp_ns: int
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    camera: StereoCamera
    mask: NDArray[np.bool_] | None = None


class FrameStatus(StrEnum):
    """Whether a frame is usable (method §5: unusable frames are never saved)."""

    OK = "ok"
    DARK = "dark"
    COVERED = "covered"
    TOO_FEW_LANDMARKS = "too_few_landmarks"
    FROZEN = "frozen"  # the camera repeats an old image under a new stamp


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """The landmarks of one frame: a struct of arrays, one row per landmark.

    Pixels and disparities are multiples of the storage quantum, so that a frame read back from a
    log or a map matches exactly like the original.

    Attributes:
        pixels: (N, 2) float32, left u, v, px.
        disparity_px: (N,) float32, > 0.
        disparity_sigma_px: (N,) float32, standard deviation of the disparity.
        points_in_cam: (N, 3) float32, metres, in the left camera.
        descriptors: (N, B) uint8, B by their kind.
        octaves: (N,) uint8, pyramid level of detection, 0 is full resolution.
    """

    pixels: NDArray[np.float32]
    disparity_px: NDArray[np.float32]
    disparity_sigma_px: NDArray[np.float32]
    points_in_cam: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    octaves: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.pixels)

    def rows(self, chosen: slice | NDArray[np.bool_]) -> Landmarks:
        """Some of them, in their order.

        Args:
            chosen: a slice, or (N,) bool.
        """
        return Landmarks(*(getattr(self, name)[chosen] for name in Landmarks.__slots__))

    def and_then(self, others: Landmarks) -> Landmarks:
        """These, then others of the same kind."""
        columns = ((getattr(self, name), getattr(others, name)) for name in Landmarks.__slots__)
        return Landmarks(*(np.concatenate(pair) for pair in columns))


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Landmarks and status of one stereo pair, in the left camera's frame.

    Attributes:
        stamp_ns: capture time, ns.
        frontend: hash of the front-end's version and configuration.
        status: `FrameStatus.OK`, or why the frame is unusable.
        thumbnail: (h, w) uint8 grey, at most 160 px wide, for people to look at; None if not
            loaded.
        left_out: landmarks that were left out as they move with the camera: what is left is no
            better evidence than before.
        further: finds the landmarks that the front-end chooses next, up to so many in all; None
            where the images are not known any more.
    """

    stamp_ns: int
    camera: StereoCamera
    landmarks: Landmarks
    descriptor: DescriptorKind
    frontend: str
    status: FrameStatus
    thumbnail: NDArray[np.uint8] | None = None
    left_out: int = 0
    further: Callable[[int], Landmarks] | None = None

    def first(self, count: int) -> Frame:
        """The frame with the first `count` of its landmarks."""
        if len(self.landmarks) <= count:
            return self
        return replace(self, landmarks=self.landmarks.rows(slice(count)), further=None)

    def with_further(self, count: int) -> Frame:
        """The frame with those that the front-end chooses next behind its own, `count` in all."""
        if self.further is None or count <= len(self.landmarks) + self.left_out:
            return replace(self, further=None)
        return replace(self, landmarks=self.landmarks.and_then(self.further(count)), further=None)
