"""Odometry and disparity of our front-end in the simulated town, against its exact truth.

    engram lab simulate village
    python -m engram_lab.checks.town_accuracy drift [--campaigns DIR]         # all laps, seconds
    python -m engram_lab.checks.town_accuracy disparity --laps 1,4,7          # a minute or so a lap
    python -m engram_lab.checks.town_accuracy disparity --laps 1 --every 40

Drift is KITTI's measure: the error over stretches of 100, 200 and 300 m ÷ their length, one from
every tenth frame on; the median of each lap, and the median over laps by day and at night.

Disparity: a landmark on the edge of a thing lies, to less than a pixel, on one of two surfaces, and
the truth at the pixel's centre is the other one's as often as not. So the nearest truth among the
3×3 pixels around it counts; the share at the very pixel is told too, and how much of what misses
there stands on an edge (truths within 3×3 pixels that differ by more than a pixel of disparity). A
corner of the half-size image is known to two pixels, and its disparity is that of the surface which
fills most of its window: the share with the right truth within 9×9 pixels tells errors from edges.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frontend import Frontend
from engram.geometry.se3 import SE3
from engram.sequences.framelog.reader import FrameLog
from engram_lab.programs import command_line
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.conditions import Conditions
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import campaign_folder, campaigns_folder
from engram_lab.truth import read_truth

STRETCHES_M = (100.0, 200.0, 300.0)


def drift(campaign: Campaign, campaigns: Path) -> None:
    """Prints each lap's drift, and the medians."""
    by_light: dict[str, list[float]] = {"by day": [], "by night": []}
    for plan in campaign.sessions:
        path = campaign_folder(campaigns, campaign) / f"{plan.name}.framelog"
        truth = read_truth(path)
        if truth is None:
            raise SystemExit(f"{path}: not rendered; run: engram lab simulate {campaign.home}")
        moment = Conditions(plan.start, plan.weather, plan.seed, campaign.place).at(0, 0)
        light = "by night" if moment.lamps_on else "by day"
        log = FrameLog(path)
        steps = [one.odometry.prev_from_curr for one in log]
        log.close()
        lost = sum(step is None for step in steps[1:])
        poses = list(
            itertools.accumulate(
                (SE3.identity() if step is None else step for step in steps[1:]),
                lambda pose, step: pose @ step,
                initial=SE3.identity(),
            )
        )
        lap = lap_drift(poses, list(truth.world_from_cam))
        by_light[light].append(lap)
        print(f"{plan.name:45} {light:9} {100 * lap:6.2f} %  {lost:3} frames without motion")
    for light, laps in by_light.items():
        asked = "1" if light == "by day" else "2"
        print(
            f"median {light}: {100 * float(np.median(laps)):.2f} % of {len(laps)} laps (≤ {asked})"
        )


def lap_drift(poses: Sequence[SE3], truth: Sequence[SE3]) -> float:
    """Median error over `STRETCHES_M`, as a share of their length; NaN for a shorter lap."""
    steps = [(a.inverse() @ b).distance_m for a, b in itertools.pairwise(truth)]
    driven_m = np.concatenate([[0.0], np.cumsum(steps)])
    errors = []
    for first in range(0, len(truth), 10):
        for length_m in STRETCHES_M:
            last = int(np.searchsorted(driven_m, driven_m[first] + length_m))
            if last < len(truth):
                found = poses[first].inverse() @ poses[last]
                wrong = found.inverse() @ (truth[first].inverse() @ truth[last])
                errors.append(wrong.distance_m / length_m)
    return float(np.median(errors)) if errors else float("nan")


def disparity(campaign: Campaign, laps: Sequence[int], every: int) -> None:
    """Prints how well disparities of landmarks agree with truth."""
    frontend = Frontend()
    for number in laps:
        drive = SimulatedDrive(campaign, number)
        found = [frame_disparity(drive, frontend, k) for k in range(every // 2, len(drive), every)]
        error, nearest, wide, spread = (np.concatenate(part) for part in zip(*found, strict=True))
        misses = np.abs(error) > 1
        on_edge = float((spread[misses] > 1).mean()) if misses.any() else 0.0
        print(
            f"{drive.plan.name}: {len(error)} landmarks; median {np.median(error):+.3f} px, "
            f"MAD {np.median(np.abs(error - np.median(error))):.3f} px; within 1 px "
            f"{100 * (np.abs(nearest) <= 1).mean():.1f} % (at the very pixel "
            f"{100 * (~misses).mean():.1f} %; of its misses {100 * on_edge:.0f} % on an edge; of a "
            f"truth within 4 px {100 * (np.abs(wide) <= 1).mean():.1f} %)"
        )


def frame_disparity(
    drive: SimulatedDrive, frontend: Frontend, frame: int
) -> tuple[NDArray[np.float64], ...]:
    """Of one frame's landmarks: error at the pixel, least within 3×3 and 9×9, spread within 3×3.

    All in px, (N,) each; the spread is that of the truths.
    """
    pair = next(iter(drive.frames(frame, frame + 1)))
    truth = next(iter(drive.truths(frame, frame + 1)))
    camera = drive.camera
    true_px = camera.fx * camera.baseline_m / np.asarray(truth.depth_m, dtype=np.float64)
    landmarks = frontend.extract(pair).landmarks
    columns, rows = np.rint(landmarks.pixels).astype(int).T

    def truths(reach: int) -> NDArray[np.float64]:
        """((2 reach + 1)², N) true disparities of the pixels around each landmark."""
        steps = range(-reach, reach + 1)
        return np.stack(
            [
                true_px[
                    np.clip(rows + down, 0, camera.height - 1),
                    np.clip(columns + right, 0, camera.width - 1),
                ]
                for down in steps
                for right in steps
            ]
        )

    def least(around: NDArray[np.float64]) -> NDArray[np.float64]:
        errors = found_px - around
        return np.asarray(np.take_along_axis(errors, np.abs(errors).argmin(0)[None], 0)[0])

    found_px = landmarks.disparity_px.astype(np.float64)
    near = truths(1)
    return found_px - near[4], least(near), least(truths(4)), near.max(0) - near.min(0)


def main() -> None:
    """Reads the command line."""
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("drift", "disparity"))
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    parser.add_argument("--laps", default="1,4,7", help="numbers, joined by commas")
    parser.add_argument("--every", type=int, default=20, help="frames between those looked at")
    asked = parser.parse_args()
    village = campaign_named("village")
    if asked.what == "drift":
        drift(village, asked.campaigns)
    else:
        disparity(village, [int(one) for one in asked.laps.split(",")], asked.every)


if __name__ == "__main__":
    main()
