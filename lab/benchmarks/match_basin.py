"""The match basin: success and inliers against distance, ahead and aside, guided and not.

Ahead: KITTI 06 at full size and at 512×384, against the official poses. Aside: the same drive of
the simulated hamlet with the camera moved half a metre aside, against exact truth.

    python benchmarks/match_basin.py --table docs/match_basin.csv --picture docs/match_basin.png
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from engram.frontend import Frame, Frontend, FrontendConfig, MatcherConfig, match_frames
from engram.geometry import SE3
from engram.sequences import open_sequence
from engram_lab.bench.data import scale_and_crop
from engram_lab.town import SimulatedDrive, campaign_named

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
                good = found is not None and match.inliers >= MIN_INLIERS
                offset = np.inf if not good else found.translation - node_from_live.translation
                errors.append(float(np.linalg.norm(offset)))
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
    pairs = list(open_sequence(folder / "sequences" / "06"))
    rows = np.loadtxt(folder / "poses" / "06.txt")
    poses = [SE3.from_matrix(row.reshape(3, 4)) for row in rows]
    truth = Truth(poses, poses, furthest=9)
    frontend = Frontend(FrontendConfig())
    lines = []
    for name, shown in (("KITTI 06, full", pairs), ("KITTI 06, 512", map(scale_and_crop, pairs))):
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
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, (success, inliers) = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    scenes = list(dict.fromkeys(line["scene"] for line in lines))
    for number, scene in enumerate(scenes):
        for guided, style in (("no", "o-"), ("yes", "s--")):
            chosen = [x for x in lines if x["scene"] == scene and x["guided"] == guided]
            distances = [x["distance_m"] for x in chosen]
            label = f"{scene}{', guided' if guided == 'yes' else ''}"
            colour = f"C{number}"
            success.plot(
                distances, [x["success_percent"] for x in chosen], style, color=colour, label=label
            )
            inliers.plot(
                distances, [x["inliers_median"] for x in chosen], style, color=colour, label=label
            )
    success.set_ylabel(f"matched within {NEAR_M} m, %")
    success.set_ylim(0, 104)
    inliers.set_ylabel("median inliers")
    inliers.set_yscale("log")
    inliers.axhline(MIN_INLIERS, color="0.6", linewidth=1)
    for axes in (success, inliers):
        axes.set_xlabel("distance between the two views, m")
        axes.grid(alpha=0.3)
    inliers.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
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
        with arguments.table.open("w", newline="") as out:
            writer = csv.DictWriter(out, fieldnames=list(lines[0]))
            writer.writeheader()
            writer.writerows(lines)
    if arguments.picture:
        draw(lines, arguments.picture)


if __name__ == "__main__":
    main()
