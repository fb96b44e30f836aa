"""Odometry and disparity of our front-end in the simulated town, against its exact truth.

    engram lab simulate village
    python -m engram_lab.checks.town_accuracy odometry [DIR …]                # all drives, seconds
    python -m engram_lab.checks.town_accuracy disparity --laps 1,4,7          # a minute or so a lap
    python -m engram_lab.checks.town_accuracy disparity --laps 1 --every 40
    python -m engram_lab.checks.town_accuracy rain [--towns 1,4] [--second 0,3]

Odometry is run again over the frame logs below the folders (default: of `village`), by weather and
light: steps that are off, errors over 20 m of dead reckoning, and whether covariances hold them.
Drift is KITTI's measure, too: the error over stretches of 100, 200 and 300 m ÷ their length, one
from every tenth frame on; the median of each drive.

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
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from engram.cli.screen import Bars
from engram.frontend.frame import Landmarks
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import SessionId, node_id
from engram.localiser.localisation import Position
from engram.odometry.motion import GapFiller, Motion
from engram.odometry.odometry import Odometry
from engram.sequences.framelog.reader import FrameLog
from engram_lab.accuracy import LEVELS, lap_drift, squared
from engram_lab.eyes import JUDGED, Scene, judged_scene
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.rendering import Places
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import campaign_folder, campaigns_folder, met_path
from engram_lab.truth import read_truth, truth_path

_OFF_M, _RECKONED_M = 0.2, 20.0
# Lamps are on below.
_NIGHT_BELOW_DEG = -2.0
_RAINY = ("rain", "rain again", "rain at night", "fog", "morning")


@dataclass(slots=True)
class Driven:
    """What odometry made of drives in one kind of conditions.

    Attributes:
        errors_m: of each step; NaN where odometry gave none.
        steps, reckoned: χ² of steps, and of 20 m of dead reckoning, with their covariances.
        drifts: error over 20 m, as a share of it.
        laps: drift of each drive over 100 m and more.
    """

    errors_m: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    reckoned: list[float] = field(default_factory=list)
    drifts: list[float] = field(default_factory=list)
    laps: list[float] = field(default_factory=list)

    def figures(self, name: str) -> Iterator[Figure]:
        """Rows of a table."""
        errors_m = np.array(self.errors_m)
        yield Figure(f"{name}: drives", len(self.laps))
        yield Figure(
            f"  steps over {_OFF_M} m off", 100 * float((~(errors_m < _OFF_M)).mean()), "%"
        )
        yield Figure("  step, median error", 1e3 * float(np.nanmedian(errors_m)), "mm")
        yield Figure(f"  drift over {_RECKONED_M:.0f} m", 100 * float(np.median(self.drifts)), "%")
        yield Figure("  drift over 100 m and more", 100 * float(np.mean(self.laps)), "%")
        for what, values in (("steps", self.steps), ("dead reckoning", self.reckoned)):
            for level in LEVELS:
                inside = float((np.array(values) <= chi2.ppf(level, 6)).mean())
                yield Figure(f"  {what} inside {100 * level:.0f} %", 100 * inside, "%")


def odometry(folders: Sequence[Path]) -> Iterator[Figure]:
    """Runs odometry again over the rendered drives in folders, by weather and light."""
    found: dict[str, Driven] = {}
    for path in sorted(path for folder in folders for path in folder.rglob("*.framelog")):
        if truth_path(path).exists():
            _drive(path, found.setdefault(_conditions(path), Driven()))
    if not found:
        raise SystemExit("no rendered drives there; run: engram lab simulate village")
    for name, driven in sorted(found.items()):
        yield from driven.figures(name)


def _conditions(path: Path) -> str:
    """Weather and light of a rendered drive."""
    head = truth_path(path).read_text().splitlines()[0]
    sun_deg = float(met_path(path).read_text().splitlines()[1].split(",")[3])
    weather = head.split(": ")[1].split(",")[0]
    return f"{weather}, {'day' if sun_deg > _NIGHT_BELOW_DEG else 'night'}"


def _drive(path: Path, driven: Driven) -> None:
    truth = read_truth(path)
    assert truth is not None
    world_from_cam = list(truth.world_from_cam)
    log, engine, gaps = FrameLog(path), Odometry(), GapFiller()
    motions = []
    for logged in log:
        step, landmarks = engine.step(logged.frame), len(logged.frame.landmarks)
        motions.append(gaps.motion(step, logged.frame.stamp_ns, landmarks=landmarks))
    log.close()
    for motion, (before, now) in zip(motions[1:], pairwise(world_from_cam), strict=True):
        step, true = motion.odometry, before.inverse() @ now
        if step.prev_from_curr is None or step.covariance is None:
            driven.errors_m.append(float("nan"))
            continue
        driven.errors_m.append((true.inverse() @ step.prev_from_curr).distance_m)
        driven.steps.append(squared(step.prev_from_curr, step.covariance, true))
    moved = [one.prev_from_curr or SE3.identity() for one in motions[1:]]
    poses = list(itertools.accumulate(moved, lambda pose, one: pose @ one, initial=SE3.identity()))
    driven.laps.append(lap_drift(poses, world_from_cam))
    _reckon(motions, world_from_cam, driven)


def _reckon(motions: Sequence[Motion], truth: Sequence[SE3], driven: Driven) -> None:
    """Dead reckoning from every fifth frame on."""
    for first in range(0, len(motions), 5):
        at = Position.at(node_id(SessionId(UUID(int=0)), 0))
        for last in range(first + 1, len(motions)):
            one = motions[last]
            if one.prev_from_curr is None or one.covariance is None:
                break
            at = at.carried_on(one.prev_from_curr, one.covariance)
            true = truth[first].inverse() @ truth[last]
            if true.distance_m >= _RECKONED_M:
                off_m = (true.inverse() @ at.node_from_live).distance_m
                driven.drifts.append(off_m / true.distance_m)
                driven.reckoned.append(squared(at.node_from_live, at.covariance, true))
                break


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
    parser.add_argument("what", choices=("odometry", "disparity", "rain"))
    parser.add_argument("folders", nargs="*", type=Path, metavar="DIR", help="of rendered drives")
    parser.add_argument("--laps", type=numbers, default=[1, 4, 7], help="joined by commas")
    parser.add_argument("--every", type=int, default=20, help="frames between those looked at")
    parser.add_argument("--towns", type=numbers, default=[1, 4], help="judged towns of rain")
    parser.add_argument("--second", type=numbers, default=[0, 3], help="thresholds; 0: none")
    asked = parser.parse_args()
    village = campaign_named("village")
    if asked.what == "odometry":
        folders = asked.folders or [campaign_folder(campaigns_folder(), village)]
        report(odometry(folders), asked.json, "odometry")
    elif asked.what == "disparity":
        disparity(village, asked.laps, asked.every)
    else:
        report((one for town in asked.towns for one in rain(town, asked.second)), asked.json)


if __name__ == "__main__":
    main()
