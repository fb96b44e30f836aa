"""What one frame, one attempt and one look-up cost here: measured once, then only counted."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from engram.drive import LocaliseOptions, LocaliseRun, Settings
from engram.evaluation.fleet.arms import Arm
from engram.evaluation.fleet.plan import FleetPlan
from engram.evaluation.fleet.records import read_json, write_record
from engram.evaluation.fleet.steps import map_path
from engram.evaluation.folds import Fold
from engram.sequences import FrameLog

# Enough for medians; a drive begins lost, so that there are look-ups among them.
_FRAMES = 300
_LOST_FRAMES = 20
_ROUNDS = 8
_PASSES = 5


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Medians on one core.

    Attributes:
        frame_ms: of a frame: carrying on, neighbourhood, ranking, remembering.
        attempt_ms: of one match attempt.
        lookup_ms: of asking the relocaliser.
    """

    frame_ms: float
    attempt_ms: float
    lookup_ms: float

    def seconds(self, frames: int, attempts: int, lookups: int) -> float:
        """What so many take."""
        ms = frames * self.frame_ms + attempts * self.attempt_ms + lookups * self.lookup_ms
        return ms / 1e3


def stages_path(plan: FleetPlan, arm: Arm) -> Path:
    """Where an arm's medians are kept."""
    return plan.work / f"arm-{arm.letter}" / "stages.json"


def read_stages(plan: FleetPlan, arm: Arm) -> StageTimes | None:
    """An arm's medians; None if they were not measured yet."""
    path = stages_path(plan, arm)
    return StageTimes(**read_json(path)) if path.exists() else None


def measure_stages(plan: FleetPlan, arm: Arm, fold: Fold, name: str) -> None:
    """Localises a held-out drive attempt by attempt, and keeps the medians; once per arm.

    A few times over: of each stage the lowest median counts, since what else the machine does is
    none of the arm's.
    """
    path = stages_path(plan, arm)
    if path.exists():
        return
    options = LocaliseOptions(
        arm.policy, 1, min(arm.rounds * arm.lanes, _ROUNDS), relocaliser=plan.options.relocaliser
    )
    drive, centre = plan.held_out(fold)[0], map_path(plan, arm, fold, name)
    passes = [_medians(drive.path, centre, plan.settings, options) for _ in range(_PASSES)]
    write_record(path, StageTimes(*np.min(passes, axis=0).tolist()))


def _medians(
    drive: Path, centre: Path, settings: Settings, options: LocaliseOptions
) -> tuple[float, float, float]:
    """Of a frame, an attempt and a look-up, ms; 0 for what did not happen."""
    log = FrameLog(drive)
    frame_ms, attempt_ms, lookup_ms = [], [], []
    with LocaliseRun(centre, log, settings, options) as run:
        for number, (_, result) in enumerate(islice(run, _FRAMES)):
            if number < _LOST_FRAMES:
                run.localiser.position = None  # lost again
            stage_ms, attempts = result.localisation.stage_ms, result.localisation.attempts
            frame_ms.append(sum(stage_ms.get(one, 0.0) for one in ("neighbourhood", "rank")))
            frame_ms[-1] += stage_ms["remember"]
            if attempts:
                attempt_ms.append(stage_ms["attempts"] / attempts)
            if "places" in stage_ms:
                lookup_ms.append(stage_ms["places"])
    log.close()
    frame, attempt, lookup = (
        float(np.median(some)) if some else 0.0 for some in (frame_ms, attempt_ms, lookup_ms)
    )
    return frame, attempt, lookup
