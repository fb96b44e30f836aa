"""Places made of random landmarks, for benchmarks that need maps and no pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from engram.frontend.blobs import encode_landmarks, landmarks_from_codes, pixel_quantum, quantise
from engram.frontend.frame import BRIEF, FrameStatus
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import (
    Clock,
    Edge,
    EdgeKind,
    Node,
    PathEntry,
    PathEntryKind,
    Session,
    node_id,
    path_id,
    session_id,
)
from engram.maps.map import Map
from engram.maps.records import StoredNode
from engram.maps.writer import RevisionWriter

CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.3, 640, 480)
DESCRIPTOR, FRONTEND = BRIEF, "synthetic"


def landmark_bytes(
    place: np.random.Generator, look: np.random.Generator | None, count: int
) -> bytes:
    """The landmarks of a place, as a map stores them.

    Args:
        place: draws the place: 4 to 30 m ahead, anywhere in the image.
        look: draws what differs when it is seen again: pixels by σ = 0.3, 5 % of the bits.
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


SESSION_NODES = 500
LANDMARKS = 100
STEP = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
SIGMA = np.diag([0.01**2] * 3 + [0.002**2] * 3)


def write_session(
    writer: RevisionWriter,
    robot: str,
    number: int,
    places: range,
) -> None:
    """One drive past some places, saved whole."""
    start_ns = 1_000_000_000_000 * (number + 1)
    drive = drive_of(robot, start_ns)
    writer.add_session(drive, CAMERA, descriptor=DESCRIPTOR, frontend=FRONTEND)
    before: Node | None = None
    for at, place in enumerate(places):
        stamp_ns = start_ns + at * 100_000_000
        node = node_of(drive, stamp_ns, float(at))
        blob = landmark_bytes(np.random.default_rng(place), None, LANDMARKS)
        writer.copy_node(stored(node, blob))
        if before is not None:
            writer.add_edge(Edge(before.id, node.id, EdgeKind.ODOMETRY, STEP, SIGMA))
        entry = PathEntry(path_id(drive.id), at, node.id, PathEntryKind.SAVED, stamp_ns)
        writer.add_path_entry(entry)
        before = node


def write_map(path: Path, robot: str, places: list[range]) -> None:
    """A map of drives past some places."""
    with (
        Map.create(path) as store,
        store.begin_revision(author=robot, message="synthetic", configuration={}) as writer,
    ):
        for number, some in enumerate(places):
            write_session(writer, robot, number, some)
        writer.commit()
