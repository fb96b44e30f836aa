"""Stereo pair → `Frame` (method §2.1–2.3), the robot's own body left out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import PUBLIC, check_bounds, config_hash, to_dict
from engram.errors import ConfigError, IncompatibleError, SequenceError
from engram.frontend.blobs import quantised_landmarks
from engram.frontend.features import Keypoints, detect_corners, feature_kind, has_our_corners
from engram.frontend.frame import (
    BRIEF,
    DescriptorKind,
    Frame,
    FrameStatus,
    Landmarks,
    StereoPair,
)
from engram.geometry.cameras import StereoCamera

# Corners this close to the body, px of their octave, are its outline or lie behind it: FAST looks 3
# px around a corner, and the stereo window reaches 5.
_MARGIN_PX = 5


def without_body(pair: StereoPair) -> StereoPair:
    """The pair with the body painted over in the left image, so that it gives no corners.

    The body would otherwise fill the cells of the corner grid next to it. The paint is the mean of
    what is seen, which makes the weakest edge.
    """
    if pair.mask is None:
        return pair
    left = pair.left.copy()
    left[~pair.mask] = int(pair.left[pair.mask].mean())
    return replace(pair, left=left)


def clear_of_body(corners: Keypoints, mask: NDArray[np.bool_]) -> Keypoints:
    """The corners that are clear of the body.

    Args:
        mask: (height, width) bool, False on the body.
    """
    clear_px = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    columns, rows = np.rint(corners.pixels).astype(np.intp).T
    height, width = mask.shape
    at = clear_px[rows.clip(0, height - 1), columns.clip(0, width - 1)]
    return corners.rows(at > _MARGIN_PX * 2.0**corners.octaves)


_NEVER = 254  # least score that a first look of a frame needs, so that the second one replaces it


class Look(NamedTuple):
    """The look that gave the corners of a frame: what finds more of them, and its threshold."""

    config: FrontendConfig
    threshold: int


def look_of(pair: StereoPair, config: FrontendConfig) -> Look:
    """The look that the front-end takes at a pair without a body, by the number of its settings."""
    own = config.landmarks_for(pair.left.size)
    once = replace(config, second_threshold=0)
    if config.second_threshold == 0 or len(detect_corners(pair, once, own).pixels) >= own:
        return Look(once, config.fast_threshold)
    return Look(replace(config, fast_threshold=_NEVER), config.second_threshold)


def further_landmarks(pair: StereoPair, config: FrontendConfig, count: int) -> Landmarks:
    """The landmarks that the front-end chooses after a frame's own, up to `count` in all."""
    kind, pair = feature_kind(config.descriptor), without_body(pair)
    look = look_of(pair, config).config
    found = detect_corners(pair, look, count)
    own = rows_of(detect_corners(pair, look, config.landmarks_for(pair.left.size)), found)
    further = found.rows(np.isin(np.arange(len(found.pixels)), own, invert=True))
    if pair.mask is not None:
        further = clear_of_body(further, pair.mask)
    return quantised_landmarks(
        further.pixels,
        further.disparity_px,
        further.sigma_px,
        kind.describe(pair.left, further.pixels, further.octaves),
        further.octaves,
        pair.camera,
    )


def rows_of(some: Keypoints, all_of_them: Keypoints) -> NDArray[np.intp]:
    """Rows (N,) intp of some points among all, in order; no two share place and octave."""
    known = {
        (u, v, octave): row
        for row, ((u, v), octave) in enumerate(
            zip(all_of_them.pixels.tolist(), all_of_them.octaves.tolist(), strict=True)
        )
    }
    wanted = zip(some.pixels.tolist(), some.octaves.tolist(), strict=True)
    return np.array([known[u, v, octave] for (u, v), octave in wanted], dtype=np.intp)


def as_live(frame: Frame, config: FrontendConfig | None = None) -> Frame:
    """A node's frame as a live one: without the landmarks that only nodes have."""
    config = config or FrontendConfig()
    return frame.first(config.landmarks_for(frame.camera.width * frame.camera.height))


# Raise it when equal settings give different landmarks.
FRONTEND_VERSION = 1


