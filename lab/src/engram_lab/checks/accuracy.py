"""Accuracy on the real clips that ENGRAM_DATA names, at the shipped defaults.

python -m engram_lab.checks.accuracy                       # all of them
python -m engram_lab.checks.accuracy odometry basin --json results.json
"""

from __future__ import annotations

import csv
import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from engram.frontend.frame import Frame, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import Match, MatcherConfig, match_frames
from engram.geometry.se3 import SE3
from engram.odometry.odometry import Odometry, OdometryConfig
from engram.sequences.opening import open_drive
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
CAM0_FROM_CAM2_M = np.array([-0.0598, 0.0004, -0.0027])


def frames_of(folder: Path, **options: Any) -> list[Frame]:
    frontend = Frontend(FrontendConfig(thumbnails=False))
    pairs = open_drive(folder, **options)
    return [frontend.extract(pair) for pair in pairs if isinstance(pair, StereoPair)]


def kitti_truth(file: Path) -> list[SE3]:
    return [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(file)]


def match(reference: Frame, live: Frame) -> Match:
    """An unguided attempt at the default threshold: no pose where it would not pass."""
    found = match_frames(reference, live, MatcherConfig(), seed=live.stamp_ns % 2**63)
    if found.inliers >= MIN_INLIERS:
        return found
    nothing = np.empty(0, np.int32)
    return Match(None, None, found.inliers, nothing, nothing)


def error_of(found: Match, truth: SE3) -> tuple[float, float] | None:
    if found.reference_from_live is None:
        return None
    wrong = found.reference_from_live @ truth.inverse()
    direct = found.reference_from_live.translation - truth.translation
    return float(np.linalg.norm(direct)), wrong.angle_rad


def odometry(data: Path) -> Iterator[Figure]:
    """KITTI 06: drift over 10–50 m segments, and whether the covariance is honest."""
    frames, truth = frames_of(data / KITTI_06), kitti_truth(data / KITTI_06_TRUTH)
    steps = [step(frame) for step in [Odometry(OdometryConfig()).step] for frame in frames]
    poses, chi2 = [SE3.identity()], []
    for k, step in enumerate(steps[1:], start=1):
        if step.prev_from_curr is None or step.covariance is None:
            raise SystemExit(f"odometry failed at frame {k}: {step.status}")
        poses.append(poses[-1] @ step.prev_from_curr)
        wrong = (step.prev_from_curr @ (truth[k - 1].inverse() @ truth[k]).inverse()).log()
        chi2.append(wrong @ np.linalg.solve(step.covariance, wrong))
    translation, rotation = segment_errors(poses, truth)
    yield Figure("translation over 10–50 m segments", 100 * translation, "%")
    yield Figure("rotation", np.degrees(rotation), "°/m")
    end = truth[-1].inverse() @ poses[-1]
    length = sum((a.inverse() @ b).distance_m for a, b in itertools.pairwise(truth))
    yield Figure("first to last frame", 100 * end.distance_m / length, "%")
    yield Figure("normalised error, root of mean χ²/6", float(np.sqrt(np.mean(chi2) / 6)))
    yield Figure("inliers, median", float(np.median([s.inliers for s in steps[1:]])))


def segment_errors(poses: list[SE3], truth: list[SE3]) -> tuple[float, float]:
    """Mean translation error per metre, and rotation in rad/m, over all segments [KITTI devkit]."""
    driven = np.concatenate(
        [
            [0],
            np.cumsum([(a.inverse() @ b).distance_m for a, b in itertools.pairwise(truth)]),
        ]
    )
    translation, rotation = [], []
    for first in range(len(truth)):
        for length_m in range(10, 51, 10):
            last = int(np.searchsorted(driven, driven[first] + length_m))
            if last >= len(truth):
                break
            wrong = (poses[first].inverse() @ poses[last]).inverse() @ (
                truth[first].inverse() @ truth[last]
            )
            translation.append(wrong.distance_m / length_m)
            rotation.append(wrong.angle_rad / length_m)
    return float(np.mean(translation)), float(np.mean(rotation))


def rest(data: Path) -> Iterator[Figure]:
    """EuRoC at rest: the motion that odometry sees where there is none."""
    engine, end, furthest = Odometry(), SE3.identity(), 0.0
    for frame in frames_of(data / EUROC_AT_REST):
        step = engine.step(frame)
        if step.prev_from_curr is not None:
            end = end @ step.prev_from_curr
            furthest = max(furthest, end.distance_m)
    yield Figure("apparent motion, end to end", 1000 * end.distance_m, "mm")
    yield Figure("apparent motion, furthest", 1000 * furthest, "mm")


def basin(data: Path) -> Iterator[Figure]:
    """KITTI 06, full size: pairs so far apart along the road that match within 0.25 m."""
    frames, truth = frames_of(data / KITTI_06), kitti_truth(data / KITTI_06_TRUTH)
    for apart in range(1, 11):
        passed, good = [], []
        for k in range(len(frames) - apart):
            error = error_of(
                match(frames[k], frames[k + apart]), truth[k].inverse() @ truth[k + apart]
            )
            passed.append(error is not None)
            good.append(error is not None and error[0] < NEAR_M)
        distance = np.median(
            [(a.inverse() @ b).distance_m for a, b in zip(truth, truth[apart:], strict=False)]
        )
        yield Figure(f"{distance:.1f} m apart, within {NEAR_M} m", 100 * float(np.mean(good)), "%")
        false = sum(passed) - sum(good)
        if false:
            yield Figure(f"{distance:.1f} m apart, passed but further off", float(false), "pairs")


