"""Pictures of matches along a drive: `localise --pictures`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError
from engram.frontend import Frame, StereoPair
from engram.localiser import Localisation
from engram.localiser.attempts import Outcome
from engram.localiser.choice import outcome_at
from engram.maps.frame_reader import FrameReader
from engram.robot.robot import Seen
from engram.viewing import match_picture


class PictureWriter:
    """Writes a picture of the match, or of its absence, at regular intervals.

    Args:
        folder: folder of the pictures; created if missing.
        every: frames from one picture to the next.
        frames: the map's frames.

    Raises:
        InputError: the folder cannot be created.
    """

    def __init__(self, folder: Path, every: int, frames: FrameReader) -> None:
        self._folder = folder
        self._every = every
        self._frames = frames
        self._count = -1
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be created: {error.strerror}") from error

    def offer(self, seen: Seen, found: Localisation) -> None:
        """Writes a picture of the frame just localised, if it is due.

        Args:
            seen: `Robot.last`.
            found: its localisation.

        Raises:
            InputError: the picture cannot be written.
        """
        self._count += 1
        if self._count % self._every:
            return
        image = seen.arrived.left if isinstance(seen.arrived, StereoPair) else seen.frame.thumbnail
        if image is None:
            return
        success = outcome_at(seen.outcomes, found.node)
        status = found.status.value
        if success is None:
            nothing = np.zeros((0, 2), dtype=np.float32)
            picture = match_picture(np.zeros_like(image), image, nothing, nothing, status)
        else:
            picture = self._match(seen.frame, success, image)
        path = self._folder / f"{self._count:06d}_{status}.png"
        if not cv2.imwrite(str(path), picture):
            raise InputError(f"{path}: the picture cannot be written; is the disk full?")

    def _match(self, live: Frame, success: Outcome, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        node = self._frames.frame(success.candidate.node)
        thumbnail = self._frames.thumbnail(success.candidate.node)
        size = np.array([node.camera.width, node.camera.height], dtype=np.float32)
        scale = image.shape[1] / live.camera.width
        match = success.match
        caption = (
            f"{match.inliers} inliers, rank {success.rank}, node {str(success.candidate.node)[:8]}"
        )
        return match_picture(
            np.zeros((90, 160), dtype=np.uint8) if thumbnail is None else thumbnail,
            image,
            node.landmarks.pixels[match.reference_rows] / size,
            live.landmarks.pixels[match.live_rows] * np.float32(scale),
            caption,
        )
