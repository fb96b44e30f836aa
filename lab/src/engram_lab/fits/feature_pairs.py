"""What the feature network is trained on: patches of corners that are truly the same.

Rendered towns give most of it. A real drive gives the rest, by tracks without labels: its poses are
those of its own matches from frame to frame, and the corners that agree with them are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Landmarks
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab.eyes import DARK, WET, Patches, Scene, clip, same_corners

# Image pairs a step, corners and further corners (rivals only) of each.
_PAIRS, _CORNERS, _RIVALS = 5, 96, 48
# Share of pairs from rows that are rare: wet or dark visits.
_RARE = 0.35
# Places apart of two views; of real frames.
_STEPS, _REAL_STEPS = (0, 0, 0, 0, 0, 0, 0, 0, 0, 1), (1, 2, 3, 4, 5, 6, 8, 10)
_FEWEST, _FEWEST_RARE = 15, 8
# Share of patches that are turned, stretched and moved; of those with more noise; of blurred ones.
_WARPED, _NOISY, _BLURRED = 0.35, 0.25, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One image of a source, with its landmarks, pose and camera."""

    image: NDArray[np.uint8]
    landmarks: Landmarks
    world_from_cam: NDArray[np.float64]
    camera: StereoCamera


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Views (visit, place) of one street.

    Attributes:
        views: by visit and place.
        steps: places apart of two views of a pair.
        rare: groups of visits that are drawn more often.
    """

    views: dict[tuple[int, int], View]
    steps: tuple[int, ...]
    rare: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Number of visits and of places."""
        visit, place = max(self.views)
        return visit + 1, place + 1


def rendered(scene: Scene) -> Source:
    """A rendered town as a source."""
    views = {
        key: View(scene.left[key], marks, scene.world_from_cam[key], scene.camera)
        for key, marks in scene.landmarks.items()
    }
    every = tuple(range(len(scene.visits)))
    return Source(views, _STEPS, ((WET, every), (DARK, every), (WET, WET), (DARK, DARK)))


def real_drive(folder: Path, frames: int) -> Source:
    """The first frames of a KITTI raw drive: grey rig and the three channels of the colour rig."""
    frontend = Frontend(FrontendConfig(thumbnails=False))
    rigs = [clip(folder)[:frames]]
    rigs += [
        clip(folder, rig="colour", channel=channel)[:frames] for channel in ("red", "green", "blue")
    ]
    grey = [frontend.extract(pair) for pair in rigs[0]]
    poses = [SE3.identity()]
    for before, after in pairwise(grey):
        step = match_frames(before, after, MatcherConfig(), 7).reference_from_live
        if step is None:
            raise SystemExit(f"{folder}: two neighbouring frames do not match")
        poses.append(poses[-1] @ step)
    # Camera 2 stands left of camera 0 (calib_cam_to_cam.txt of the drive's day).
    grey_from_colour = SE3(np.eye(3), np.array([-0.0598, 0.0004, -0.0027]))
    views = {}
    for visit, pairs in enumerate(rigs):
        for place, pair in enumerate(pairs):
            pose = poses[place] @ grey_from_colour if visit else poses[place]
            marks = (frontend.extract(pair) if visit else grey[place]).landmarks
            views[visit, place] = View(pair.left, marks, pose.matrix(), pair.camera)
    return Source(views, _REAL_STEPS)


@dataclass(slots=True, eq=False)
class Batch:
    """Corners of one side of some image pairs.

    Attributes:
        patches: (N, 64, 64) uint8.
        pixels: (N, 3) float32: u, v, px, and the pair, so far apart that pairs never come near.
        same: (N,) bool: whether its row on the other side shows the same corner; the k-th of these
            belongs to the k-th there. Others are rivals only.
    """

    patches: NDArray[np.uint8]
    pixels: NDArray[np.float32]
    same: NDArray[np.bool_]


