"""Localisation of single images as hloc does it, of parts that need no graphics card.

RootSIFT corners, their 3D points by stereo, VLAD to find the likeliest images of a map, mutual
nearest neighbours, and one absolute pose of the matches of all these images by pycolmap. The map
consists of images with known poses; nothing is carried from one frame to the next.

Sources: Sarlin et al., CVPR 2019 (the pipeline); Arandjelović and Zisserman, CVPR 2012 (RootSIFT);
Jégou et al., CVPR 2010 (VLAD); pycolmap, where it is installed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import MissingExtraError
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.monitor import write_whole

_WIDTH = 128


@dataclass(frozen=True, slots=True)
class SiftOptions:
    """Settings of the pipeline.

    Attributes:
        corners: most of an image.
        contrast: OpenCV's threshold; its default, 0.04, finds few at night.
        words: of VLAD.
        retrieved: images of the map that a live one is matched with.
        angle_ratio: largest ratio of the angles to the nearest and the second nearest descriptor.
        row_px: rows by which the two views of a corner may differ.
        likeness: least cosine between the two views' descriptors.
        max_error_px: of an inlier. Source: as hloc's default is for SIFT.
    """

    corners: int = 1500
    contrast: float = 0.02
    words: int = 64
    retrieved: int = 10
    angle_ratio: float = 0.85
    row_px: float = 1.5
    likeness: float = 0.8
    max_error_px: float = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """RootSIFT corners of an image.

    Attributes:
        pixels: (N, 2) float32, pixel centres at integers.
        descriptors: (N, 128) float32, of unit length.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.float32]


def root_sift(image: NDArray[np.uint8], options: SiftOptions) -> Corners:
    """The corners of a grey (h, w) image."""
    sift = cv2.SIFT.create(nfeatures=options.corners, contrastThreshold=options.contrast)
    found, descriptors = sift.detectAndCompute(image, np.empty(0, np.uint8))
    pixels = np.array([one.pt for one in found], np.float32).reshape(-1, 2)
    if not len(pixels):  # then descriptors are None, which OpenCV's types do not say
        return Corners(pixels[:0], np.zeros((0, _WIDTH), np.float32))
    shares = descriptors / (descriptors.sum(axis=1, keepdims=True) + 1e-7)
    return Corners(pixels, np.sqrt(shares).astype(np.float32))


