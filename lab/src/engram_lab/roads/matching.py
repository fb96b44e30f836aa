"""Matchers that are not ours, a map of what they keep of places, and pictures placed in it.

OpenCV's SIFT with the ratio test or XFeat with mutual nearest neighbours; PnP with RANSAC, one
picture at a time against the four nearest frames of the map, as retrieval nearly gives them.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from dataclasses import astuple, dataclass, fields
from functools import cached_property, partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import ConfigError
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab.roads.xfeat import XFeat, mutual
from engram_lab.town.rendering import Places, Visit

AHEAD_M = ASIDE_M = 0.35  # of a live picture from its place in the map
_MAP_FRAMES = 4
_RATIO, _STEREO_RATIO = 0.8, 0.85
_CORNERS = 4096
_PNP_PX, _LEAST_INLIERS = 4.0, 6
_NEAR_M, _NEAR_DEG = 5.0, 10.0

Words = NDArray[np.float32]
Pairs = NDArray[np.int64]  # (M, 2) rows


@dataclass(frozen=True, slots=True)
class Matcher:
    """Corners, their descriptors, and how these are compared.

    Attributes:
        features: pixels (N, 2) and descriptors (N, D) of a picture.
        across: matches of the two pictures of a pair.
        over_time: matches of a picture and the map.
    """

    features: Callable[[NDArray[np.uint8]], tuple[NDArray[np.float64], Words]]
    across: Callable[[Words, Words], Pairs]
    over_time: Callable[[Words, Words], Pairs]


def sift(image: NDArray[np.uint8]) -> tuple[NDArray[np.float64], Words]:
    """Pixels (N, 2) and RootSIFT (N, 128) of an image."""
    keypoints, words = cv2.SIFT.create(_CORNERS).detectAndCompute(image, None)
    if words is None:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    pixels = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    sums = np.abs(words).sum(axis=1, keepdims=True)
    return pixels, np.sqrt(words / np.maximum(sums, 1e-9)).astype(np.float32)


def distinct(words: Words, others: Words, ratio: float) -> Pairs:
    """Rows whose nearest word is nearer than the next one by a ratio."""
    if len(words) == 0 or len(others) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    # RootSIFT is of length one: distances follow from products.
    squared = np.maximum(2 - 2 * words @ others.T, 0)
    two = np.argpartition(squared, 1, axis=1)[:, :2]
    values = np.take_along_axis(squared, two, axis=1)
    swapped = values[:, 0] > values[:, 1]
    two[swapped], values[swapped] = two[swapped][:, ::-1], values[swapped][:, ::-1]
    kept = np.flatnonzero(values[:, 0] < ratio**2 * values[:, 1])
    return np.column_stack([kept, two[kept, 0]])


SIFT = Matcher(sift, partial(distinct, ratio=_STEREO_RATIO), partial(distinct, ratio=_RATIO))


def learnt() -> Matcher:
    """XFeat.

    Raises:
        ConfigError: its weights are not installed.
    """
    return Matcher(XFeat.of_package().features, mutual, mutual)


@dataclass(frozen=True, slots=True, eq=False)
class MapFrame:
    """What a matcher keeps of a place.

    Attributes:
        words: (N, D) float32.
        points_in_world: (N, 3).
    """

    words: Words
    points_in_world: NDArray[np.float64]


def map_frame(matcher: Matcher, world_from_cam: SE3, pair: StereoPair) -> MapFrame:
    """What corners and disparities give for one place."""
    camera = pair.camera
    (left, words), (right, others) = matcher.features(pair.left), matcher.features(pair.right)
    pairs = matcher.across(words, others)
    disparity_px = left[pairs[:, 0], 0] - right[pairs[:, 1], 0]
    level = np.abs(left[pairs[:, 0], 1] - right[pairs[:, 1], 1]) < 1.5
    kept = level & (disparity_px > 1.0) & (disparity_px < 160)
    pixels, depth_m = left[pairs[kept, 0]], camera.focal_baseline / disparity_px[kept]
    rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = np.column_stack([rays, np.ones(len(rays))]) * depth_m[:, None]
    return MapFrame(words[pairs[kept, 0]], world_from_cam @ points)


@dataclass(frozen=True, slots=True)
class Answer:
    """Where one picture was placed.

    Attributes:
        inliers: of the pose; 0 without one.
        off_m, off_deg: from the truth; infinite without a pose.
    """

    inliers: int
    off_m: float = np.inf
    off_deg: float = np.inf

    @property
    def near(self) -> bool:
        """Within the widest of the thresholds of RobotCar Seasons."""
        return self.off_m < _NEAR_M and self.off_deg < _NEAR_DEG


def placed(
    matcher: Matcher, image: NDArray[np.uint8], frames: list[MapFrame], camera: StereoCamera,
    truth: SE3,
) -> Answer:  # fmt: skip
    """One picture against some frames of the map."""
    pixels, words = matcher.features(image)
    points, seen = [], []
    for frame in frames:
        pairs = matcher.over_time(words, frame.words)
        points.append(frame.points_in_world[pairs[:, 1]])
        seen.append(pixels[pairs[:, 0]])
    in_world, in_image = np.concatenate(points), np.concatenate(seen)
    if len(in_world) < _LEAST_INLIERS:
        return Answer(0)
    found = resected(in_world, in_image, camera)
    if found is None:
        return Answer(0)
    cam_from_world, inliers = found
    off = cam_from_world @ truth
    angle_deg = np.degrees(np.linalg.norm(off.log()[3:]))
    return Answer(int(inliers.sum()), float(np.linalg.norm(off.translation)), float(angle_deg))


def resected(
    points: NDArray[np.float64], pixels: NDArray[np.float64], camera: StereoCamera
) -> tuple[SE3, NDArray[np.bool_]] | None:
    """cam_from_points and which of the points (N, 3) it puts near their pixels (N, 2), if any."""
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    cv2.setRNGSeed(1)
    found, turn, shift, rows = cv2.solvePnPRansac(
        points, pixels, matrix, None, iterationsCount=2000, reprojectionError=_PNP_PX,
        confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not found or len(rows) < _LEAST_INLIERS:
        return None
    inliers = np.zeros(len(points), dtype=bool)
    inliers[rows[:, 0]] = True
    turn, shift = cv2.solvePnPRefineLM(points[inliers], pixels[inliers], matrix, None, turn, shift)
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    return SE3(rotation, np.asarray(shift[:, 0], dtype=np.float64)), inliers


class Mapped:
    """Places of a town as one visit has seen them; the map is made when it is first asked.

    Args:
        matcher: whose map it is.
        places: of the town.
        visit: that made it.
    """

    def __init__(self, matcher: Matcher, places: Places, visit: Visit) -> None:
        self._matcher, self._places, self._visit = matcher, places, visit

    @cached_property
    def _frames(self) -> list[tuple[SE3, MapFrame]]:
        seen = self._places.pairs(self._visit)
        return [(pose, map_frame(self._matcher, pose, pair)) for pose, pair in seen]

    def answers(self, visit: Visit) -> list[Answer]:
        """Every place of another visit against the map."""
        centres, found = np.array([pose.translation for pose, _ in self._frames]), []
        for pose, pair in self._places.pairs(visit, AHEAD_M, ASIDE_M):
            away_m = np.linalg.norm(centres - pose.translation, axis=1)
            near = [self._frames[k][1] for k in np.argsort(away_m)[:_MAP_FRAMES]]
            found.append(placed(self._matcher, pair.left, near, pair.camera, pose))
        return found


_KEY = ("what", "town", "visit", "place")
_HEADER = (*_KEY, *(field.name for field in fields(Answer)))


class Answers:
    """What has been answered, kept in a table so that a killed run resumes.

    Args:
        file: the table, CSV; None to keep it in memory only.
        what: is asked; one table may hold several.

    Raises:
        ConfigError: the file has other columns.
    """

    def __init__(self, file: Path | None, what: str) -> None:
        self._file, self._what = file, what
        self._known: dict[tuple[int, str], list[Answer]] = {}
        if file is None or not file.exists():
            return
        with file.open(encoding="utf-8", newline="") as table:
            reader = csv.DictReader(table)
            if tuple(reader.fieldnames or ()) != _HEADER:
                raise ConfigError(f"{file}: has columns {reader.fieldnames}, not {_HEADER}")
            for row in reader:
                if row["what"] == what:
                    answer = Answer(int(row["inliers"]), float(row["off_m"]), float(row["off_deg"]))
                    self._known.setdefault((int(row["town"]), row["visit"]), []).append(answer)

    def of(self, town: int, mapped: Mapped, visit: Visit) -> list[Answer]:
        """Of all places of a town, asked only if the table does not hold them."""
        known = self._known.get((town, visit.name))
        if known is None:
            known = self._known[town, visit.name] = mapped.answers(visit)
            self._keep(town, visit.name, known)
        return known

    def _keep(self, town: int, visit: str, answers: list[Answer]) -> None:
        """All places of a visit with one write, which a killed run leaves whole or out."""
        if self._file is None:
            return
        lines = [] if self._file.exists() else [",".join(_HEADER)]
        for place, answer in enumerate(answers):
            inliers, off_m, off_deg = astuple(answer)
            lines.append(f"{self._what},{town},{visit},{place},{inliers},{off_m:.3f},{off_deg:.3f}")
        descriptor = os.open(self._file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(descriptor, ("\n".join(lines) + "\n").encode())
        finally:
            os.close(descriptor)
