"""Protocol O: the error of a stereo odometry that is not ours, in rain and at night ÷ dry.

    python -m engram_lab.roads.odometry [--towns 504,505,506]

OpenCV alone: corners tracked by Lucas and Kanade into the right picture and, begun at the last
motion, into the next left one; PnP with RANSAC; the last motion where fewer than half agree. The
same drive is driven by day, in rain and at night. On the road rain made the error 2.5 times as
large (150 m, arXiv 2409.01038).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram_lab.accuracy import lap_drift
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.roads.matching import resected
from engram_lab.roads.seasons import JUDGED
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

_LOOP_M = 150.0
_CORNERS, _QUALITY, _APART_PX = 800, 0.003, 8
_BACK_PX = 1.0  # between a corner and where tracking back ends
_LEAST, _AGREE = 10, 0.5  # tracks of a step that must agree, and their share
_DAY = datetime(2025, 7, 17, 11, tzinfo=UTC)
# Name, start, weather, mm/h. Of the time in which it rains in Oxford, half has less than 0.6 mm/h,
# a third more than 1, a fifteenth more than 4.
_CONDITIONS = (
    ("dry", _DAY, "overcast", None),
    ("rain of 1 mm/h", _DAY, "rain", 1.0),
    ("rain of 2 mm/h", _DAY, "rain", 2.0),
    ("rain of 4 mm/h", _DAY, "rain", 4.0),
    ("night", _DAY.replace(hour=23), "fair", None),
)


@dataclass(frozen=True, slots=True)
class Course:
    """One drive's odometry.

    Attributes:
        drift: median error over 100 m, as a share of it.
        lost: share of the steps without a motion of their own; the one before stands for it.
    """

    drift: float
    lost: float


def tracked(
    image: NDArray[np.uint8],
    other: NDArray[np.uint8],
    pixels: NDArray[np.float32],
    guesses: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where pixels (N, 2) of one picture are in another, and which come back to where they were.

    Tracking begins at the guesses (N, 2).
    """
    begun = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(image, other, pixels, guesses.copy(), flags=begun)
    returned = pixels + there - guesses
    back, _, _ = cv2.calcOpticalFlowPyrLK(other, image, there, returned, flags=begun)
    near = np.linalg.norm(back - pixels, axis=1) < _BACK_PX
    return np.asarray(there, dtype=np.float32), np.asarray(found[:, 0].astype(bool) & near)


def motion(before: StereoPair, now: StereoPair, last: SE3) -> SE3 | None:
    """before_from_now, None where too few corners agree.

    Args:
        before, now: successive pairs.
        last: the motion before, from which tracking begins.
    """
    camera = before.camera
    corners = cv2.goodFeaturesToTrack(before.left, _CORNERS, _QUALITY, _APART_PX)
    if corners is None:
        return None
    pixels = np.asarray(corners[:, 0], dtype=np.float32)
    right, in_right = tracked(before.left, before.right, pixels, pixels)
    disparity_px = (pixels - right)[:, 0]
    kept = in_right & (disparity_px > 1) & (np.abs((pixels - right)[:, 1]) < 1.5)
    if kept.sum() < _LEAST:
        return None
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    pixels, depth_m = pixels[kept], camera.focal_baseline / disparity_px[kept].astype(np.float64)
    rays = np.column_stack([(pixels - centre) / focal, np.ones(len(pixels))])
    points = rays * depth_m[:, None]
    moved = last.inverse() @ points
    expected = moved[:, :2] / np.maximum(moved[:, 2:], 0.1) * focal + centre
    ahead, found = tracked(before.left, now.left, pixels, expected.astype(np.float32))
    if found.sum() < _LEAST:
        return None
    pose = resected(points[found], ahead[found].astype(np.float64), camera)
    if pose is None or pose[1].sum() < max(_LEAST, _AGREE * found.sum()):
        return None
    return pose[0].inverse()


def course(drive: SimulatedDrive) -> Course:
    """Odometry along a drive."""
    steps, last = [], SE3.identity()
    lost = 0
    for before, now in itertools.pairwise(drive):
        step = motion(before, now, last)
        lost += step is None
        last = last if step is None else step
        steps.append(last)
    poses = list(itertools.accumulate(steps, lambda pose, one: pose @ one, initial=SE3.identity()))
    return Course(lap_drift(poses, drive.world_from_cams()), lost / len(steps))


def figures(towns: list[int], loop_m: float) -> Iterator[Figure]:
    """Drift of each condition, all towns together, and its ratio to the dry one."""
    drifts = {}
    for name, start, weather, rate in _CONDITIONS:
        courses = []
        for town in towns:
            hamlet = campaign_named("hamlet", town)
            plan = replace(hamlet.sessions[0], start=start, weather=weather, rain_mm_h=rate)
            campaign = replace(hamlet, length_m=loop_m, sessions=(plan,))
            courses.append(course(SimulatedDrive(campaign, 0)))
        drifts[name] = float(np.mean([one.drift for one in courses]))
        yield Figure(f"{name}: drift", 100 * drifts[name], "%")
        yield Figure(f"{name}: steps lost", 100 * float(np.mean([c.lost for c in courses])), "%")
        if name != "dry":
            yield Figure(f"{name} / dry (rain on the road 2.5)", drifts[name] / drifts["dry"])


def main() -> None:
    """Command line."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(JUDGED))
    parser.add_argument("--loop", type=float, default=_LOOP_M, metavar="M", help="length")
    asked = parser.parse_args()
    report(figures(asked.towns, asked.loop), asked.json, f"towns {asked.towns}")


if __name__ == "__main__":
    main()
