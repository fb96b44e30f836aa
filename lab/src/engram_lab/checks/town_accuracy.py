"""Odometry and disparity of our front-end in the simulated town, against its exact truth.

    engram lab simulate village
    python -m engram_lab.checks.town_accuracy drift [--campaigns DIR]         # all laps, seconds
    python -m engram_lab.checks.town_accuracy disparity --laps 1,4,7          # a minute or so a lap
    python -m engram_lab.checks.town_accuracy disparity --laps 1 --every 40
    python -m engram_lab.checks.town_accuracy rain [--towns 1,4] [--second 0,3]

Drift is KITTI's measure: the error over stretches of 100, 200 and 300 m ÷ their length, one from
every tenth frame on; the median of each lap, and the median over laps by day and at night.

Disparity: a landmark on the edge of a thing lies, to less than a pixel, on one of two surfaces, and
the truth at the pixel's centre is the other one's as often as not. So the nearest truth among the
3×3 pixels around it counts; the share at the very pixel is told too, and how much of what misses
there stands on an edge (truths within 3×3 pixels that differ by more than a pixel of disparity). A
corner of the half-size image is known to two pixels, and its disparity is that of the surface which
fills most of its window: the share with the right truth within 9×9 pixels tells errors from edges.

Rain: landmarks of hard rain and of rain at night with a right disparity, with and without a second
look at frames that have few.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engram.cli.screen import Bars
from engram.frontend.frame import Landmarks
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.sequences.framelog.reader import FrameLog
from engram_lab.accuracy import lap_drift
from engram_lab.eyes import JUDGED, Scene, judged_scene
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.conditions import Conditions
from engram_lab.town.rendering import Places
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import campaign_folder, campaigns_folder
from engram_lab.truth import read_truth

_RAINY = ("rain", "rain again", "rain at night", "fog", "morning")


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


_WITHIN_PX, _AROUND_PX = 1.0, 2


def right_ones(marks: Landmarks, depth_m: NDArray[np.float32], camera: StereoCamera) -> int:
    """How many landmarks have a right disparity."""
    height, width = depth_m.shape
    u, v = np.rint(marks.pixels).astype(int).T
    shifts = np.arange(-_AROUND_PX, _AROUND_PX + 1)
    rows = np.clip(v + shifts[:, None, None], 0, height - 1)
    columns = np.clip(u + shifts[None, :, None], 0, width - 1)
    true_px = camera.focal_baseline / depth_m[rows, columns]
    low, high = true_px.min((0, 1)) - _WITHIN_PX, true_px.max((0, 1)) + _WITHIN_PX
    return int(((marks.disparity_px > low) & (marks.disparity_px < high)).sum())


def rain(town: int, seconds: Sequence[int]) -> Iterator[Figure]:
    """Mean numbers of landmarks, and of right ones, of each visit of a judged town."""
    scene, places = judged_scene(town, Bars()), Places(town)
    for name in _RAINY:
        row = scene.visits.index(name)
        poses = [SE3.from_matrix(pose) for pose in scene.world_from_cam[row]]
        depths_m = places.depths_m(JUDGED[name], poses)
        for second in seconds:
            config = FrontendConfig(second_threshold=second, thumbnails=False)
            found = list(_counted(scene, row, depths_m, Frontend(config)))
            every, right = np.mean(found, axis=0)
            title = f"town {town}, {name}, second look {second or 'off'}"
            yield Figure(f"{title}: landmarks", round(float(every), 1))
            yield Figure(f"{title}: right", round(float(right), 1))


def _counted(
    scene: Scene, row: int, depths_m: list[NDArray[np.float32]], frontend: Frontend
) -> Iterator[tuple[int, int]]:
    for place, depth_m in enumerate(depths_m):
        marks = frontend.extract(scene.pair(row, place)).landmarks
        yield len(marks), right_ones(marks, depth_m, scene.camera)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("drift", "disparity", "rain"))
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    parser.add_argument("--laps", type=numbers, default=[1, 4, 7], help="joined by commas")
    parser.add_argument("--every", type=int, default=20, help="frames between those looked at")
    parser.add_argument("--towns", type=numbers, default=[1, 4], help="judged towns of rain")
    parser.add_argument("--second", type=numbers, default=[0, 3], help="thresholds; 0: none")
    asked = parser.parse_args()
    village = campaign_named("village")
    if asked.what == "drift":
        drift(village, asked.campaigns)
    elif asked.what == "disparity":
        disparity(village, asked.laps, asked.every)
    else:
        report((one for town in asked.towns for one in rain(town, asked.second)), asked.json)


if __name__ == "__main__":
    main()
