"""What a frame, an attempt and a look-up cost here: measured once, then only counted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path

import numpy as np

from engram.drive import LocaliseOptions, LocaliseRun, Settings
from engram.evaluation.fleet.arms import Arm
from engram.evaluation.fleet.plan import FleetPlan
from engram.evaluation.fleet.records import read_json, write_record
from engram.evaluation.fleet.steps import map_path
from engram.evaluation.folds import Fold
from engram.localiser import Localisation
from engram.sequences import FrameLog

# Enough for medians. Each drive begins lost, and in bad weather it stays so: most of what the lost
# attempt is in vain, and cheaper than what finds them.
_DRIVES = 5
_FRAMES = 80
_LOST_FRAMES = 5
_ROUNDS = 8
_PASSES = 5
_FRAME_STAGES = ("neighbourhood", "rank", "remember")


@dataclass(frozen=True, slots=True)
class Counts:
    """What was done, on whatever machine.

    Attributes:
        frames: localised, or tried to.
        attempts: match attempts.
        proposed: how many of them at nodes that were proposed to a lost robot.
        lookups: how often the relocaliser was asked.
    """

    frames: int
    attempts: int
    proposed: int
    lookups: int


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Medians on one core.

    Attributes:
        frame_ms: of a frame: carrying on, neighbourhood, ranking, remembering.
        attempt_ms: of one match attempt where something was expected.
        proposed_ms: of one at a node that was proposed to a lost robot.
        lookup_ms: of asking the relocaliser.
    """

    frame_ms: float
    attempt_ms: float
    proposed_ms: float
    lookup_ms: float

    def seconds(self, counts: Counts) -> float:
        """What so many take."""
        ms = (
            counts.frames * self.frame_ms
            + (counts.attempts - counts.proposed) * self.attempt_ms
            + counts.proposed * self.proposed_ms
            + counts.lookups * self.lookup_ms
        )
        return ms / 1e3


def stages_path(plan: FleetPlan, arm: Arm) -> Path:
    """Where an arm's medians are kept."""
    return plan.work / f"arm-{arm.letter}" / "stages.json"


def read_stages(plan: FleetPlan, arm: Arm) -> StageTimes | None:
    """An arm's medians; None if they were not measured yet."""
    path = stages_path(plan, arm)
    return StageTimes(**read_json(path)) if path.exists() else None


def measure_stages(plan: FleetPlan, arm: Arm, fold: Fold, name: str) -> None:
    """Localises some held-out drives attempt by attempt, and keeps the medians; once per arm.

    A few times over: of each stage the lowest median counts, since what else the machine does is
    none of the arm's.
    """
    path = stages_path(plan, arm)
    if path.exists():
        return
    options = LocaliseOptions(
        arm.policy, 1, min(arm.rounds * arm.lanes, _ROUNDS), relocaliser=plan.options.relocaliser
    )
    drives, centre = plan.held_out(fold), map_path(plan, arm, fold, name)
    chosen = [one.path for one in drives[:: max(len(drives) // _DRIVES, 1)][:_DRIVES]]
    passes = [_medians(chosen, centre, plan.settings, options) for _ in range(_PASSES)]
    write_record(path, StageTimes(**{one: min(made[one] for made in passes) for one in passes[0]}))


def _medians(
    drives: Sequence[Path], centre: Path, settings: Settings, options: LocaliseOptions
) -> dict[str, float]:
    """By the names of `StageTimes`, ms; 0 for what did not happen."""
    taken_ms: dict[str, list[float]] = {one.name: [] for one in fields(StageTimes)}
    for drive in drives:
        log = FrameLog(drive)
        with LocaliseRun(centre, log, settings, options) as run:
            for number, (_, result) in enumerate(islice(run, _FRAMES)):
                if number < _LOST_FRAMES:
                    run.localiser.position = None  # lost again
                for stage, ms in _stages_of(result.localisation):
                    taken_ms[stage].append(ms)
        log.close()
    return {name: float(np.median(some)) if some else 0.0 for name, some in taken_ms.items()}


def _stages_of(one: Localisation) -> Iterator[tuple[str, float]]:
    """What a frame tells about stages; frames with both kinds of attempts say nothing of either."""
    yield "frame_ms", sum(one.stage_ms.get(stage, 0.0) for stage in _FRAME_STAGES)
    if one.attempts and one.proposed in (0, one.attempts):
        kind = "proposed_ms" if one.proposed else "attempt_ms"
        yield kind, one.stage_ms["attempts"] / one.attempts
    if "places" in one.stage_ms:
        yield "lookup_ms", one.stage_ms["places"]
