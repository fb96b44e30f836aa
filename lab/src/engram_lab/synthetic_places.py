"""Places made of random landmarks, for benchmarks that need maps and no pictures."""

from __future__ import annotations

import numpy as np

from engram.frontend.blobs import encode_landmarks, landmarks_from_codes, pixel_quantum, quantise
from engram.frontend.frame import BRIEF, FrameStatus
from engram.geometry.cameras import StereoCamera
from engram.graph.model import Clock, Node, Session, node_id, session_id
from engram.maps.records import StoredNode

CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.3, 640, 480)
DESCRIPTOR, FRONTEND = BRIEF, "synthetic"


def landmark_bytes(
    place: np.random.Generator, look: np.random.Generator | None, count: int
) -> bytes:
    """The landmarks of a place, as a map stores them.

    Args:
        place: draws the place: 4 to 30 m ahead, anywhere in the image.
        look: draws what differs when it is seen again: pixels by σ = 0.3, 5 % of the bits.
        count: how many landmarks.
    """
    depth = place.uniform(4, 30, count)
    pixels = place.uniform([10, 10], [630, 470], (count, 2))
    descriptors = place.integers(0, 256, (count, 32), dtype=np.uint8)
    if look is not None:
        pixels = pixels + look.normal(0, 0.3, pixels.shape)
        descriptors = descriptors ^ np.packbits(look.random((count, 256)) < 0.05, axis=1)
    codes = quantise(
        pixels.astype(np.float32),
        (CAMERA.focal_baseline / depth).astype(np.float32),
        np.full(count, 0.15, np.float32),
        pixel_quantum(CAMERA.width, CAMERA.height),
    )
    octaves = np.zeros(count, np.uint8)
    return encode_landmarks(landmarks_from_codes(codes, descriptors, octaves, CAMERA), CAMERA)


def drive_of(robot: str, start_ns: int, tag: str = "") -> Session:
    """A session of a robot without a clock."""
    return Session(
        session_id(robot, CAMERA.id, start_ns, tag), robot, CAMERA.id, start_ns, Clock.RELATIVE
    )


def node_of(drive: Session, stamp_ns: int, along_m: float) -> Node:
    """A node of a drive."""
    return Node(node_id(drive.id, stamp_ns), drive.id, stamp_ns, CAMERA.id, along_m)


def stored(node: Node, blob: bytes) -> StoredNode:
    """A node as it is written, with its landmarks."""
    return StoredNode(node, DESCRIPTOR, FRONTEND, FrameStatus.OK, blob[:16], blob, None)
