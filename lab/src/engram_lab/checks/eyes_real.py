"""Real clips that kinds of features are judged on: EuRoC, KITTI, two rigs, seasons."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engram import _core
from engram.frontend.features import feature_kind
from engram.frontend.frame import Frame
from engram.frontend.frontend import Frontend
from engram.frontend.matching import Match
from engram.geometry.se3 import SE3
from engram.odometry.odometry import Odometry, OdometryConfig
from engram_lab.checks.accuracy import segment_errors
from engram_lab.eyes import clip

Matching = Callable[[Frame, Frame], Match]
Pair = tuple[Frame, Frame, SE3]
Judge = Callable[[Frontend, Matching, Path], Iterator[tuple[str, float, float, int]]]

LEAST_INLIERS, WITHIN_M = 20, 0.25
# Frames of KITTI 06 that lie so many apart are 8.4, 9.6 and 12 m apart.
_KITTI_STEPS = {"8.4 m": 7, "9.6 m": 8, "12 m": 10}
# Of KITTI raw drive 0001: the half that no descriptor is trained on.
_RIGS_FROM = 27
_GREY_FROM_COLOUR_M = np.array([-0.0598, 0.0004, -0.0027])
# The shift of two pictures of one place counts as found within so many pixels (GRIEF).
_SHIFT_PX, _VOTE_PX, _ROW_PX = 35, 15, 60
_SEASON_CORNERS = 600


def _judge(matching: Matching, pairs: list[Pair], what: str) -> tuple[str, float, float, int]:
    right = wrong = 0
    for a, b, a_from_b in pairs:
        match = matching(a, b)
        if match.inliers < LEAST_INLIERS or match.reference_from_live is None:
            continue
        off = match.reference_from_live.translation - a_from_b.translation
        good = bool(np.linalg.norm(off) < WITHIN_M)
        right, wrong = right + good, wrong + (not good)
    return what, right, len(pairs), wrong


def posed_pairs(frontend: Frontend, data: Path) -> Iterator[tuple[str, list[Pair]]]:
    """Pairs of real frames with the true pose of the second in the first, clip by clip."""
    room = _Room(frontend, data)
    yield "EuRoC V1_01, revisits", room.revisits
    yield from _along_kitti(frontend, data)
    yield "KITTI raw 0001 from frame 27, grey / colour rig", _of_two_rigs(frontend, data)


class _Room:
    """EuRoC V1_01: frames by their stamps, and true world_from_cam."""

    def __init__(self, frontend: Frontend, data: Path) -> None:
        folder = data / "euroc/V1_01_easy_sparse"
        self.frames = {pair.stamp_ns: frontend.extract(pair) for pair in clip(folder)}
        lines = (folder / "poses_world_from_rectified_cam0.txt").read_text().splitlines()
        rows = [line.split() for line in lines if not line.startswith("#")]
        self.poses = {
            int(row[0]): SE3.from_matrix(np.array(row[1:], float).reshape(3, 4)) for row in rows
        }
        with (folder / "revisit_pairs.csv").open() as file:
            again = [(int(row["earlier_ns"]), int(row["later_ns"])) for row in csv.DictReader(file)]
        self.revisits = [
            (self.frames[a], self.frames[b], self.poses[a].inverse() @ self.poses[b])
            for a, b in again
        ]


def euroc(
    frontend: Frontend, matching: Matching, data: Path
) -> Iterator[tuple[str, float, float, int]]:
    """A room seen again, and views of it that share nothing."""
    room = _Room(frontend, data)
    frames, poses = room.frames, room.poses
    yield _judge(matching, room.revisits, "EuRoC V1_01, revisits")
    apart = [
        (a, b)
        for a, b in itertools.combinations(sorted(frames), 2)
        if poses[a].rotation[:, 2] @ poses[b].rotation[:, 2] < np.cos(np.radians(75))
    ]
    falsely = sum(matching(frames[a], frames[b]).inliers >= LEAST_INLIERS for a, b in apart)
    yield "EuRoC V1_01, views that share nothing", falsely, len(apart), 0


def kitti(
    frontend: Frontend, matching: Matching, data: Path
) -> Iterator[tuple[str, float, float, int]]:
    """A street, further and further ahead."""
    for what, pairs in _along_kitti(frontend, data):
        yield _judge(matching, pairs, what)


def _along_kitti(frontend: Frontend, data: Path) -> Iterator[tuple[str, list[Pair]]]:
    folder = data / "kitti_odometry"
    frames = [frontend.extract(pair) for pair in clip(folder / "sequences/06")]
    poses = [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(folder / "poses/06.txt")]
    for what, step in _KITTI_STEPS.items():
        yield (
            f"KITTI 06, {what} apart",
            [
                (frames[k], frames[k + step], poses[k].inverse() @ poses[k + step])
                for k in range(len(frames) - step)
            ],
        )


def odometry(
    frontend: Frontend, matching: Matching, data: Path
) -> Iterator[tuple[str, float, float, int]]:
    """How far odometry drifts, in per cent of the distance."""
    del matching
    folder, engine = data / "kitti_odometry", Odometry(OdometryConfig())
    truth = [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(folder / "poses/06.txt")]
    poses = [SE3.identity()]
    for pair in clip(folder / "sequences/06"):
        step = engine.step(frontend.extract(pair)).prev_from_curr
        poses.append(poses[-1] @ (step or SE3.identity()))
    drift, _ = segment_errors(poses[1:], truth)
    yield "KITTI 06, odometry, % of the way (less is better)", round(100 * drift, 2), 100, 0


def rigs(
    frontend: Frontend, matching: Matching, data: Path
) -> Iterator[tuple[str, float, float, int]]:
    """One street at the same time through another stereo camera."""
    what = "KITTI raw 0001 from frame 27, grey / colour rig"
    yield _judge(matching, _of_two_rigs(frontend, data), what)


def _of_two_rigs(frontend: Frontend, data: Path) -> list[Pair]:
    folder = data / "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync"
    grey, colour = (
        [frontend.extract(pair) for pair in pairs[_RIGS_FROM:]]
        for pairs in (clip(folder), clip(folder, rig="colour"))
    )
    grey_from_colour = SE3(np.eye(3), _GREY_FROM_COLOUR_M)
    return [(a, b, grey_from_colour) for a, b in zip(grey, colour, strict=True)]


def seasons(
    frontend: Frontend, matching: Matching, data: Path
) -> Iterator[tuple[str, float, float, int]]:
    """Five places on twelve visits from September to snow: which shift do matches vote for?"""
    del matching
    folder = data / "places/stromovka_12x5"
    kind = feature_kind(frontend.config.descriptor)
    seen = {}
    for visit, place in itertools.product(range(1, 13), range(1, 6)):
        image = cv2.imread(str(folder / f"images/{visit:02d}{place:02d}.jpg"), cv2.IMREAD_GRAYSCALE)
        grey = np.ascontiguousarray(image, dtype=np.uint8)
        pixels = _corners(grey, frontend)
        octaves = np.zeros(len(pixels), np.uint8)
        seen[visit, place] = pixels, kind.describe(grey, pixels, octaves)
    truth = [np.loadtxt(folder / f"ground_truth/location_{place}.txt") for place in range(1, 6)]
    found = {
        (place, a, b): _shift_px(seen[a, place], seen[b, place])
        for place in range(1, 6)
        for a, b in itertools.combinations(range(1, 13), 2)
    }
    # The clip does not say which of two pictures its shifts are measured in.
    best = max(
        sum(
            shift is not None and abs(shift - sign * truth[place - 1][a - 1, b - 1]) <= _SHIFT_PX
            for (place, a, b), shift in found.items()
        )
        for sign in (1, -1)
    )
    yield "Stromovka, seasons, % of image pairs", round(float(100 * best / len(found)), 1), 100, 0


def _corners(image: NDArray[np.uint8], frontend: Frontend) -> NDArray[np.float32]:
    config, (height, width) = frontend.config, image.shape
    positions, scores, _ = _core.detect_corners(image, config.fast_threshold)
    order = _core.order_corners(positions, scores, width, height, config.cell_px)
    count = round(_SEASON_CORNERS * (image.size / (512 * 384)) ** 0.6)
    return positions[order[:count]].astype(np.float32)


def _shift_px(
    a: tuple[NDArray[np.float32], NDArray[np.uint8]],
    b: tuple[NDArray[np.float32], NDArray[np.uint8]],
) -> float | None:
    """How far most of the mutual nearest neighbours moved sideways; None if too few do."""
    distances = _core.hamming_matrix(a[1], b[1])
    nearest, back = distances.argmin(1), distances.argmin(0)
    rows = np.flatnonzero(back[nearest] == np.arange(len(nearest)))
    across, down = (b[0][nearest[rows]] - a[0][rows]).T
    across = across[np.abs(down) < _ROW_PX]
    if len(across) < 3:
        return None
    candidates = np.arange(-600, 601, 4)
    near = np.abs(across[None] - candidates[:, None]) < _VOTE_PX
    best = candidates[near.sum(1).argmax()]
    return float(np.median(across[np.abs(across - best) < _VOTE_PX]))


CLIPS: tuple[Judge, ...] = (euroc, kitti, odometry, rigs, seasons)
