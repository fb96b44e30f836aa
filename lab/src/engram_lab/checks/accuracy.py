"""Accuracy on the real clips that ENGRAM_DATA names, at the shipped defaults.

python -m engram_lab.checks.accuracy                       # all of them
python -m engram_lab.checks.accuracy odometry basin --json results.json
python -m engram_lab.checks.accuracy revisits seasons --kind net
"""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from engram import _core
from engram.frontend.features import feature_kind, fitted_matcher
from engram.frontend.frame import BRIEF, DescriptorKind, Frame, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import Match, MatcherConfig, match_frames
from engram.geometry.se3 import SE3
from engram.odometry.odometry import Odometry, OdometryConfig
from engram.sequences.opening import open_drive
from engram_lab.accuracy import LEVELS, squared, way_m
from engram_lab.programs import Figure, command_line, report

KITTI_06 = "kitti_odometry/sequences/06"
KITTI_06_TRUTH = "kitti_odometry/poses/06.txt"
DRIVE_0001 = "kitti_raw/2011_09_26/2011_09_26_drive_0001_sync"
EUROC = "euroc/V1_01_easy_sparse"
EUROC_AT_REST = "euroc/V1_01_easy_at_rest"

# The product's threshold, fixed beforehand (method §3).
MIN_INLIERS = 20
NEAR_M = 0.25
# Where camera 2 of KITTI's rig stands in camera 0, from its calibration.
CAM0_FROM_CAM2 = SE3(np.eye(3), np.array([-0.0598, 0.0004, -0.0027]))
# Of drive 0001: the half that no descriptor is trained on.
_RIGS_FROM = 27
# The shift of two pictures of one place counts as found within so many pixels (GRIEF).
_SHIFT_PX, _VOTE_PX, _ROW_PX = 35, 15, 60
_SEASON_CORNERS = 600

Pair = tuple[Frame, Frame, SE3]


def kitti_truth(file: Path) -> list[SE3]:
    return [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(file)]


@dataclass(frozen=True, slots=True, eq=False)
class Eyes:
    """A kind of features as it is judged, and the folder of the real images."""

    data: Path = field(default_factory=lambda: Path(os.environ.get("ENGRAM_DATA", "")))
    frontend: Frontend = field(default_factory=lambda: Frontend(FrontendConfig(thumbnails=False)))
    matcher: MatcherConfig = field(default_factory=MatcherConfig)

    @staticmethod
    def of(name: str, second_threshold: int = FrontendConfig().second_threshold) -> Eyes:
        """A kind by its name, with or without the front-end's second look."""
        config = FrontendConfig(
            descriptor=DescriptorKind(feature_kind(name).name),
            second_threshold=second_threshold,
            thumbnails=False,
        )
        matcher = fitted_matcher(MatcherConfig(), BRIEF, config.descriptor)
        return Eyes(frontend=Frontend(config), matcher=matcher)

    def frames(self, name: str, **options: Any) -> list[Frame]:
        pairs = open_drive(self.data / name, **options)
        return [self.frontend.extract(pair) for pair in pairs if isinstance(pair, StereoPair)]

    def match(self, reference: Frame, live: Frame) -> Match:
        """An unguided attempt at the default threshold: no pose where it would not pass."""
        found = match_frames(reference, live, self.matcher, seed=live.stamp_ns % 2**63)
        if found.inliers >= MIN_INLIERS:
            return found
        nothing = np.empty(0, np.int32)
        return Match(None, None, found.inliers, nothing, nothing)

    def errors_m(self, pairs: Sequence[Pair]) -> list[float | None]:
        """Distance of each pose from the true one; None where nothing matches."""
        return [error_m(self.match(a, b), a_from_b) for a, b, a_from_b in pairs]


def error_m(found: Match, truth: SE3) -> float | None:
    """Distance of a measured from the true position; None without a pose."""
    if found.reference_from_live is None:
        return None
    return float(np.linalg.norm(found.reference_from_live.translation - truth.translation))


def _rated(name: str, errors_m: Sequence[float | None]) -> Iterator[Figure]:
    passed = [one for one in errors_m if one is not None]
    near = sum(one < NEAR_M for one in passed)
    yield Figure(f"{name}, within {NEAR_M} m", 100 * near / len(errors_m), "%")
    yield Figure("  passed but further off", len(passed) - near, "pairs")
    if passed:
        yield Figure("  error, median", 100 * float(np.median(passed)), "cm")
        yield Figure("  error, worst", 100 * max(passed), "cm")