def even_odd(data: Path) -> Iterator[Figure]:
    """KITTI 06: odd frames localised in the even frame nearest to them."""
    frames, truth = frames_of(data / KITTI_06), kitti_truth(data / KITTI_06_TRUTH)
    errors = []
    for k in range(1, len(frames), 2):
        beside = [n for n in (k - 1, k + 1) if n < len(frames)]
        near = min(beside, key=lambda n: (truth[n].inverse() @ truth[k]).distance_m)
        errors.append(error_of(match(frames[near], frames[k]), truth[near].inverse() @ truth[k]))
    found = [error for error in errors if error is not None]
    yield Figure("localised", 100 * len(found) / len(errors), "%")
    yield Figure("error, median", 100 * float(np.median([e[0] for e in found])), "cm")
    yield Figure("error, worst", 100 * max(e[0] for e in found), "cm")


def revisits(data: Path) -> Iterator[Figure]:
    """EuRoC: the 85 revisits, unguided; and pairs that look in other directions."""
    frames = {frame.stamp_ns: frame for frame in frames_of(data / EUROC)}
    truth = {
        int(row[0]): SE3.from_matrix(np.array(row[1:], dtype=float).reshape(3, 4))
        for row in (
            line.split()
            for line in (data / EUROC / "poses_world_from_rectified_cam0.txt")
            .read_text()
            .splitlines()
            if not line.startswith("#")
        )
    }
    with (data / EUROC / "revisit_pairs.csv").open() as lines:
        pairs = [(int(r["earlier_ns"]), int(r["later_ns"])) for r in csv.DictReader(lines)]
    found = [error_of(match(frames[a], frames[b]), truth[a].inverse() @ truth[b]) for a, b in pairs]
    passed = [error for error in found if error is not None]
    near = sum(error[0] < NEAR_M for error in passed)
    yield Figure("within 0.25 m", 100 * near / len(pairs), "%")
    median_m = float(np.median([error[0] for error in passed]))
    yield Figure("error, median of those that pass", 100 * median_m, "cm")
    yield Figure("passed but further off", float(len(passed) - near), "pairs")
    apart = [
        (a, b)
        for a in frames
        for b in frames
        if a < b and truth[a].rotation[:, 2] @ truth[b].rotation[:, 2] < np.cos(np.radians(75))
    ]
    inliers = [match(frames[a], frames[b]).inliers for a, b in apart]
    yield Figure(
        f"pass, of {len(apart)} pairs with axes > 75° apart",
        float(np.sum(np.array(inliers) >= MIN_INLIERS)),
        "pairs",
    )
    yield Figure("most inliers among them", float(max(inliers)))


def cross_rig(data: Path) -> Iterator[Figure]:
    """Drive 0001: a map of the grey rig, the colour rig localised in it; then its blue channel."""
    grey = frames_of(data / DRIVE_0001)
    for channel in ("grey", "blue"):
        live = frames_of(data / DRIVE_0001, rig="colour", channel=channel)
        found = [match(a, b) for a, b in zip(grey, live, strict=True)]
        errors = [
            float(np.linalg.norm(m.reference_from_live.translation - CAM0_FROM_CAM2_M))
            for m in found
            if m.reference_from_live is not None
        ]
        name = "colour rig" if channel == "grey" else "blue channel"
        yield Figure(f"{name}, matched at the same instant", 100 * len(errors) / len(grey), "%")
        yield Figure(
            f"{name}, error of cam0_from_cam2, median",
            100 * float(np.median(errors)),
            "cm",
        )
        yield Figure(f"{name}, inliers, median", float(np.median([m.inliers for m in found])))


def wrong_places(data: Path) -> Iterator[Figure]:
    """Inliers between places that have nothing to do with each other."""
    street, room = frames_of(data / KITTI_06)[::5], frames_of(data / EUROC)[::6]
    trams = frames_of(data / DRIVE_0001)[::5]
    for name, a, b in (
        ("KITTI 06 / drive 0001", street, trams),
        ("KITTI 06 / EuRoC", street, room),
        ("drive 0001 / EuRoC", trams, room),
    ):
        inliers = np.array([match(x, y).inliers for x in a for y in b])
        yield Figure(
            f"{name}: any consensus, of {len(inliers)}", 100 * float(np.mean(inliers > 0)), "%"
        )
        yield Figure(f"{name}: most inliers", float(inliers.max()))


PARTS: dict[str, Callable[[Path], Iterator[Figure]]] = {
    "odometry": odometry,
    "rest": rest,
    "basin": basin,
    "even_odd": even_odd,
    "revisits": revisits,
    "cross_rig": cross_rig,
    "wrong_places": wrong_places,
}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    asked = parser.parse_args()
    if unknown := set(asked.parts) - set(PARTS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(PARTS)}")
    if not os.environ.get("ENGRAM_DATA"):
        parser.error("set ENGRAM_DATA to the folder of the real images")
    for part in asked.parts or PARTS:
        title = f"{part}: {(PARTS[part].__doc__ or '').splitlines()[0]}"
        report(PARTS[part](Path(os.environ["ENGRAM_DATA"])), asked.json, title)


if __name__ == "__main__":
    main()
