"""The match basin: success and inliers against distance, ahead and aside, guided and not.

Ahead: KITTI 06 at full size and at 512×384, against the official poses. Aside: the same drive of
the simulated hamlet with the camera moved half a metre aside, against exact truth.

    python -m engram_lab.fits.basin --table match_basin.csv --picture match_basin.png
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from engram.frontend.frame import Frame, StereoPair
from engram.frontend.frontend import Frontend, FrontendConfig
from engram.frontend.matching import MatcherConfig, match_frames
from engram.geometry.se3 import SE3
from engram.sequences.opening import open_drive
from engram_lab.bench.data import scale_and_crop
from engram_lab.charts import Line as Curve
from engram_lab.charts import Panel, draw_curves
from engram_lab.programs import command_line
from engram_lab.studies.plan import write_csv
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

MIN_INLIERS = 20
NEAR_M = 0.25
# The prediction of a guided attempt is off by this much, one standard deviation.
PREDICTION_SIGMA = np.array([0.3, 0.05, 0.3, np.deg2rad(0.3), np.deg2rad(1.0), np.deg2rad(0.3)])
Line = dict[str, str | float]


def basin(name: str, nodes: Sequence[Frame], lives: Sequence[Frame], truth: Truth) -> list[Line]:
    """One line for each distance in frames, unguided and guided."""
    lines: list[Line] = []
    rng = np.random.default_rng(0)
    for guided in (False, True):
        for apart in range(truth.furthest + 1):
            errors, inliers = [], []
            for k in range(len(nodes) - apart):
                node_from_live = truth.node_from_live(k, k + apart)
                guess = SE3.exp(rng.normal(0, PREDICTION_SIGMA)) @ node_from_live
                match = match_frames(
                    nodes[k],
                    lives[k + apart],
                    MatcherConfig(),
                    seed=k,
                    predicted=guess if guided else None,
                    predicted_covariance=np.diag(PREDICTION_SIGMA**2) if guided else None,
                )
                inliers.append(match.inliers)
                found = match.reference_from_live
                if found is None or match.inliers < MIN_INLIERS:
                    errors.append(np.inf)
                else:
                    offset_m = found.translation - node_from_live.translation
                    errors.append(float(np.linalg.norm(offset_m)))
            within = np.array(errors) < NEAR_M
            lines.append(
                {
                    "scene": name,
                    "guided": "yes" if guided else "no",
                    "distance_m": round(truth.distance_m(apart), 2),
                    "pairs": len(errors),
                    "success_percent": round(100 * float(within.mean()), 1),
                    "inliers_median": float(np.median(inliers)),
                }
            )
    return lines


@dataclasses.dataclass(frozen=True)
class Truth:
    """Poses of nodes and of live cameras, by frame."""

    world_from_node: Sequence[SE3]
    world_from_live: Sequence[SE3]
    furthest: int

    def node_from_live(self, node: int, live: int) -> SE3:
        """True pose of a live frame's camera in a node."""
        return self.world_from_node[node].inverse() @ self.world_from_live[live]

    def distance_m(self, apart: int) -> float:
        """Median distance of frames that are so many frames apart."""
        pairs = range(len(self.world_from_node) - apart)
        return float(np.median([self.node_from_live(k, k + apart).distance_m for k in pairs]))


def kitti_lines(data: Path) -> list[Line]:
    folder = data / "kitti_odometry"
    read = open_drive(folder / "sequences" / "06")
    pairs = [pair for pair in read if isinstance(pair, StereoPair)]
    rows = np.loadtxt(folder / "poses" / "06.txt")
    poses = [SE3.from_matrix(row.reshape(3, 4)) for row in rows]
    truth = Truth(poses, poses, furthest=9)
    frontend = Frontend(FrontendConfig())
    lines = []
    for name, shown in (
        ("KITTI 06, full", pairs),
        ("KITTI 06, 512", [scale_and_crop(pair) for pair in pairs]),
    ):
        frames = [frontend.extract(pair) for pair in shown]
        lines += basin(name, frames, frames, truth)
    return lines


def aside_lines(aside_m: float = 0.5, count: int = 60) -> list[Line]:
    frontend = Frontend(FrontendConfig())
    views: list[tuple[list[Frame], list[SE3]]] = []
    for offset_m in (0.0, aside_m):
        drive = SimulatedDrive(campaign_named("hamlet"), 2, threads=2)
        aside = SE3(np.eye(3), np.array([offset_m, 0.0, 0.0]))
        drive.poses = [
            dataclasses.replace(pose, world_from_cam=pose.world_from_cam @ aside)
            for pose in drive.poses
        ]
        frames = [frontend.extract(pair) for pair in drive.frames(0, count)]
        views.append((frames, drive.world_from_cams()[:count]))
    (nodes, at_nodes), (lives, at_lives) = views
    truth = Truth(at_nodes, at_lives, furthest=8)
    return basin(f"hamlet, {aside_m} m aside", nodes, lives, truth)


def draw(lines: list[Line], path: Path) -> None:
    panels = []
    for measure, label in (
        ("success_percent", f"matched within {NEAR_M} m, %"),
        ("inliers_median", "median inliers"),
    ):
        curves = []
        for scene, guided in dict.fromkeys((one["scene"], one["guided"]) for one in lines):
            some = [one for one in lines if (one["scene"], one["guided"]) == (scene, guided)]
            x, y = (
                np.array([one[name] for one in some], float) for name in ("distance_m", measure)
            )
            curves.append(Curve(f"{scene}{', guided' if guided == 'yes' else ''}", x, y))
        panels.append(Panel("", "distance between the two views, m", label, curves))
    draw_curves(panels, path, "the match basin")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--table", type=Path)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    lines = aside_lines()
    if os.environ.get("ENGRAM_DATA"):
        lines = kitti_lines(Path(os.environ["ENGRAM_DATA"])) + lines
    else:
        print("ENGRAM_DATA names no folder of real images: simulated views only")
    for line in lines:
        print("  ".join(f"{value}" for value in line.values()))
    if arguments.table:
        write_csv(arguments.table, lines)
    if arguments.picture:
        draw(lines, arguments.picture)


if __name__ == "__main__":
    main()
