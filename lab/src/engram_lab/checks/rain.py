"""Landmarks whose disparity is right in hard rain, with and without the front-end's second look.

    python -m engram_lab.checks.rain [--towns 1,4] [--second 0,3]

A disparity counts as right within 1 px of what the rendered town shows within 2 px of the corner.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from engram.cli.screen import Bars
from engram.frontend.frame import Landmarks
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram_lab.eyes import JUDGED, Scene, judged_scene
from engram_lab.programs import Figure, command_line, report
from engram_lab.town.rendering import Places

VISITS = ("rain", "rain again", "rain at night", "fog", "morning")
_WITHIN_PX, _AROUND_PX = 1.0, 2


def right_ones(marks: Landmarks, depth_m: NDArray[np.float32], camera: StereoCamera) -> int:
    """How many landmarks have a right disparity.

    Args:
        marks: of the left image.
        depth_m: (h, w) of the left image, true.
        camera: of both.
    """
    height, width = depth_m.shape
    u, v = np.rint(marks.pixels).astype(int).T
    shifts = np.arange(-_AROUND_PX, _AROUND_PX + 1)
    rows = np.clip(v + shifts[:, None, None], 0, height - 1)
    columns = np.clip(u + shifts[None, :, None], 0, width - 1)
    true_px = camera.focal_baseline / depth_m[rows, columns]
    low, high = true_px.min((0, 1)) - _WITHIN_PX, true_px.max((0, 1)) + _WITHIN_PX
    return int(((marks.disparity_px > low) & (marks.disparity_px < high)).sum())


def figures(town: int, seconds: list[int]) -> Iterator[Figure]:
    """Mean numbers of landmarks, and of right ones, of each visit of a judged town."""
    scene, places = judged_scene(town, Bars()), Places(town)
    for name in VISITS:
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
    parser.add_argument("--towns", default="1,4", help="judged towns, joined by commas")
    parser.add_argument("--second", default="0,3", help="thresholds of the second look; 0: none")
    asked = parser.parse_args()
    seconds = [int(each) for each in asked.second.split(",")]
    report(
        (one for town in asked.towns.split(",") for one in figures(int(town), seconds)), asked.json
    )


if __name__ == "__main__":
    main()