def scaled_to(pixels: int, landmarks: int) -> int:
    """How many landmarks of an image of so many pixels are as many as these of 512 × 384."""
    return round(landmarks * float((pixels / (512 * 384)) ** 0.6))


_THUMBNAIL_WIDTH_PX = 160
SMALLEST_SIDE_PX = 64


@dataclass(frozen=True, slots=True)
class FrontendConfig:
    """Settings of the front-end.

    Attributes:
        descriptor: kind of features; a map matches only its own kind.
        landmarks: most landmarks in a 512×384 image; other sizes scale with area^0.6 (1000 at
            1242×375), as a larger image shows more detail of the same scene.
        octaves: pyramid levels, each half the size of the previous one, 1 to 4.
        fast_threshold: least FAST score of a corner, grey levels. Low, so that dark and
            low-contrast images give corners: the grid keeps the best of each cell, and noise
            fails the stereo match.
        second_threshold: least FAST score of a corner in a second look, grey levels, which replaces
            the first one where this gave fewer landmarks than requested: rain, fog, dirt, the
            dark. It also measures disparities in the halved images, through what blurs one of them.
            0: no second look.
        side_difference: difference of brightness and contrast between the sides, as a share of the
            contrast, beyond which disparities are measured free of both: one lens dirty, fogged or
            in the sun, own exposures. Sides that are alike come to 0.2 at most (KITTI, the rendered
            town) by what one of them hides; the search bears about 0.3 (a gain of 0.85). Beyond it
            a frame costs 0.6 ms more at 1242×375. 0: never.
        cell_px: side of the grid's cells, from which the best corners are taken in turn.
        max_disparity_px: largest disparity, which bounds the nearest landmark.
        min_disparity_px: smallest disparity, which bounds the farthest landmark.
        uniqueness: largest ratio of the best matching cost along the row to the next best one.
        max_residual: largest difference of two matched windows, as a share of the left one's
            variance: 0.7 is a normalised correlation of about 0.55.
        max_sigma_px: largest standard deviation of a landmark's disparity.
        sigma_floor_px, sigma_scale: σ² = floor² + (scale · σ from image noise and gradient)².
            Source: scatter of disparities between successive frames of KITTI raw drive 0001. The
            matcher adds the effects of slanted surfaces and of the camera's common disparity
            offset (`MatcherConfig`).
        min_landmarks: fewest landmarks of a usable frame; a match needs 20 inliers (method §3), and
            rarely more than half of the landmarks are inliers.
        dark_mean: mean grey level below which an unusable frame counts as dark, not covered.
        thumbnails: whether frames carry a small picture for people.
    """

    descriptor: Annotated[DescriptorKind, PUBLIC] = BRIEF
    landmarks: Annotated[int, Meta(ge=1, le=100_000), PUBLIC] = 600
    octaves: Annotated[int, Meta(ge=1, le=4)] = 2
    fast_threshold: Annotated[int, Meta(ge=1, le=254), PUBLIC] = 7
    second_threshold: Annotated[int, Meta(ge=0, le=254), PUBLIC] = 3
    side_difference: Annotated[float, Meta(ge=0, le=100), PUBLIC] = 0.25
    cell_px: Annotated[int, Meta(ge=4, le=4096)] = 32
    max_disparity_px: Annotated[int, Meta(ge=1, le=500), PUBLIC] = 124
    min_disparity_px: Annotated[float, Meta(ge=1 / 64, le=500)] = 0.5
    uniqueness: Annotated[float, Meta(ge=0.01, le=1)] = 0.85
    max_residual: Annotated[float, Meta(ge=0, le=2)] = 0.7
    max_sigma_px: Annotated[float, Meta(ge=1 / 64, le=4)] = 1.0
    sigma_floor_px: Annotated[float, Meta(ge=0, le=4)] = 0.05
    sigma_scale: Annotated[float, Meta(ge=0, le=100)] = 1.0
    min_landmarks: Annotated[int, Meta(ge=0, le=100_000), PUBLIC] = 40
    dark_mean: Annotated[float, Meta(ge=0, le=255)] = 16.0
    thumbnails: Annotated[bool, PUBLIC] = True

    def landmarks_for(self, pixels: int) -> int:
        """Landmarks wanted of an image of so many pixels; `landmarks` is for 512 × 384."""
        return max(1, scaled_to(pixels, self.landmarks))

    def __post_init__(self) -> None:
        check_bounds(self)
        try:
            kind = feature_kind(self.descriptor)
        except IncompatibleError as error:
            raise ConfigError(f"frontend: {error}") from error
        object.__setattr__(self, "descriptor", kind.name)  # with its model


