"""Merges a campaign drive by drive, and holds goals and the map frame against the truth.

    engram lab simulate village
    python -m engram_lab.checks.goals village --out fleet.engram
    python -m engram_lab.checks.goals trial-401 --out fleet.engram --drives 50

Each drive is mapped by a robot of its own and merged. As soon as the first drives are in, goals are
planted at true places beside the route: each is stored in the frame of that day. After every merge
it is measured how far each goal has moved in the map frame, whether the merge's report lists the
movement, and how far the place that the goal now names lies from where it was planted, by the truth
of its node. At the end: how true the frame is, component by component, after the best turn and
shift.

With more `--drives` than the campaign has, its drives come again, each round with other frames of
them: round r takes every r-th. An interrupted run continues where it was.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np

from engram.fleet.merge.merging import merge
from engram.geometry.se3 import SE3
from engram.graph.model import Goal, SessionId
from engram.graph.placing import fit_level
from engram.maps.map import Map
from engram.maps.map_frame import FramePose
from engram.monitor import write_whole
from engram.robot.localisers import session_of_drive
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.opening import open_drive
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.drives import EvaluatedDrive, TrueNodes, Truth, campaign_logs, drives_of
from engram_lab.town.campaigns import Campaign, campaign_named
from engram_lab.town.simulating import campaigns_folder
from engram_lab.trial_towns import longer_trial_town

# Goals are planted after this many merges, this far beside the route at most, metres.
_AFTER, _ASIDE_M = 2, 2.0
# What goals may move, metres: in the median, and the largest movement that no report lists.
_MEDIAN_M, _UNLISTED_M = 0.05, 0.20

Truths: TypeAlias = dict[SessionId, Truth | None]


@dataclass(slots=True)
class Progress:
    """What is done; kept next to the map.

    Attributes:
        merged: drives merged.
        planted: x, y in metres and yaw in radians of each goal in the frame of its day.
        true: (16,) true pose that each goal named then.
        listed: metres that each goal moved by the reports.
    """

    merged: int = 0
    planted: dict[str, list[float]] = field(default_factory=dict)
    true: dict[str, list[float]] = field(default_factory=dict)
    listed: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Round:
    """A drive in one of its rounds.

    Attributes:
        drive: the drive.
        frames: which of its frames come.
    """

    drive: EvaluatedDrive
    frames: str

    def open(self) -> FrameLog:
        """The drive, with the frames of its round."""
        opened = open_drive(self.drive.path, frames=self.frames)
        assert isinstance(opened, FrameLog)
        return opened


def rounds(drives: tuple[EvaluatedDrive, ...], count: int) -> Iterator[Round]:
    """So many drives: all of them, then all again with every second frame, and so on."""
    for number in range(count):
        again, at = divmod(number, len(drives))
        yield Round(drives[at], f"{again}::{again + 1}")


def truths_of(driven: list[Round]) -> Truths:
    """The truth of each session."""
    found: Truths = {}
    for one in driven:
        log = one.open()
        found[session_of_drive(log).id] = one.drive.truth()
        log.close()
    return found


def plant_goals(path: Path, count: int, rng: np.random.Generator) -> dict[str, FramePose]:
    """Stores goals near nodes drawn at random; returns where they lie in the frame."""
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


def moved_m(path: Path, planted: dict[str, list[float]]) -> dict[str, float]:
    """How far each goal lies from where it was planted, in the map frame."""
    with Map.open(path) as store:
        now = {name: store.frame.locate(goal) for name, goal in store.goals.items()}
    return {
        name: float(np.hypot(now[name].x_m - was[0], now[name].y_m - was[1]))
        for name, was in planted.items()
    }


def truly_at(path: Path, truths: Truths) -> dict[str, SE3]:
    """The true pose that each goal names, by the truth of its node."""
    with Map.open(path) as store:
        true = TrueNodes(store, truths)
        found = {}
        for name, goal in store.goals.items():
            pose = true.pose(goal.node)
            if pose is not None:
                found[name] = pose @ goal.node_from_goal
    return found


def truth_of_frame(path: Path, truths: Truths) -> np.ndarray:
    """(N,) float64, metres: error of each node of the largest component after the best fit."""
    with Map.open(path) as store:
        true = TrueNodes(store, truths)
        labels = store.graph.components()
        inside = np.flatnonzero(labels == np.argmax(np.bincount(labels)))
        poses = [true.pose(store.graph.node(int(at)).id) for at in inside]
        known = [at for at, pose in zip(inside, poses, strict=True) if pose is not None]
        places = np.array([pose.translation for pose in poses if pose is not None])
        laid = store.frame.positions[known]
    return np.asarray(np.linalg.norm((fit_level(laid, places) @ laid - places)[:, :2], axis=1))


def campaign_of(name: str, seed: int) -> Campaign:
    """A campaign by its name; `trial-401` is the longer trial town of that seed."""
    kind, _, number = name.partition("-")
    return longer_trial_town(int(number)) if kind == "trial" else campaign_named(name, seed)


def merge_next(out: Path, one: Round, progress: Progress) -> str:
    """Maps a drive by a robot of its own and merges it; returns a line for people."""
    with tempfile.TemporaryDirectory(prefix="engram-goals-") as folder:
        own = Path(folder) / "robot.engram"
        map_drive(own, one.open(), Settings(), RobotOptions())
        (done,) = merge(out, [own])
    if done.moved is not None:
        for name, by_m in done.moved.goals.items():
            progress.listed[name] = progress.listed.get(name, 0.0) + by_m
    progress.merged += 1
    text = done.moved.text() if done.moved else ""
    return f"{progress.merged:3} {one.drive.name:45} {done.taken} nodes taken {text}"


def run(out: Path, driven: list[Round], goals: int, seed: int) -> Progress:
    """Merges what is not merged yet, and plants the goals in between."""
    kept = out.with_suffix(".json")
    progress = Progress(**json.loads(kept.read_text())) if kept.exists() else Progress()
    for one in driven[progress.merged :]:
        print(merge_next(out, one, progress), flush=True)
        if progress.merged == min(_AFTER, len(driven)):
            planted = plant_goals(out, goals, np.random.default_rng(seed))
            progress.planted = {
                name: [pose.x_m, pose.y_m, pose.yaw_rad] for name, pose in planted.items()
            }
            true = truly_at(out, truths_of(driven[: progress.merged]))
            progress.true = {name: pose.matrix().ravel().tolist() for name, pose in true.items()}
        with write_whole(kept) as draft:
            draft.write_text(json.dumps(asdict(progress)))
    return progress


def main() -> int:
    """Reads the command line."""
    parser = command_line(__doc__)
    parser.add_argument("campaign")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="the map; continued if it exists")
    parser.add_argument("--goals", type=int, default=40)
    parser.add_argument("--drives", type=int, help="as many as the campaign has, if not given")
    parser.add_argument("--campaigns", type=Path, default=campaigns_folder())
    asked = parser.parse_args()
    logs = campaign_logs(campaign_of(asked.campaign, asked.seed), asked.campaigns)
    drives = drives_of([log for log in logs if log.with_suffix(".truth.txt").exists()])
    driven = list(rounds(drives, asked.drives or len(drives)))
    progress = run(asked.out, driven, asked.goals, asked.seed)
    far_m = moved_m(asked.out, progress.planted)
    unlisted_m = [max(0.0, one - progress.listed.get(name, 0.0)) for name, one in far_m.items()]
    truths = truths_of(driven)
    now = truly_at(asked.out, truths)
    drift_m = [
        float(np.linalg.norm(now[name].translation - np.reshape(was, (4, 4))[:3, 3]))
        for name, was in progress.true.items()
        if name in now
    ]
    median_m = float(np.median(list(far_m.values())))
    errors_m = truth_of_frame(asked.out, truths)
    report(
        [
            Figure("drives merged", progress.merged),
            Figure("of these first rounds", min(len(drives), progress.merged)),
            Figure("goals", len(progress.planted)),
            Figure("goals moved in the frame, median", median_m, "m"),
            Figure("goals moved in the frame, largest", max(far_m.values()), "m"),
            Figure("goals moved in the frame, largest not listed", max(unlisted_m), "m"),
            Figure("goals moved in the frame and listed", len(progress.listed)),
            Figure("goals moved in truth, largest", max(drift_m, default=0.0), "m"),
            Figure("nodes of the largest component", len(errors_m)),
            Figure("error of the frame, median", float(np.median(errors_m)), "m"),
            Figure("error of the frame, 90 %", float(np.percentile(errors_m, 90)), "m"),
        ],
        asked.json,
        "goals",
    )
    return int(median_m > _MEDIAN_M or max(unlisted_m) > _UNLISTED_M)


if __name__ == "__main__":
    sys.exit(main())