class Drawer:
    """Draws batches; everything follows from the state of its generator.

    Args:
        towns: rendered sources.
        real: real sources.
        real_share: of the image pairs.
        draws: the generator.
    """

    def __init__(
        self, towns: Sequence[Source], real: Sequence[Source], real_share: float,
        draws: np.random.Generator,
    ) -> None:  # fmt: skip
        self._towns, self._real = towns, real
        self._real_share = real_share if real else 0.0
        self.draws = draws

    def batch(self) -> tuple[Batch, Batch]:
        """Both sides of some image pairs, distorted."""
        sides: tuple[list[Batch], list[Batch]] = ([], [])
        for number in range(_PAIRS):
            views, rows = self._pair()
            for side, view, own in zip(sides, views, rows.T, strict=True):
                side.append(self._cut(view, own, number))
        left, right = (_joined(side) for side in sides)
        self._distort(left.patches, _WARPED)
        self._distort(right.patches, 0.3 * _WARPED)
        return left, right

    def _pair(self) -> tuple[tuple[View, View], NDArray[np.int64]]:
        real = self.draws.random() < self._real_share
        while True:
            sources = self._real if real else self._towns
            source = sources[int(self.draws.integers(len(sources)))]
            rare = bool(source.rare) and self.draws.random() < _RARE
            keys = self._keys(source, rare=rare)
            if keys is None:
                continue
            a, b = (source.views[key] for key in keys)
            b_from_a = np.linalg.inv(b.world_from_cam) @ a.world_from_cam
            rows = same_corners(a.landmarks, b.landmarks, b_from_a, b.camera)
            if len(rows) >= (_FEWEST_RARE if source.rare else _FEWEST):
                if len(rows) > _CORNERS:
                    rows = rows[self.draws.choice(len(rows), _CORNERS, replace=False)]
                return (a, b), rows

    def _keys(
        self, source: Source, *, rare: bool
    ) -> tuple[tuple[int, int], tuple[int, int]] | None:
        visits, places = source.shape
        v, w = (int(each) for each in self.draws.choice(visits, 2, replace=False))
        if rare:
            groups = source.rare[int(self.draws.integers(len(source.rare)))]
            v, w = (int(self.draws.choice(group)) for group in groups)
        place = int(self.draws.integers(places))
        other = place + int(self.draws.choice(source.steps)) * int(self.draws.choice((-1, 1)))
        if v == w or not 0 <= other < places:
            return None
        return (v, place), (w, other)

    def _cut(self, view: View, rows: NDArray[np.int64], number: int) -> Batch:
        marks = view.landmarks
        others = np.setdiff1d(np.arange(len(marks)), rows)
        others = self.draws.choice(others, min(_RIVALS, len(others)), replace=False)
        every = np.concatenate([rows, others])
        patches = Patches(view.image).around(marks.pixels[every], marks.octaves[every])
        pixels = np.column_stack([marks.pixels[every], np.full(len(every), 1e5 * number)])
        return Batch(patches, pixels.astype(np.float32), np.arange(len(every)) < len(rows))

    def _distort(self, patches: NDArray[np.uint8], warped: float) -> None:
        """In place: viewpoint, noise and blur."""
        draws, count = self.draws, len(patches)
        for row in np.flatnonzero(draws.random(count) < warped):
            scale, turn = np.exp(draws.uniform(-0.28, 0.28)), np.radians(draws.normal(0, 8))
            c, s = scale * np.cos(turn), scale * np.sin(turn)
            u, v = draws.normal(0, 0.7, 2)
            matrix = np.array([[c, -s, 32 * (1 - c + s) + u], [s, c, 32 * (1 - s - c) + v]])
            patches[row] = cv2.warpAffine(
                patches[row], matrix, (64, 64), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip
        for row in np.flatnonzero(draws.random(count) < _BLURRED):
            patches[row] = cv2.GaussianBlur(patches[row], (0, 0), draws.uniform(0.6, 2.0))
        noisy = np.flatnonzero(draws.random(count) < _NOISY)
        sigma = draws.uniform(0.5, 4, (len(noisy), 1, 1)).astype(np.float32)
        noise = draws.standard_normal((len(noisy), 64, 64), dtype=np.float32) * sigma
        patches[noisy] = np.clip(patches[noisy] + noise + 0.5, 0, 255).astype(np.uint8)


def _joined(parts: Sequence[Batch]) -> Batch:
    return Batch(
        np.concatenate([part.patches for part in parts]),
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.same for part in parts]),
    )