def stereo_points(
    left: Corners, right: Corners, camera: StereoCamera, options: SiftOptions
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Left corners that a right one answers, each the other's best in its row.

    Returns:
        Rows (M,) int64 of the left corners, and (M, 3) float64 points in the left camera, metres.
    """
    if not len(left.pixels) or not len(right.pixels):
        return np.zeros(0, np.int64), np.zeros((0, 3))
    disparity = left.pixels[:, None, 0] - right.pixels[None, :, 0]
    off_row = np.abs(left.pixels[:, None, 1] - right.pixels[None, :, 1])
    likeness = left.descriptors @ right.descriptors.T
    likeness[(off_row > options.row_px) | (disparity < 0.5)] = -1.0
    best = likeness.argmax(axis=1)
    every = np.arange(len(best))
    mutual = likeness.argmax(axis=0)[best] == every
    rows = np.flatnonzero(mutual & (likeness[every, best] > options.likeness))
    depth = camera.focal_baseline / disparity[rows, best[rows]].astype(float)
    rays = (left.pixels[rows] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return rows, np.column_stack([rays * depth[:, None], depth])


def train_words(descriptors: NDArray[np.float32], words: int) -> NDArray[np.float32]:
    """(W, 128) float32: centres of clusters of (N, 128) descriptors; the same every time."""
    cv2.setRNGSeed(0)
    ends = (cv2.TERM_CRITERIA_MAX_ITER, 15, 0.0)
    _, _, centres = cv2.kmeans(
        descriptors, words, np.empty(0, np.int32), ends, 1, cv2.KMEANS_PP_CENTERS
    )
    return np.asarray(centres, np.float32)


def vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """(W · 128,) float32 of unit length: what descriptors differ from their nearest words by.

    Each word's part is brought to unit length first, against words that come often in an image.
    Source: Arandjelović and Zisserman, CVPR 2013.
    """
    # The nearest, |d − w|² = |d|² + |w|² − 2 d·w.
    nearest = (descriptors @ words.T - 0.5 * (words**2).sum(axis=1)).argmax(axis=1)
    parts = np.zeros_like(words)
    np.add.at(parts, nearest, descriptors - words[nearest])
    parts /= np.linalg.norm(parts, axis=1, keepdims=True) + 1e-9
    whole = parts.ravel()
    return whole / np.float32(np.linalg.norm(whole) + 1e-9)


def mutual_matches(
    live: NDArray[np.float32], stored: NDArray[np.float32], angle_ratio: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (M,) int64 of both that are each other's nearest, and clearly nearer than the second."""
    if not len(live) or len(stored) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    cosines = np.clip(live @ stored.T, -1.0, 1.0)
    two = np.argpartition(-cosines, 1, axis=1)[:, :2]
    angles = np.arccos(np.take_along_axis(cosines, two, axis=1))
    order = angles.argsort(axis=1)
    best = np.take_along_axis(two, order, axis=1)[:, 0]
    near, second = np.take_along_axis(angles, order, axis=1).T
    every = np.arange(len(live))
    kept = (cosines.argmax(axis=0)[best] == every) & (near < angle_ratio * second)
    return every[kept], best[kept]


def absolute_pose(
    pixels: NDArray[np.float64],
    points: NDArray[np.float64],
    camera: StereoCamera,
    max_error_px: float,
) -> tuple[SE3, int] | None:
    """``world_from_cam`` of a left camera that sees (N, 3) world points at (N, 2) pixels.

    Returns:
        The pose and its number of inliers; None where none is found.

    Raises:
        MissingExtraError: pycolmap is not installed.
    """
    if find_spec("pycolmap") is None:
        raise MissingExtraError("the SIFT pipeline needs pycolmap: pip install pycolmap")
    import pycolmap

    if len(pixels) < 4:
        return None
    # COLMAP's pixel centres are at halves.
    parameters = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    found = pycolmap.estimate_and_refine_absolute_pose(
        np.asarray(pixels, float) + 0.5,
        np.asarray(points, float),
        pycolmap.Camera(
            model="PINHOLE", width=camera.width, height=camera.height, params=parameters
        ),
        {"ransac": {"max_error": max_error_px, "random_seed": 0}},
    )
    if found is None:
        return None
    cam_from_world = np.vstack([found["cam_from_world"].matrix(), [0.0, 0.0, 0.0, 1.0]])
    return SE3.from_matrix(cam_from_world).inverse(), int(found["num_inliers"])


@dataclass(frozen=True, slots=True, eq=False)
class MapImage:
    """An image of a map.

    Attributes:
        points: (M, 3) float32, in the world, metres, of the corners that stereo saw.
        descriptors: (M, 128) float16, theirs.
        place: (W · 128,) float32, VLAD of all its corners.
    """

    points: NDArray[np.float32]
    descriptors: NDArray[np.float16]
    place: NDArray[np.float32]


class SiftMap:
    """Images with poses, in which single images are localised."""

    def __init__(
        self, words: NDArray[np.float32], images: Sequence[MapImage], options: SiftOptions
    ) -> None:
        self._words = words
        self._images = list(images)
        self._options = options

    @staticmethod
    def of(pairs: Sequence[tuple[StereoPair, SE3]], options: SiftOptions | None = None) -> SiftMap:
        """A map of stereo pairs with their ``world_from_cam``."""
        options = options or SiftOptions()
        seen = [_mapped(pair, pose, options) for pair, pose in pairs]
        every = np.concatenate([corners.descriptors[::15] for corners, _, _ in seen])
        words = train_words(every, options.words)
        images = [
            MapImage(
                points.astype(np.float32),
                corners.descriptors[rows].astype(np.float16),
                vlad(corners.descriptors, words),
            )
            for corners, rows, points in seen
        ]
        return SiftMap(words, images, options)

    @cached_property
    def _places(self) -> NDArray[np.float32]:
        return np.stack([one.place for one in self._images])

    def localise(self, pair: StereoPair) -> tuple[SE3, int] | None:
        """``world_from_cam`` of a pair's left image, and the inliers; None where none is found."""
        live = root_sift(pair.left, self._options)
        if not len(live.pixels):
            return None
        likeness = self._places @ vlad(live.descriptors, self._words)
        pixels, points = [], []
        for number in np.argsort(-likeness, kind="stable")[: self._options.retrieved]:
            image = self._images[number]
            stored = image.descriptors.astype(np.float32)
            rows, of_image = mutual_matches(live.descriptors, stored, self._options.angle_ratio)
            pixels.append(live.pixels[rows])
            points.append(image.points[of_image])
        return absolute_pose(
            np.concatenate(pixels).astype(float),
            np.concatenate(points).astype(float),
            pair.camera,
            self._options.max_error_px,
        )

    def save(self, path: Path) -> None:
        """Writes the map as one file of arrays."""
        sizes = np.array([len(one.points) for one in self._images], np.int64)
        with write_whole(path) as draft, draft.open("wb") as file:
            np.savez(
                file,
                words=self._words,
                sizes=sizes,
                points=np.concatenate([one.points for one in self._images]),
                descriptors=np.concatenate([one.descriptors for one in self._images]),
                places=self._places,
            )

    @staticmethod
    def load(path: Path, options: SiftOptions | None = None) -> SiftMap:
        """A map that `save` wrote."""
        with np.load(path) as stored:
            ends = stored["sizes"].cumsum()[:-1]
            parts = (np.split(stored[name], ends) for name in ("points", "descriptors"))
            images = [MapImage(*one) for one in zip(*parts, stored["places"], strict=True)]
            return SiftMap(stored["words"], images, options or SiftOptions())


def _mapped(
    pair: StereoPair, world_from_cam: SE3, options: SiftOptions
) -> tuple[Corners, NDArray[np.int64], NDArray[np.float64]]:
    """The corners of a pair, the rows that stereo saw, and their points in the world."""
    left, right = (root_sift(image, options) for image in (pair.left, pair.right))
    rows, points = stereo_points(left, right, pair.camera, options)
    return left, rows, world_from_cam @ points