def odometry(eyes: Eyes) -> Iterator[Figure]:
    """KITTI 06: drift over 10–50 m segments; drive 0001: whether two rigs drive the same."""
    frames, truth = eyes.frames(KITTI_06), kitti_truth(eyes.data / KITTI_06_TRUTH)
    engine = Odometry(OdometryConfig())
    steps = [engine.step(frame) for frame in frames]
    poses, off_m = [SE3.identity()], []
    for k, step in enumerate(steps[1:], start=1):
        if step.prev_from_curr is None:
            raise SystemExit(f"odometry failed at frame {k}: {step.status}")
        poses.append(poses[-1] @ step.prev_from_curr)
        off_m.append((truth[k].inverse() @ truth[k - 1] @ step.prev_from_curr).distance_m)
    translation, rotation = segment_errors(poses, truth[: len(poses)])
    yield Figure("translation over 10–50 m segments", 100 * translation, "%")
    yield Figure("rotation", np.degrees(rotation), "°/m")
    end = truth[-1].inverse() @ poses[-1]
    yield Figure("first to last frame", 100 * end.distance_m / way_m(truth), "%")
    yield Figure("step, median error", 1000 * float(np.median(off_m)), "mm")
    yield Figure("inliers, median", float(np.median([s.inliers for s in steps[1:]])))
    yield from _two_rigs(eyes)


def _two_rigs(eyes: Eyes) -> Iterator[Figure]:
    """How far the motions of drive 0001's two rigs differ, and whether covariances explain that.

    KITTI's truth is vaguer than a step: its own jitter turns by a few tenths of a milliradian.
    """
    grey, colour = (_steps(eyes.frames(DRIVE_0001, rig=rig)) for rig in ("grey", "colour"))
    grey_from_colour = CAM0_FROM_CAM2
    adjoint = grey_from_colour.adjoint()
    apart_m, chi2_apart, ends = [], [], [SE3.identity(), SE3.identity()]
    for one, other in zip(grey, colour, strict=True):
        (motion, covariance), (seen, vague) = one, other
        same = grey_from_colour @ seen @ grey_from_colour.inverse()
        apart_m.append((motion.inverse() @ same).distance_m)
        chi2_apart.append(squared(motion, covariance + adjoint @ vague @ adjoint.T, same))
        ends = [ends[0] @ motion, ends[1] @ same]
    driven_m = sum(motion.distance_m for motion, _ in grey)
    yield Figure("two rigs: steps apart, median", 1000 * float(np.median(apart_m)), "mm")
    end_m = (ends[0].inverse() @ ends[1]).distance_m
    yield Figure("  ends apart", 100 * end_m / driven_m, "%")
    for level in LEVELS:
        inside = float((np.array(chi2_apart) <= chi2.ppf(level, 6)).mean())
        yield Figure(f"  inside {100 * level:.0f} %", 100 * inside, "%")


def _steps(frames: Sequence[Frame]) -> list[tuple[SE3, NDArray[np.float64]]]:
    """Motions of odometry with their covariances; all must succeed."""
    engine, found = Odometry(), []
    for step in [engine.step(frame) for frame in frames][1:]:
        assert step.prev_from_curr is not None
        assert step.covariance is not None
        found.append((step.prev_from_curr, step.covariance))
    return found


def segment_errors(poses: list[SE3], truth: list[SE3]) -> tuple[float, float]:
    """Mean translation error per metre, and rotation in rad/m, over all segments [KITTI devkit]."""
    steps = [(a.inverse() @ b).distance_m for a, b in itertools.pairwise(truth)]
    driven = np.concatenate([[0], np.cumsum(steps)])
    translation, rotation = [], []
    for first, length_m in itertools.product(range(len(truth)), range(10, 51, 10)):
        last = int(np.searchsorted(driven, driven[first] + length_m))
        if last < len(truth):
            wrong = (poses[first].inverse() @ poses[last]).inverse() @ (
                truth[first].inverse() @ truth[last]
            )
            translation.append(wrong.distance_m / length_m)
            rotation.append(wrong.angle_rad / length_m)
    return float(np.mean(translation)), float(np.mean(rotation))


def rest(eyes: Eyes) -> Iterator[Figure]:
    """EuRoC at rest: the motion that odometry sees where there is none."""
    engine, end, furthest = Odometry(), SE3.identity(), 0.0
    for frame in eyes.frames(EUROC_AT_REST):
        step = engine.step(frame)
        if step.prev_from_curr is not None:
            end = end @ step.prev_from_curr
            furthest = max(furthest, end.distance_m)
    yield Figure("apparent motion, end to end", 1000 * end.distance_m, "mm")
    yield Figure("apparent motion, furthest", 1000 * furthest, "mm")


def basin(eyes: Eyes) -> Iterator[Figure]:
    """KITTI 06, full size: pairs so far apart along the road that match within 0.25 m."""
    frames, truth = eyes.frames(KITTI_06), kitti_truth(eyes.data / KITTI_06_TRUTH)
    for apart in range(1, 11):
        pairs = [
            (frames[k], frames[k + apart], truth[k].inverse() @ truth[k + apart])
            for k in range(len(frames) - apart)
        ]
        distance_m = np.median([a_from_b.distance_m for _, _, a_from_b in pairs])
        yield from _rated(f"KITTI 06, {distance_m:.1f} m apart", eyes.errors_m(pairs))


