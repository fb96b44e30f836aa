"""Drives with injected faults, localised in a map of the same place: what is claimed, and is true.

A trial is a fault, a clip, a start and a strength. The map is made from the clip's own town on
another day; then the drive is mapped into a copy of it. Trials are numbered; each is drawn from its
number, so that a run is resumed by number.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from engram.geometry import SE3
from engram.monitor import QUIET, Monitor
from engram_lab.studies.faults.clips import JUDGING, REVERSED, Plan
from engram_lab.studies.faults.mapping import map_on
from engram_lab.studies.faults.places import Places
from engram_lab.studies.faults.real import real_plans
from engram_lab.studies.faults.staging import Scene, drawn, staged
from engram_lab.studies.faults.trials import MADE_BY, Trial, TrialFile

# A fix further from the truth is false.
FALSE_M = 1.0
FALSE_RAD = float(np.deg2rad(5.0))
# False fixes less than this apart are one event.
_EVENT_M = 20.0


def run_trial(number: int, fault: str, scene: Scene) -> Trial:
    """One drive with one fault, localised."""
    clip = scene.clip
    trial = Trial(number, fault, clip.plan.name, scene.start, scene.strength, made_by=MADE_BY)
    steps = zip(clip.world_from_cam, clip.world_from_cam[1:], strict=False)
    trial.driven_m = sum((a.inverse() @ b).distance_m for a, b in steps)
    errors: list[tuple[int, float, bool]] = []
    hint = scene.hint
    with scene.place.opened.robot(clip.pairs[0].camera) as robot:
        for at, one in enumerate(scene.shown):
            if hint is not None and one.frame >= scene.start:
                robot.place_at(hint)
                hint = None
            found = robot.step(one.pair)
            error = scene.place.error(found, clip.world_from_cam[one.frame])
            if error is not None:
                errors.append((at, error[0], error[0] > FALSE_M or error[1] > FALSE_RAD))
        trial.refused = [one.code for one in robot.diagnosis.fatal]
    _count(trial, errors, scene)
    return trial


def _count(trial: Trial, errors: list[tuple[int, float, bool]], scene: Scene) -> None:
    """Fills in what came of the fixes: number of the frame, error, whether it is false."""
    trial.frames = len(scene.shown)
    trial.fixes = len(errors)
    trial.false = sum(wrong for *_, wrong in errors)
    trial.worst_m = max((error for _, error, _ in errors), default=0.0)
    last: SE3 | None = None
    for at, _, wrong in errors:
        here = scene.clip.world_from_cam[scene.shown[at].frame]
        if wrong and (last is None or (last.inverse() @ here).distance_m > _EVENT_M):
            trial.events += 1
        last = here if wrong else last
    behind = [at for at, one in enumerate(scene.shown) if one.frame >= trial.start]
    right = [at for at, _, wrong in errors if not wrong and behind and at >= behind[0]]
    trial.again = right[0] - behind[0] if right else None


def available() -> list[Plan]:
    """The clips of the study: rendered ones that are in the cache, and real ones."""
    return [*(one for one in (*JUDGING, *REVERSED) if one.path().exists()), *real_plans()]


def run(
    file: Path, trials: int, plans: Sequence[Plan] | None = None, monitor: Monitor = QUIET
) -> Iterator[Trial]:
    """Makes the trials up to a number that a file of results lacks, place by place.

    Args:
        file: results, a line of JSON each; added to.
        trials: how many in all.
        plans: the clips; None for those that are `available`.
        monitor: receives the fault of each trial, and may stop the run.

    Raises:
        ConfigError: the file holds trials of other versions.
    """
    plans, made = available() if plans is None else plans, TrialFile(file)
    wanted = [(number, drawn(number, plans)) for number in range(trials)]
    left = [(number, *one) for number, one in wanted if one and number not in made.numbers]
    for town in dict.fromkeys(plan.town for _, _, plan, _ in left):
        with (
            tempfile.TemporaryDirectory(prefix="engram-faults-") as folder,
            closing(Places(plans, town, Path(folder))) as places,
        ):
            for number, fault, plan, rng in left:
                if plan.town != town:
                    continue
                try:
                    trial = _trial(number, fault, plan, places, rng)
                except Exception as error:
                    error.add_note(f"in trial {number}: {fault}, {plan.name}")
                    raise
                if trial is None:
                    continue
                made.add(trial)
                monitor.advance(fault)
                monitor.check()
                yield trial


def _trial(
    number: int, fault: str, plan: Plan, places: Places, rng: np.random.Generator
) -> Trial | None:
    """One trial, localised and mapped; None if it cannot be staged."""
    scene = staged(fault, plan, places, rng)
    if scene is None:
        return None
    trial = run_trial(number, fault, scene)
    map_on(trial, scene, places.folder / "mapped.engram")
    return trial
