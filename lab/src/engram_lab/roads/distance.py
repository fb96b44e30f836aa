"""How inliers fall off with the distance between two views, in the town and on KITTI 06.

    python -m engram_lab.roads.distance     # needs the clip under $ENGRAM_DATA

OpenCV's SIFT: each second frame of the clip as a map for the frame some frames further on. The town
is seen by KITTI's camera, where its road runs straight between houses, as on the clip.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from engram.errors import ConfigError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.sequences.opening import open_drive
from engram_lab.programs import Figure, command_line, report
from engram_lab.roads.matching import SIFT, map_frame, placed
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

# KITTI 06 from frame 0 to 50, and the mean way between two frames.
CLIP_FRAMES = 51
CLIP_SPACING_M = 1.197
_STEPS = (1, 2, 4, 6)
_RIGHT_M = 0.25
# Of `village`: a clear morning.
_SESSION, _FIRST_FRAME = 1, 60

Clip = Sequence[tuple[SE3, StereoPair]]


def load_clip() -> Clip:
    """KITTI 06, frames 0 to 50, with true poses.

    Raises:
        ConfigError: ``$ENGRAM_DATA`` does not have it.
    """
    root = os.environ.get("ENGRAM_DATA")
    odometry = Path(root or "") / "kitti_odometry"
    clip, truth = odometry / "sequences" / "06", odometry / "poses" / "06.txt"
    if not root or not clip.is_dir() or not truth.is_file():
        raise ConfigError(f"ENGRAM_DATA is {root!r}: must name a folder with {clip} and {truth}")
    poses = [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(truth)]
    pairs = [pair for pair in open_drive(clip) if isinstance(pair, StereoPair)]
    return list(zip(poses, pairs, strict=False))[:CLIP_FRAMES]


def town_like_clip() -> Clip:
    """As many frames of the town by KITTI's camera, at the clip's spacing."""
    village = campaign_named("village")
    plan = replace(village.session(_SESSION), robot="kitti")
    sessions = (*village.sessions[:_SESSION], plan, *village.sessions[_SESSION + 1 :])
    drive = SimulatedDrive(replace(village, sessions=sessions, spacing_m=CLIP_SPACING_M), _SESSION)
    last = _FIRST_FRAME + CLIP_FRAMES
    poses = drive.world_from_cams()[_FIRST_FRAME:last]
    return list(zip(poses, drive.frames(_FIRST_FRAME, last), strict=True))


def falloff(clip: Clip, every: int = 2) -> dict[int, float]:
    """Mean right inliers between a frame and the one so many frames further on."""
    frames = [map_frame(SIFT, pose, pair) for pose, pair in clip]
    found = {}
    for step in _STEPS:
        counts = []
        for first in range(0, len(clip) - step, every):
            pose, pair = clip[first + step]
            answer = placed(SIFT, pair.left, [frames[first]], pair.camera, pose)
            counts.append(answer.inliers if answer.off_m < _RIGHT_M else 0)
        found[step] = float(np.mean(counts))
    return found


def figures() -> Iterator[Figure]:
    """Inliers in the town ÷ those on the clip, by the distance ahead."""
    road, town = falloff(load_clip()), falloff(town_like_clip())
    for step in _STEPS:
        name = f"{step * CLIP_SPACING_M:.1f} m ahead"
        yield Figure(f"{name}: inliers on the clip", road[step])
        yield Figure(f"{name}: inliers in the town / on the clip", town[step] / road[step])


def main() -> None:
    """Command line."""
    report(figures(), command_line(__doc__).parse_args().json)


if __name__ == "__main__":
    main()