def even_odd(eyes: Eyes) -> Iterator[Figure]:
    """KITTI 06: odd frames localised in the even frame nearest to them."""
    frames, truth = eyes.frames(KITTI_06), kitti_truth(eyes.data / KITTI_06_TRUTH)
    pairs = []
    for k in range(1, len(frames), 2):
        beside = [n for n in (k - 1, k + 1) if n < len(frames)]
        near = min(beside, key=lambda n: (truth[n].inverse() @ truth[k]).distance_m)
        pairs.append((frames[near], frames[k], truth[near].inverse() @ truth[k]))
    errors = eyes.errors_m(pairs)
    yield Figure("localised", 100 * sum(e is not None for e in errors) / len(errors), "%")
    yield from _rated("KITTI 06, odd in even frames", errors)


def revisits(eyes: Eyes) -> Iterator[Figure]:
    """EuRoC: the 85 revisits, unguided; and pairs that look in other directions."""
    frames = {frame.stamp_ns: frame for frame in eyes.frames(EUROC)}
    truth = euroc_truth(eyes.data / EUROC)
    pairs = [
        (frames[a], frames[b], truth[a].inverse() @ truth[b])
        for a, b in euroc_revisits(eyes.data / EUROC)
    ]
    yield from _rated("EuRoC V1_01, revisits", eyes.errors_m(pairs))
    apart = [
        (a, b)
        for a, b in itertools.combinations(sorted(frames), 2)
        if truth[a].rotation[:, 2] @ truth[b].rotation[:, 2] < np.cos(np.radians(75))
    ]
    inliers = np.array([eyes.match(frames[a], frames[b]).inliers for a, b in apart])
    falsely = int((inliers >= MIN_INLIERS).sum())
    yield Figure(f"pass, of {len(apart)} pairs with axes > 75° apart", falsely, "pairs")
    yield Figure("most inliers among them", int(inliers.max()))


def euroc_truth(folder: Path) -> dict[int, SE3]:
    """True poses of the rectified left camera, by stamp."""
    lines = (folder / "poses_world_from_rectified_cam0.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    return {int(r[0]): SE3.from_matrix(np.array(r[1:], float).reshape(3, 4)) for r in rows}


def euroc_revisits(folder: Path) -> list[tuple[int, int]]:
    """Stamps of each pair of views of one place, ns."""
    with (folder / "revisit_pairs.csv").open() as lines:
        return [(int(r["earlier_ns"]), int(r["later_ns"])) for r in csv.DictReader(lines)]


def cross_rig(eyes: Eyes) -> Iterator[Figure]:
    """Drive 0001: a map of the grey rig, the colour rig localised in it; then its blue channel."""
    grey = eyes.frames(DRIVE_0001)
    for channel in ("grey", "blue"):
        live = eyes.frames(DRIVE_0001, rig="colour", channel=channel)
        pairs = [(a, b, CAM0_FROM_CAM2) for a, b in zip(grey, live, strict=True)]
        name = "colour rig" if channel == "grey" else "blue channel"
        yield from _rated(f"{name} at the same instant", eyes.errors_m(pairs))
        yield from _rated("  from frame 27 on", eyes.errors_m(pairs[_RIGS_FROM:]))


def seasons(eyes: Eyes) -> Iterator[Figure]:
    """Stromovka: five places on twelve visits until snow: which shift do matches vote for?"""
    folder = eyes.data / "places/stromovka_12x5"
    kind = feature_kind(eyes.frontend.config.descriptor)
    seen = {}
    for visit, place in itertools.product(range(1, 13), range(1, 6)):
        image = cv2.imread(str(folder / f"images/{visit:02d}{place:02d}.jpg"), cv2.IMREAD_GRAYSCALE)
        grey = np.ascontiguousarray(image, dtype=np.uint8)
        pixels = _corners(grey, eyes.frontend)
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
    yield Figure("Stromovka, image pairs", float(100 * best / len(found)), "%")


def _corners(image: NDArray[np.uint8], frontend: Frontend) -> NDArray[np.float32]:
    config, (height, width) = frontend.config, image.shape
    positions, scores, _ = _core.detect_corners(image, config.fast_threshold)
    order = _core.order_corners(positions, scores, width, height, config.cell_px)
    count = round(_SEASON_CORNERS * (image.size / (512 * 384)) ** 0.6)
    return positions[order[:count]].astype(np.float32)


Described = tuple[NDArray[np.float32], NDArray[np.uint8]]


def _shift_px(a: Described, b: Described) -> float | None:
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


PARTS: dict[str, Callable[[Eyes], Iterator[Figure]]] = {
    "odometry": odometry,
    "rest": rest,
    "basin": basin,
    "even_odd": even_odd,
    "revisits": revisits,
    "cross_rig": cross_rig,
    "seasons": seasons,
}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--kind", default="brief", help="of features")
    asked = parser.parse_args()
    if unknown := set(asked.parts) - set(PARTS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(PARTS)}")
    if not os.environ.get("ENGRAM_DATA"):
        parser.error("set ENGRAM_DATA to the folder of the real images")
    for part in asked.parts or PARTS:
        title = f"{part}: {(PARTS[part].__doc__ or '').splitlines()[0]}"
        report(PARTS[part](Eyes.of(asked.kind)), asked.json, title)


if __name__ == "__main__":
    main()
