"""What settings of odometry's window do to its accuracy.

    python -m engram_lab.checks.window_settings $LOGS/*-clear-*.framelog --iterations 0,2,5
    python -m engram_lab.checks.window_settings --iterations 0,2,5 --view-deg 38

With frame logs of the simulated town: drift of each (`town_accuracy`) and how much too long or
short its motions are. Without: KITTI 06 under ENGRAM_DATA, full size and 512×384; `--view-deg`
leaves only the landmarks within that view to the full-size frames.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from engram.frontend.frame import Frame, Landmarks
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.geometry.se3 import SE3
from engram.odometry.odometry import Odometry, OdometryConfig, WindowConfig
from engram.sequences.framelog.reader import FrameLog
from engram_lab.bench.data import load_bench_data
from engram_lab.checks.accuracy import KITTI_06_TRUTH, kitti_truth, segment_errors
from engram_lab.checks.town_accuracy import lap_drift
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.truth import read_truth


def poses_by(frames: Sequence[Frame], window: WindowConfig) -> list[SE3]:
    """The camera's poses by odometry, in that of the first frame."""
    odometry, pose, poses = Odometry(OdometryConfig(window=window)), SE3.identity(), []
    for frame in frames:
        step = odometry.step(frame).prev_from_curr
        pose = pose if step is None else pose @ step
        poses.append(pose)
    return poses


def length_m(poses: Sequence[SE3]) -> float:
    return sum((a.inverse() @ b).distance_m for a, b in itertools.pairwise(poses))


def of_log(path: Path, window: WindowConfig, name: str) -> Iterator[Figure]:
    """Drift and excess length of a simulated lap."""
    known = read_truth(path)
    if known is None:
        raise SystemExit(f"{path}: has no truth next to it; give logs of engram lab simulate")
    log = FrameLog(path)
    poses, truth = poses_by([one.frame for one in log], window), list(known.world_from_cam)
    log.close()
    yield Figure(f"{name}: drift", 100 * lap_drift(poses, truth), "%")
    yield Figure(f"{name}: longer by", 100 * (length_m(poses) / length_m(truth) - 1), "%")


def of_kitti(view_deg: float, window: WindowConfig, name: str) -> Iterator[Figure]:
    """Errors over 10–50 m and excess length of the clip."""
    data, frontend = load_bench_data(), Frontend(FrontendConfig(thumbnails=False))
    truth = kitti_truth(Path(os.environ["ENGRAM_DATA"]) / KITTI_06_TRUTH)
    for size in ("full", "512"):
        frames = [frontend.extract(pair) for pair in data.at(size)]
        if size == "full":
            frames = [within(frame, view_deg) for frame in frames]
        poses = poses_by(frames, window)
        yield Figure(f"{name}, {size}: error", 100 * segment_errors(poses, truth)[0], "%")
        excess = length_m(poses) / length_m(truth) - 1
        yield Figure(f"{name}, {size}: longer by", 100 * excess, "%")


def within(frame: Frame, view_deg: float) -> Frame:
    """The frame with the landmarks of the middle of its view only."""
    marks, camera = frame.landmarks, frame.camera
    half_px = camera.fx * np.tan(np.deg2rad(view_deg / 2))
    kept = np.abs(marks.pixels[:, 0] - camera.cx) <= half_px
    columns = (getattr(marks, one.name)[kept] for one in dataclasses.fields(Landmarks))
    return dataclasses.replace(frame, landmarks=Landmarks(*columns))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--iterations", type=numbers, default=[5])
    parser.add_argument("--offset-sigma-px", type=float, default=WindowConfig().offset_sigma_px)
    parser.add_argument("--view-deg", type=float, default=179.0)
    given = parser.parse_args()
    for iterations in given.iterations:
        window = WindowConfig(iterations=iterations, offset_sigma_px=given.offset_sigma_px)
        title = f"{iterations} iterations"
        if not given.logs:
            report(of_kitti(given.view_deg, window, "KITTI 06"), given.json, title)
        for log in given.logs:
            report(of_log(log, window, log.stem), given.json, f"{title}, {log.parent.name}")


if __name__ == "__main__":
    main()
