"""Pictures of both sides of suspected edges."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, MapCorruptError
from engram.frontend import feature_kind
from engram.frontend.matching import match_frames, pair_seed
from engram.graph.model import NodeId
from engram.maps.frame_reader import FrameReader
from engram.repair.finding import Finding, Findings
from engram.viewing import match_picture

# Rows of pixels of a picture; stored thumbnails are small.
_HEIGHT_PX = 360


def write_pictures(frames: FrameReader, found: Findings, folder: Path) -> int:
    """Writes one picture of each edge whose nodes have thumbnails; returns their number.

    Args:
        frames: of the map.
        found: the edges; files are numbered in their order.
        folder: created if missing.

    Raises:
        InputError: the folder or a picture cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created: {error.strerror}") from error
    written = 0
    for number, one in enumerate((*found.wrong, *found.doubtful), start=1):
        sides = [frames.thumbnail(node) for node in (one.edge.a, one.edge.b)]
        if sides[0] is None or sides[1] is None:
            continue
        path = folder / f"{number:03d}_{one.why}_{str(one.edge.a)[:8]}_{str(one.edge.b)[:8]}.png"
        if not cv2.imwrite(str(path), _picture(frames, one, sides[0], sides[1])):
            raise InputError(f"{path}: the picture cannot be written; is the disk full?")
        written += 1
    return written


def _picture(
    frames: FrameReader, one: Finding, a: NDArray[np.uint8], b: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    scale = _HEIGHT_PX / b.shape[0]
    enlarged = cv2.resize(b, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    size = (enlarged.shape[1], enlarged.shape[0])
    pixels_a, pixels_b = _inliers(frames, one.edge.a, one.edge.b)
    return match_picture(
        a, enlarged.astype(np.uint8), pixels_a, (pixels_b * size).astype(np.float32), one.text()
    )


def _inliers(
    frames: FrameReader, a: NodeId, b: NodeId
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(K, 2) each: where the two nodes match, as fractions of their images."""
    nothing = np.zeros((0, 2), np.float32)
    try:
        reference, live = frames.frame(a), frames.frame(b)
    except MapCorruptError:
        return nothing, nothing
    matcher = feature_kind(live.descriptor).matcher
    match = match_frames(reference, live, matcher, pair_seed(b, a))
    return tuple(  # type: ignore[return-value]
        (frame.landmarks.pixels[rows] / (frame.camera.width, frame.camera.height)).astype(
            np.float32
        )
        for frame, rows in ((reference, match.reference_rows), (live, match.live_rows))
    )
