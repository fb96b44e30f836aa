"""Merges a campaign drive by drive, and holds goals and the map frame against the truth.

    engram lab simulate village
    python -m engram_lab.checks.frame village --out fleet.engram
    python -m engram_lab.checks.frame hamlet --out fleet.engram --goals 40

Each drive is mapped by a robot of its own and merged. As soon as the first drives are in, goals are
planted at true places beside the route: each is stored in the frame of that day. After every merge
it is measured how far each goal has moved in the map frame, whether the merge's report lists the
movement, and how far the place that the goal now names lies from where it was planted, by the truth
of its node. At the end: how true the frame is, component by component, after the best turn and
shift.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from engram.fleet.merge import merge
from engram.geometry import SE3
from engram.graph.marks import Goal
from engram.graph.placing import fit_level
from engram.maps import FramePose, Map
from engram.robot import RobotOptions, Settings, map_drive, open_drive
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.drives import EvaluatedDrive, campaign_logs, drives_of
from engram_lab.studies.starting import TrueNodes
from engram_lab.town import campaign_named
from engram_lab.town.simulating import campaigns_folder

# Goals are planted after this many merges, this far beside the route at most, metres.
_AFTER, _ASIDE_M = 2, 2.0


def plant_goals(path: Path, count: int, rng: np.random.Generator) -> dict[str, FramePose]:
    """Stores goals beside nodes drawn at random; returns where they lie in the frame."""
    with Map.open(path, writes=True) as store:
        frame, graph = store.frame, store.graph
        goals: list[Goal] = []
        for number in range(count):
            at = frame.pose(graph.node(int(rng.integers(len(graph)))).id)
            pose = FramePose.of(at)
            aside = rng.uniform(-_ASIDE_M, _ASIDE_M, 2)
            yaw_rad = pose.yaw_rad + rng.uniform(-0.5, 0.5)
            goals.append(
                frame.goal(pose.x_m + aside[0], pose.y_m + aside[1], yaw_rad, f"goal {number}")
            )
        with store.begin_revision(author="lab", message="goals", configuration={}) as writer:
            for goal in goals:
                writer.add_mark(goal)
            writer.commit()
        return {goal.name: frame.locate(goal) for goal in goals}


def moved_m(path: Path, planted: dict[str, FramePose]) -> dict[str, float]:
    """How far each goal lies from where it was planted, in the map frame."""
    with Map.open(path) as store:
        now = {name: store.frame.locate(goal) for name, goal in store.goals.items()}
    return {
        name: float(np.hypot(now[name].x_m - was.x_m, now[name].y_m - was.y_m))
        for name, was in planted.items()
    }


def truly_at(path: Path, drives: list[EvaluatedDrive]) -> dict[str, SE3]:
    """The true pose that each goal names, by the truth of its node."""
    with Map.open(path) as store:
        true = TrueNodes(store, {drive.session.id: drive.truth() for drive in drives})
        found = {}
        for name, goal in store.goals.items():
            pose = true.pose(goal.node)
            if pose is not None:
                found[name] = pose @ goal.node_from_goal
    return found


def truth_of_frame(path: Path, drives: list[EvaluatedDrive]) -> np.ndarray:
    """(N,) float64, metres: error of each node of the largest component after the best fit."""
    with Map.open(path) as store:
        true = TrueNodes(store, {drive.session.id: drive.truth() for drive in drives})
        labels = store.graph.components()
        inside = np.flatnonzero(labels == np.argmax(np.bincount(labels)))
        poses = [true.pose(store.graph.node(int(at)).id) for at in inside]
        known = [at for at, pose in zip(inside, poses, strict=True) if pose is not None]
        places = np.array([pose.translation for pose in poses if pose is not None])
        laid = store.frame.positions[known]
    return np.asarray(np.linalg.norm((fit_level(laid, places) @ laid - places)[:, :2], axis=1))


def main() -> None:
    """Reads the command line."""
    parser = command_line(__doc__)
    parser.add_argument("campaign")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="the map; must not exist yet")
    parser.add_argument("--goals", type=int, default=40)
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    asked = parser.parse_args()
    if asked.out.exists():
        raise SystemExit(f"{asked.out}: is there already; name another file")
    logs = campaign_logs(campaign_named(asked.campaign, asked.seed), asked.campaigns)
    drives = list(drives_of([log for log in logs if log.with_suffix(".truth.txt").exists()]))
    planted: dict[str, FramePose] = {}
    listed: dict[str, float] = {}
    at_first: dict[str, SE3] = {}
    for number, drive in enumerate(drives):
        with tempfile.TemporaryDirectory(prefix="engram-frame-") as folder:
            own = Path(folder) / "robot.engram"
            map_drive(own, open_drive(drive.path), Settings(), RobotOptions())
            (done,) = merge(asked.out, [own])
        if done.moved is not None:
            for name, by_m in done.moved.goals.items():
                listed[name] = listed.get(name, 0.0) + by_m
        if number + 1 == min(_AFTER, len(drives)):
            planted = plant_goals(asked.out, asked.goals, np.random.default_rng(asked.seed))
            at_first = truly_at(asked.out, drives)
        text = done.moved.text() if done.moved else ""
        print(f"{drive.name:45} {done.taken} nodes taken {text}", flush=True)
    far_m = moved_m(asked.out, planted)
    unlisted = [max(0.0, one - listed.get(name, 0.0)) for name, one in far_m.items()]
    now = truly_at(asked.out, drives)
    drift = [float(np.linalg.norm(now[name].translation - was.translation))
             for name, was in at_first.items() if name in now]  # fmt: skip
    errors_m = truth_of_frame(asked.out, drives)
    report(
        [
            Figure("drives merged", len(drives)),
            Figure("goals", len(planted)),
            Figure("goals moved in the frame, median", float(np.median(list(far_m.values()))), "m"),
            Figure("goals moved in the frame, largest not listed", max(unlisted), "m"),
            Figure("goals moved in the frame and listed", len(listed)),
            Figure("goals moved in truth, largest", max(drift, default=0.0), "m"),
            Figure("nodes of the largest component", len(errors_m)),
            Figure("error of the frame, median", float(np.median(errors_m)), "m"),
            Figure("error of the frame, 90 %", float(np.percentile(errors_m, 90)), "m"),
        ],
        asked.json,
        "frame",
    )


if __name__ == "__main__":
    main()
