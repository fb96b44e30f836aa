"""Pictures of matches and of stereo pairs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.doctor.examination import align
from engram.errors import InputError
from engram.frontend.features import match_sides
from engram.frontend.frame import Frame, StereoPair
from engram.localiser.attempts import Outcome, outcome_at
from engram.localiser.localisation import Localisation
from engram.maps.frame_reader import FrameReader
from engram.robot.robot import LastFrame

Image = NDArray[np.uint8]

_MATCH_GAP_PX = 8
_MATCH_CAPTION_PX = 28
# Lines over everything hide the images: this many show how they lie to each other.
_MATCH_LINES = 12
# Images that are wider than this times their height lie one above the other.
_WIDE = 1.6
_WHITE = (230, 230, 230)


def match_picture(
    node_image: Image,
    live_image: Image,
    node_pixels: NDArray[np.float32],
    live_pixels: NDArray[np.float32],
    caption: str,
) -> Image:
    """Node and live image, named, in the live image's size; wide ones one above the other.

    Args:
        node_image: (h, w) uint8 grey, any size; enlarged to that of the live image.
        live_image: (H, W) uint8 grey.
        node_pixels: (K, 2) float32, positions in the node's image as fractions of its width and
            height.
        live_pixels: (K, 2) float32, positions in the live image, px.

    Returns:
        (H', W', 3) uint8 BGR.
    """
    height, width = live_image.shape
    enlarged = cv2.resize(node_image, (width, height), interpolation=cv2.INTER_CUBIC)
    stacked = width > _WIDE * height
    shift = np.array([0, height + _MATCH_GAP_PX] if stacked else [width + _MATCH_GAP_PX, 0])
    canvas = np.zeros((*(np.array([height, width]) + shift[::-1]), 3), dtype=np.uint8)
    canvas[:height, :width] = enlarged[..., None]
    canvas[shift[1] :, shift[0] :] = live_image[..., None]
    ends = np.round(live_pixels).astype(int) + shift
    starts = np.round(node_pixels * (width, height)).astype(int)
    for row in _spread(live_pixels):
        colour = _colour(float(live_pixels[row, 1]) / height)
        cv2.line(canvas, tuple(starts[row]), tuple(ends[row]), colour, 1, cv2.LINE_AA)
    for start, end, live in zip(starts, ends, live_pixels, strict=True):
        colour = _colour(float(live[1]) / height)
        for centre in (start, end):
            cv2.circle(canvas, tuple(centre), 2, colour, -1, cv2.LINE_AA)
    _write_name(canvas, "node", np.array([0, 0]))
    _write_name(canvas, "live", shift)
    below = np.zeros((_MATCH_CAPTION_PX, canvas.shape[1], 3), dtype=np.uint8)
    _write(below, caption, (6, _MATCH_CAPTION_PX - 9))
    return np.concatenate([canvas, below])


def _spread(pixels: NDArray[np.float32]) -> list[int]:
    """A few of the points, far from each other: each the farthest from those before it."""
    if not len(pixels):
        return []
    chosen = [0]
    distance = np.linalg.norm(pixels - pixels[0], axis=1)
    while len(chosen) < min(_MATCH_LINES, len(pixels)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(pixels - pixels[chosen[-1]], axis=1))
    return chosen


def _write_name(canvas: Image, name: str, corner: NDArray[np.int_]) -> None:
    x, y = (int(value) for value in corner)
    cv2.rectangle(canvas, (x, y), (x + 46, y + 20), (0, 0, 0), -1)
    _write(canvas, name, (x + 5, y + 15))


def _write(canvas: Image, text: str, at: tuple[int, int]) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _WHITE, 1, cv2.LINE_AA)


def _colour(fraction: float) -> tuple[int, int, int]:
    """A hue from top to bottom of the image, so that crossing lines stand out."""
    hue = np.array([[[int(170 * min(max(fraction, 0.0), 1.0)), 220, 255]]], dtype=np.uint8)
    blue, green, red = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0]
    return int(blue), int(green), int(red)


class PictureWriter:
    """Writes a picture of the match, or of its absence, at regular intervals.

    Args:
        every: frames from one picture to the next.
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

    def offer(self, seen: LastFrame, localisation: Localisation) -> None:
        """Writes a picture of the frame just localised, if it is due.

        Args:
            seen: `Robot.last`.
        """
        self._count += 1
        if self._count % self._every:
            return
        image = seen.arrived.left if isinstance(seen.arrived, StereoPair) else seen.frame.thumbnail
        if image is None:
            return
        success = outcome_at(seen.outcomes, localisation.node)
        status = localisation.status.value
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


