"""Protocol O: the error of a stereo odometry that is not ours, in rain and at night ÷ dry.

    python -m engram_lab.roads.odometry [--towns 501,502,503]

OpenCV alone: corners tracked by Lucas and Kanade into the right picture and the next left one, PnP
with RANSAC. The same drive is driven by day, in 4 mm/h and at night. On the road rain made the
error 2.5 times as large (150 m, arXiv 2409.01038).
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
_DAY = datetime(2025, 7, 17, 11, tzinfo=UTC)
_CONDITIONS = (
    ("dry", _DAY, "overcast"),
    ("rain", _DAY, "rain"),
    ("night", _DAY.replace(hour=23), "fair"),
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
    image: NDArray[np.uint8], other: NDArray[np.uint8], pixels: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where pixels (N, 2) of one picture are in another, and which come back to where they were."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(image, other, pixels, np.empty_like(pixels))
    back, _, _ = cv2.calcOpticalFlowPyrLK(other, image, there, np.empty_like(pixels))
    near = np.linalg.norm(back - pixels, axis=1) < _BACK_PX
    return np.asarray(there, dtype=np.float32), np.asarray(found[:, 0].astype(bool) & near)


def motion(before: StereoPair, now: StereoPair) -> SE3 | None:
    """before_from_now, None where too few corners agree."""
    camera = before.camera
    corners = cv2.goodFeaturesToTrack(before.left, _CORNERS, _QUALITY, _APART_PX)
    if corners is None:
        return None
    pixels = np.asarray(corners[:, 0], dtype=np.float32)
    right, in_right = tracked(before.left, before.right, pixels)
    ahead, in_next = tracked(before.left, now.left, pixels)
    disparity_px = (pixels - right)[:, 0]
    kept = in_right & in_next & (disparity_px > 1) & (np.abs((pixels - right)[:, 1]) < 1.5)
    if kept.sum() < 6:
        return None
    depth_m = camera.focal_baseline / disparity_px[kept].astype(np.float64)
    rays = (pixels[kept] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = np.column_stack([rays, np.ones(len(rays))]) * depth_m[:, None]
    found = resected(points, ahead[kept].astype(np.float64), camera)
    return None if found is None else found[0].inverse()


def course(drive: SimulatedDrive) -> Course:
    """Odometry along a drive."""
    steps, last = [], SE3.identity()
    lost = 0
    for before, now in itertools.pairwise(drive):
        step = motion(before, now)
        lost += step is None
        last = last if step is None else step
        steps.append(last)
    poses = list(itertools.accumulate(steps, lambda pose, one: pose @ one, initial=SE3.identity()))
    return Course(lap_drift(poses, drive.world_from_cams()), lost / len(steps))


def figures(towns: list[int], loop_m: float) -> Iterator[Figure]:
    """Drift of each condition, all towns together, and its ratio to the dry one."""
    drifts = {}
    for name, start, weather in _CONDITIONS:
        courses = []
        for town in towns:
            hamlet = campaign_named("hamlet", town)
            plan = replace(hamlet.sessions[0], start=start, weather=weather)
            campaign = replace(hamlet, length_m=loop_m, sessions=(plan,))
            courses.append(course(SimulatedDrive(campaign, 0)))
        drifts[name] = float(np.mean([one.drift for one in courses]))
        yield Figure(f"{name}: drift", 100 * drifts[name], "%")
        yield Figure(f"{name}: steps lost", 100 * float(np.mean([c.lost for c in courses])), "%")
    yield Figure("rain / dry (road 2.5)", drifts["rain"] / drifts["dry"])
    yield Figure("night / dry", drifts["night"] / drifts["dry"])


def main() -> None:
    """Command line."""
    parser = command_line(__doc__)
    parser.add_argument("--towns", type=numbers, default=list(JUDGED))
    parser.add_argument("--loop", type=float, default=_LOOP_M, metavar="M", help="length")
    asked = parser.parse_args()
    report(figures(asked.towns, asked.loop), asked.json, f"towns {asked.towns}")


if __name__ == "__main__":
    main()
