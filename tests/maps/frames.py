"""Frames as the front-end makes them, from a seed."""

from __future__ import annotations

import numpy as np

from engram.frontend.blobs import LandmarkCodes, landmarks_from_codes
from engram.frontend.frame import BRIEF, Frame, FrameStatus, Landmarks
from engram.geometry.cameras import StereoCamera

FRONTEND = "f00dfeed0001"
CAMERA = StereoCamera(
    fx=256.0, fy=256.5, cx=255.5, cy=191.5, baseline_m=0.54, width=512, height=384
)


def landmarks(count: int, seed: int = 0, camera: StereoCamera = CAMERA) -> Landmarks:
    rng = np.random.default_rng(seed)
    codes = LandmarkCodes(
        rng.integers(0, 65536, (count, 2), dtype=np.uint16),
        rng.integers(1, 65536, count, dtype=np.uint16),
        rng.integers(0, 256, count, dtype=np.uint8),
    )
    descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    octaves = rng.integers(0, 8, count, dtype=np.uint8)
    return landmarks_from_codes(codes, descriptors, octaves, camera)


def frame(stamp_ns: int, *, count: int = 40, seed: int = 0, camera: StereoCamera = CAMERA) -> Frame:
    rng = np.random.default_rng(seed)
    smooth = np.add.outer(np.arange(30), np.arange(40)).astype(np.uint8) + rng.integers(0, 9)
    return Frame(
        stamp_ns,
        camera,
        landmarks(count, seed, camera),
        BRIEF,
        FRONTEND,
        FrameStatus.OK,
        smooth.astype(np.uint8),
    )


def assert_same_landmarks(read: Landmarks, written: Landmarks) -> None:
    for name in Landmarks.__slots__:
        a, b = getattr(read, name), getattr(written, name)
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, err_msg=name)