class Frontend:
    """Makes frames from stereo pairs. Stateless between frames; usable from any thread.

    Attributes:
        hash: 12 hexadecimal digits of version and settings, recorded in every frame.
    """

    def __init__(self, config: FrontendConfig | None = None) -> None:
        self.config = config or FrontendConfig()
        self.hash = config_hash(
            {"version": FRONTEND_VERSION, "settings": _settings_hash(self.config)}
        )

    def extract(self, pair: StereoPair) -> Frame:
        """Corners with a disparity, their descriptors and points; image content never raises."""
        check_pair(pair)
        whole, pair, config = pair, without_body(pair), self.config
        kind = feature_kind(config.descriptor)
        keypoints = kind.detect(pair, config, config.landmarks_for(pair.left.size))
        if pair.mask is not None:
            keypoints = clear_of_body(keypoints, pair.mask)
        descriptors = keypoints.descriptors
        if descriptors is None:
            descriptors = kind.describe(pair.left, keypoints.pixels, keypoints.octaves)
        return Frame(
            stamp_ns=int(pair.stamp_ns),  # perhaps NumPy's: JSON knows none
            camera=pair.camera,
            landmarks=quantised_landmarks(
                keypoints.pixels,
                keypoints.disparity_px,
                keypoints.sigma_px,
                descriptors,
                keypoints.octaves,
                pair.camera,
            ),
            descriptor=config.descriptor,
            frontend=self.hash,
            status=self._status(pair, len(keypoints.pixels), keypoints.candidates),
            thumbnail=make_thumbnail(pair.left) if config.thumbnails else None,
            further=partial(further_landmarks, whole, config) if has_our_corners(kind) else None,
        )

    def _status(self, pair: StereoPair, landmarks: int, corners: int) -> FrameStatus:
        """Why a frame has too few landmarks to be usable.

        Dark: the image is dark. Covered: there is light, but hardly any corners in the left image
        or contrast in the right one; a wall without texture looks the same. Else the corners have
        no match in the right image.
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
    return _core.thumbnail(image, _THUMBNAIL_WIDTH_PX)


def _settings_hash(config: FrontendConfig) -> str:
    """Of what decides about landmarks; without later settings, as before these existed."""
    settings = to_dict(config)
    for later in ("second_threshold", "side_difference"):
        if not settings[later]:
            del settings[later]
    return config_hash(settings)


def check_pair(pair: StereoPair) -> None:
    """Refuses a pair that no front-end can read."""
    stamp_ns: object = pair.stamp_ns
    if not isinstance(stamp_ns, int | np.integer) or not -(2**63) <= stamp_ns < 2**63:
        raise SequenceError(
            f"stamp_ns is {stamp_ns!r}, must be a whole number of nanoseconds within 64 bits"
        )
    if not isinstance(pair.camera, StereoCamera):
        raise SequenceError(f"camera is {pair.camera!r}, must be an engram.StereoCamera")
    expected = (pair.camera.height, pair.camera.width)
    for name, image in (("left", pair.left), ("right", pair.right)):
        if not isinstance(image, np.ndarray):
            raise SequenceError(f"{name} image is of {type(image).__name__}, must be a NumPy array")
        if image.dtype != np.uint8 or image.shape != expected:
            raise SequenceError(
                f"{name} image at {stamp_ns} ns is {image.dtype} {image.shape}, must be grey: "
                f"uint8 {expected}, the camera's (height, width)"
            )
        if min(expected) < SMALLEST_SIDE_PX:
            raise SequenceError(
                f"{name} image is {expected[1]}×{expected[0]} px, the front-end needs at least "
                f"{SMALLEST_SIDE_PX} px in both directions"
            )
