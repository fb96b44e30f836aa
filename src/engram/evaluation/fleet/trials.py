"""Downloads for the hour of each held-out drive, tried out on it ([G16] Fig. 9, SPEC §7)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from engram.drive import OpenMap
from engram.errors import InputError
from engram.evaluation.building import true_nodes, write_json
from engram.evaluation.drives import EvaluatedDrive
from engram.evaluation.fleet.arms import Arm
from engram.evaluation.fleet.plan import FleetPlan
from engram.evaluation.fleet.records import read_json
from engram.evaluation.fleet.steps import map_path
from engram.evaluation.folds import Fold
from engram.experience.clock import hour_of_day
from engram.experience.model import SessionId
from engram.fleet import DownloadOptions, Trial, silent, try_downloads
from engram.localiser import Position
from engram.measures import Drive
from engram.sequences import FrameLog

COPY = "copy"
TOD = "tod"
TOD_PATHS = "tod+paths"
QUARTER = "budget 1/4"
TENTH = "budget 1/10"
AS_TOD = "budget as tod"
AS_TOD_PATHS = "budget as tod+paths"
_BY_HOUR = (TOD, TOD_PATHS)


@dataclass(frozen=True, slots=True, eq=False)
class TriedDownload:
    """One held-out drive in one download.

    Attributes:
        name: of the kind of download.
        nodes, of_nodes: sent, and of the centre.
        united: sent, together with the robot's own; mean over the robots.
        size_bytes: of the file.
        expected_missed: share of the way without a match, as promised.
        drive: steps and matches.
        ms: mean time of localising a frame.
        lookup_ms: of that, asking the relocaliser.
        lookups: frames for which it was asked.
    """

    name: str
    nodes: int
    of_nodes: int
    united: float
    size_bytes: int
    expected_missed: float
    drive: Drive
    ms: float
    lookup_ms: float
    lookups: int


def trials_path(plan: FleetPlan, arm: Arm, fold: Fold, drive: EvaluatedDrive) -> Path:
    """Where the trials of one held-out drive are kept."""
    return plan.folder(arm, fold) / f"downloads-{drive.name}.json"


def try_downloads_for(
    plan: FleetPlan, arm: Arm, fold: Fold, name: str, drive: EvaluatedDrive
) -> None:
    """All kinds of download of one map for one held-out drive."""
    path = trials_path(plan, arm, fold, drive)
    if path.exists():
        return
    centre = map_path(plan, arm, fold, name)
    trials = partial(
        try_downloads,
        centre,
        drives=[lambda: FrameLog(drive.path)],
        settings=plan.settings,
        localise=arm.localising(plan.options.relocaliser),
        progress=silent,
        start=partial(_start, plan, fold, drive),
    )
    first = [COPY]
    if hour_of_day(drive.session, drive.session.start_ns) is not None:
        first += _BY_HOUR
    found = trials({one: DownloadOptions(one) for one in first})
    sizes = {one.name: one.report.size_bytes for one in found}
    budgets = {QUARTER: sizes[COPY] // 4, TENTH: sizes[COPY] // 10}
    budgets |= {
        asked: sizes[like]
        for asked, like in ((AS_TOD, TOD), (AS_TOD_PATHS, TOD_PATHS))
        if like in sizes
    }
    refused = {}
    for one, room in budgets.items():
        try:
            found += trials({one: DownloadOptions("budget", budget_bytes=room)})
        except InputError as error:  # a map so small that a part of it has no room for a node
            refused[one] = str(error)
    own = [
        {one.session.id for foray in forays for one in foray}
        for forays in plan.forays(fold).values()
    ]
    whole = found[0].nodes_of
    tried = [
        _plain(one, float(np.mean([_united(one, whole, mine) for mine in own]))) for one in found
    ]
    write_json(path, {"refused": refused, "tried": tried})


def read_trials(
    plan: FleetPlan, arm: Arm, fold: Fold, drive: EvaluatedDrive
) -> list[TriedDownload]:
    """The trials of one held-out drive; empty if they are still to be made."""
    path = trials_path(plan, arm, fold, drive)
    if not path.exists():
        return []
    return [
        TriedDownload(
            **{
                **one,
                "drive": Drive(np.array(one["drive"][0]), np.array(one["drive"][1], np.bool_)),
            }
        )
        for one in read_json(path)["tried"]
    ]


def _start(plan: FleetPlan, fold: Fold, drive: EvaluatedDrive, opened: OpenMap) -> Position | None:
    """Where the drive begins, by truth; None where that is not known: it is lost."""
    truth = drive.truth()
    log = FrameLog(drive.path)
    first = None if truth is None else truth.at(int(log.stamps_ns[0]))
    log.close()
    return None if first is None else true_nodes(opened, plan.training(fold)).start(first)


def _united(trial: Trial, whole: Mapping[SessionId, int], own: Collection[SessionId]) -> int:
    """Nodes on a robot that keeps all it saved itself beside what was sent."""
    mine = sum(count for session, count in whole.items() if session in own)
    return mine + sum(count for session, count in trial.nodes_of.items() if session not in own)


def _plain(trial: Trial, united: float) -> dict[str, Any]:
    return {
        "name": trial.name,
        "nodes": trial.report.nodes,
        "of_nodes": trial.report.of_nodes,
        "united": united,
        "size_bytes": trial.report.size_bytes,
        "expected_missed": trial.report.expected_missed,
        "drive": [trial.steps.step_m.tolist(), trial.steps.matched.tolist()],
        "ms": trial.ms_per_frame,
        "lookup_ms": trial.lookup_ms_per_frame,
        "lookups": trial.lookups,
    }
