"""Stages of the renderer, and of the window on a problem with a known solution."""

from __future__ import annotations

from typing import Any

import numpy as np

from engram import _core
from engram.geometry.se3 import SE3
from engram_lab.bench.data import BenchData
from engram_lab.bench.stage import PlainPipeline, Prepared
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

CLEAR, RAIN, NIGHT = 1, 6, 7  # sessions of `village`: a morning, wet streets, lamps
_FIRST_FRAME, _SHOWN = 200, 60


def prepare_rendering(
    data: BenchData, plain: PlainPipeline | None, *, session: int = CLEAR
) -> Prepared:
    """The pairs follow each other as in a drive; the tiles around them are built beforehand."""
    del data, plain
    drive = SimulatedDrive(campaign_named("village"), session)
    for _ in drive.frames(_FIRST_FRAME, _FIRST_FRAME + _SHOWN):
        pass
    frames = drive.frames(_FIRST_FRAME, _FIRST_FRAME + _SHOWN)

    def ours(_: int) -> dict[str, int]:
        nonlocal frames
        pair = next(frames, None)
        if pair is None:  # round again
            frames = drive.frames(_FIRST_FRAME, _FIRST_FRAME + _SHOWN)
            pair = next(frames)
        return {"pixels": 2 * pair.left.size}

    return Prepared(ours)


_FRAMES, _LANDMARKS = 7, 528
_PIXEL_SIGMA_PX, _DISPARITY_SIGMA_PX = 0.5, 0.1


def prepare_window(data: BenchData, plain: PlainPipeline | None) -> Prepared:
    """Seven frames 0.8 m apart that share 528 landmarks: the prototype's size of problem.

    Points and noise are drawn with a fixed seed; the poses start 2 cm and 0.3° off. Both sides
    get the same observations and the same start.
    """
    camera = data.small[0].camera
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m)
    rng = np.random.default_rng(7)
    poses = [SE3(np.eye(3), np.array([0.0, 0.0, 0.8 * k])) for k in range(_FRAMES)]
    depth_m = rng.uniform(8, 40, _LANDMARKS)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (_LANDMARKS, 2)) * depth_m[:, None], depth_m])
    frame, track, stereo = [], [], []
    for k, pose in enumerate(poses):
        seen = pose.inverse() @ points
        u = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
        v = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
        inside = (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height) & (seen[:, 2] > 2)
        rows = np.flatnonzero(inside)
        frame.append(np.full(len(rows), k, np.int32))
        track.append(rows.astype(np.int32))
        noise = rng.standard_normal((len(rows), 3))
        noise *= (_PIXEL_SIGMA_PX, _PIXEL_SIGMA_PX, _DISPARITY_SIGMA_PX)
        exact = np.column_stack([u, v, camera.focal_baseline / seen[:, 2]])[rows]
        stereo.append((exact + noise).astype(np.float32))
    frames, tracks, seen_at = np.concatenate(frame), np.concatenate(track), np.concatenate(stereo)
    start = np.array(
        [
            (pose @ SE3.exp(rng.normal(0, [0.02] * 3 + [0.005] * 3) * (k > 0))).matrix()
            for k, pose in enumerate(poses)
        ]
    )
    tracks = _numbered(tracks)
    pixel_sigma = np.full(len(frames), _PIXEL_SIGMA_PX, np.float32)
    disparity_sigma = np.full(len(frames), _DISPARITY_SIGMA_PX, np.float32)

    def ours(_: int) -> dict[str, int]:
        adjusted = _core.adjust_window(
            intrinsics,
            start,
            frames,
            tracks,
            seen_at,
            pixel_sigma,
            disparity_sigma,
            fixed=1,
            iterations=5,
            chi2=11.34,
            offset_px=0.0,
            offset_sigma_px=0.1,
        )
        assert adjusted is not None
        return {"frames": _FRAMES, "landmarks": int(tracks.max()) + 1, "observations": len(frames)}

    if plain is None:
        return Prepared(ours)
    return Prepared(ours, _plain_run(plain, data, start, frames, tracks, seen_at))


def _plain_run(
    plain: PlainPipeline,
    data: BenchData,
    start: np.ndarray,
    frames: np.ndarray,
    tracks: np.ndarray,
    stereo: np.ndarray,
) -> Any:
    small = data.small[0].camera
    camera = plain.Camera(
        small.fx, small.fy, small.cx, small.cy, small.baseline_m, small.width, small.height
    )
    observed = stereo.astype(np.float64)
    observed[:, 2] = observed[:, 0] - observed[:, 2]  # disparity → right u
    first = np.unique(tracks, return_index=True)[1]
    local = camera.triangulate(observed[first])
    world_from_cam = start[frames[first]]
    points = np.einsum("nij,nj->ni", world_from_cam[:, :3, :3], local) + world_from_cam[:, :3, 3]
    cam_from_world = np.linalg.inv(start)

    def reference(_: int) -> dict[str, int]:
        plain.adjust_window(cam_from_world, points, frames, tracks, observed, camera)
        return {"frames": _FRAMES, "landmarks": len(points), "observations": len(observed)}

    return reference


def _numbered(tracks: np.ndarray) -> np.ndarray:
    """Tracks numbered 0, 1, 2, … without gaps."""
    return np.unique(tracks, return_inverse=True)[1].astype(np.int32)