_SHARED_LINES = 40
# Matches whose rows differ by more than this, or that lie further right in the right image.
_OFF_PX = 1.5
_GOOD, _BAD = (120, 220, 120), (70, 70, 255)


def side_picture(pair: StereoPair) -> NDArray[np.uint8]:
    """Left above right, (2h, w, 3) uint8 BGR; lines join what both show, red if that is wrong.

    Matches that contradict the pair's alignment are left out, as the doctor leaves them out.
    """
    matches, height = match_sides(pair), pair.camera.height
    aligned = align(matches, pair.camera)
    matches = matches if aligned is None else aligned.agreeing
    both = np.concatenate([pair.left, pair.right])
    picture = cv2.cvtColor(both, cv2.COLOR_GRAY2BGR)
    chosen = np.linspace(0, len(matches) - 1, min(_SHARED_LINES, len(matches))).astype(int)
    for k in chosen.tolist():
        pixel, shift = matches.pixels[k], matches.shift[k]
        bad = abs(shift[1]) > _OFF_PX or shift[0] < -_OFF_PX
        right = pixel - shift + [0, height]
        colour = _BAD if bad else _GOOD
        ends = [tuple(int(value) for value in np.rint(end)) for end in (pixel, right)]
        cv2.line(picture, ends[0], ends[1], colour, 1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def fixed_picture(pair: StereoPair, seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The left image, (h, w, 3) uint8 BGR, red where it moves with the camera.

    Args:
        seen: (h, w) bool, False where the image moves with the camera.
    """
    picture = cv2.cvtColor(pair.left, cv2.COLOR_GRAY2BGR)
    tinted = 0.5 * picture + 0.5 * np.array(_BAD)
    return np.where(seen[..., None], picture, tinted).astype(np.uint8)


_EPIPOLAR_LINES = 16
_PAIR_GAP_PX = 4
_PAIR_CAPTION_PX = 26
# Matched corners that are this far apart in height are no match, px.
_MOST_ROWS_PX = 20.0
# ORB descriptors that differ in more bits are of different points.
_MOST_BITS = 32


def row_offsets_px(pair: StereoPair) -> NDArray[np.float64]:
    """(N,) heights of matched corners in the left image minus those in the right, px.

    Near 0 throughout for a good calibration. Independent of the front-end, which only searches
    along the row.
    """
    orb = cv2.ORB.create(1500)
    (left, left_codes), (right, right_codes) = (
        orb.detectAndCompute(image, None) for image in (pair.left, pair.right)
    )
    if not (len(left) and len(right)):
        return np.zeros(0)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_codes, right_codes)
    offsets = [
        left[match.queryIdx].pt[1] - right[match.trainIdx].pt[1]
        for match in matches
        if match.distance <= _MOST_BITS
    ]
    offsets_m = np.array(offsets, dtype=np.float64)
    return offsets_m[np.abs(offsets_m) <= _MOST_ROWS_PX]


def rectified_picture(pair: StereoPair, caption: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR: left and right image, and the rows that a point of one lies on."""
    height, width = pair.left.shape
    canvas = np.zeros((height + _PAIR_CAPTION_PX, 2 * width + _PAIR_GAP_PX, 3), dtype=np.uint8)
    left = pair.left if pair.mask is None else np.where(pair.mask, pair.left, pair.left // 3)
    canvas[:height, :width] = left[..., None]
    canvas[:height, width + _PAIR_GAP_PX :] = pair.right[..., None]
    for number in range(1, _EPIPOLAR_LINES):
        row = number * height // _EPIPOLAR_LINES
        hue = np.array([[[170 * number // _EPIPOLAR_LINES, 200, 255]]], dtype=np.uint8)
        colour = tuple(int(value) for value in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0])
        cv2.line(canvas, (0, row), (2 * width + _PAIR_GAP_PX, row), colour, 1)
    for text, column in ((f"left   {caption}", 6), ("right", width + _PAIR_GAP_PX + 6)):
        origin = (column, height + _PAIR_CAPTION_PX - 8)
        cv2.putText(
            canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (230, 230, 230), 1, cv2.LINE_AA
        )
    return canvas
