"""Downloads for the hour of each held-out drive, tried out on it ([G16] Fig. 9, method §7).

All are without thumbnails, so that equal bytes are equal: `budget` sends none unless it is told to,
the others do, and thumbnails are a tenth of a map.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import InputError
from engram.graph.clock import hour_of_day
from engram.graph.model import Node, SessionId
from engram.localiser import Position
from engram.maps import Map
from engram.measures import Drive
from engram.sequences import FrameLog
from engram_lab.studies.building import true_nodes, write_json
from engram_lab.studies.drives import EvaluatedDrive
from engram_lab.studies.fleet.arms import Arm
from engram_lab.studies.fleet.plan import FleetPlan
from engram_lab.studies.fleet.records import read_json
from engram_lab.studies.fleet.steps import map_path
from engram_lab.studies.folds import Fold
from engram_lab.studies.in_force import Values, of_revision
from engram_lab.trial import Trial, try_downloads

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
        in_force: the settings that it was chosen by.
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
    in_force: Values = field(default_factory=dict)


def trials_path(plan: FleetPlan, arm: Arm, fold: Fold, drive: EvaluatedDrive) -> Path:
    """Where the trials of one held-out drive are kept."""
    return plan.folder(arm, fold) / f"downloads-{drive.key}.json"


def try_downloads_for(
    plan: FleetPlan, arm: Arm, fold: Fold, name: str, drive: EvaluatedDrive
) -> None:
    """All kinds of download of one map for one held-out drive."""
    path = trials_path(plan, arm, fold, drive)
    if _kept(path) is not None:
        return
    centre = map_path(plan, arm, fold, name)
    trials = partial(
        try_downloads,
        centre,
        drives=[lambda: FrameLog(drive.path)],
        settings=plan.settings,
        localise=arm.driving,
        start=partial(_start, plan, fold, drive),
    )
    wanted = partial(plan.tables.download.options, thumbnails=False)
    found, refused = trials({COPY: wanted(COPY)}), {}
    if hour_of_day(drive.session, drive.session.start_ns) is not None:
        for one in _BY_HOUR:
            try:
                found += trials({one: wanted(one)})
            except InputError as error:  # nothing was driven at such an hour
                refused[one] = str(error)
    sizes = {one.name: one.report.size_bytes for one in found}
    budgets = {QUARTER: sizes[COPY] // 4, TENTH: sizes[COPY] // 10}
    budgets |= {
        asked: sizes[like]
        for asked, like in ((AS_TOD, TOD), (AS_TOD_PATHS, TOD_PATHS))
        if like in sizes
    }
    for one, room in budgets.items():
        try:
            found += trials({one: wanted("budget", budget_bytes=room)})
        except InputError as error:  # a map so small that a part of it has no room for a node
            refused[one] = str(error)
    own = [
        {one.session.id for foray in forays for one in foray}
        for forays in plan.forays(fold).values()
    ]
    tried = [
        {
            **_plain(one),
            "united": float(np.mean([_united(one, found[0].nodes, mine) for mine in own])),
        }
        for one in found
    ]
    write_json(path, {"thumbnails": False, "refused": refused, "tried": tried})


def read_trials(
    plan: FleetPlan, arm: Arm, fold: Fold, drive: EvaluatedDrive
) -> list[TriedDownload]:
    """The trials of one held-out drive; empty if they are still to be made."""
    kept = _kept(trials_path(plan, arm, fold, drive))
    if kept is None:
        return []
    names = {one.name for one in fields(TriedDownload)}
    return [
        TriedDownload(
            **{
                **{key: value for key, value in one.items() if key in names},
                "drive": Drive(np.array(one["drive"][0]), np.array(one["drive"][1], np.bool_)),
            }
        )
        for one in kept
    ]


def _kept(path: Path) -> list[dict[str, Any]] | None:
    """Trials that were made; None if they are still to be made.

    Earlier versions said nothing of thumbnails, and had them in all but `budget`: their trials do
    not count, so that they are never pooled with those of today.
    """
    if not path.exists():
        return None
    values = read_json(path)
    tried: list[dict[str, Any]] = values["tried"]
    return tried if values.get("thumbnails") is False else None


def _start(plan: FleetPlan, fold: Fold, drive: EvaluatedDrive, opened: Map) -> Position | None:
    """Where the drive begins, by truth; None if unknown: it is lost."""
    truth = drive.truth()
    log = FrameLog(drive.path)
    first = None if truth is None else truth.at(int(log.stamps_ns[0]))
    log.close()
    return None if first is None else true_nodes(opened, plan.training(fold)).start(first)


def _united(trial: Trial, whole: Sequence[Node], own: Collection[SessionId]) -> int:
    """Nodes on a robot that keeps all it saved itself in addition to what was sent."""
    mine = sum(node.session in own for node in whole)
    return mine + sum(node.session not in own for node in trial.nodes)


def _plain(trial: Trial) -> dict[str, Any]:
    return {
        "name": trial.name,
        "nodes": trial.report.nodes,
        "of_nodes": trial.report.of_nodes,
        "size_bytes": trial.report.size_bytes,
        "expected_missed": trial.report.expected_missed,
        "drive": [trial.steps.step_m.tolist(), trial.steps.matched.tolist()],
        "ms": trial.ms_per_frame,
        "lookup_ms": trial.lookup_ms_per_frame,
        "lookups": trial.lookups,
        "in_force": of_revision({"download": trial.asked}),
    }
