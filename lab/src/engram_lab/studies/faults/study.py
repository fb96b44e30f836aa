"""Drives with injected faults, localised in a map of the same place: what is claimed, and is true.

A trial is a fault, a clip, a start and a strength. The map is made from the clip's own town on
another day; then the drive is mapped into a copy of it. Trials are numbered; each is drawn from its
number, so that a run is resumed by number.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram.monitor import QUIET, Monitor
from engram_lab.studies.faults.clips import JUDGING, REVERSED, Clip, Plan
from engram_lab.studies.faults.injected import undisturbed
from engram_lab.studies.faults.mapping import map_on
from engram_lab.studies.faults.places import Places
from engram_lab.studies.faults.real import real_plans
from engram_lab.studies.faults.staging import ELSEWHERE, Scene, drawn, staged
from engram_lab.studies.faults.trials import MADE_BY, Trial, TrialFile

# A fix further from the truth is false.
FALSE_M = 1.0
FALSE_RAD = float(np.deg2rad(5.0))
# False fixes less than this apart are one event.
_EVENT_M = 20.0


@dataclass(frozen=True, slots=True)
class Fix:
    """A fix of a trial.

    Attributes:
        at: its place among the frames that were shown.
        frame: number of the frame of the drive.
        error_m: how far off it is.
        false: whether that is too far.
    """

    at: int
    frame: int
    error_m: float
    false: bool


def localised(scene: Scene) -> tuple[list[Fix], list[str]]:
    """The fixes of a robot that meets a scene; fatal findings of its doctor."""
    clip, hint, fixes = scene.clip, scene.hint, []
    with scene.place.opened.robot(clip.pairs[0].camera) as robot:
        for at, one in enumerate(scene.shown):
            if hint is not None and one.frame >= scene.start:
                robot.place_at(hint)
                hint = None
            found = robot.step(one.pair)
            error = scene.place.error(found, clip.world_from_cam[one.frame])
            if error is not None:
                false = error[0] > FALSE_M or error[1] > FALSE_RAD
                fixes.append(Fix(at, one.frame, error[0], false))
        return fixes, [one.code for one in robot.diagnosis.fatal]


def run_trial(number: int, fault: str, scene: Scene, right: frozenset[int] = frozenset()) -> Trial:
    """One drive with one fault, localised.

    Args:
        number: of the trial.
        fault: its name.
        scene: what the robot meets.
        right: frames of the clip with a right fix where nothing is wrong.
    """
    clip = scene.clip
    trial = Trial(number, fault, clip.plan.name, scene.start, scene.strength, made_by=MADE_BY)
    steps = zip(clip.world_from_cam, clip.world_from_cam[1:], strict=False)
    trial.driven_m = sum((a.inverse() @ b).distance_m for a, b in steps)
    fixes, trial.refused = localised(scene)
    trial.frames, trial.fixes = len(scene.shown), len(fixes)
    trial.false, trial.events = sum(one.false for one in fixes), _events(fixes, clip)
    trial.worst_m = max((one.error_m for one in fixes), default=0.0)
    found = [one for one in fixes if not one.false]
    expected = right & {one.frame for one in scene.shown}
    trial.expected = len(expected)
    trial.lost = len(expected - {one.frame for one in found})
    behind = [at for at, one in enumerate(scene.shown) if one.frame >= trial.start]
    again = [one.at - behind[0] for one in found if behind and one.at >= behind[0]]
    trial.again = again[0] if again else None
    return trial


def _events(fixes: Sequence[Fix], clip: Clip) -> int:
    """Runs of false fixes."""
    events, last = 0, None
    for one in fixes:
        if one.false:
            here = clip.world_from_cam[one.frame]
            events += last is None or (last.inverse() @ here).distance_m > _EVENT_M
            last = here
    return events


def available() -> list[Plan]:
    """The clips of the study: rendered ones that are in the cache, and real ones.

    With other clips at hand a number draws another clip; trials that are made stay.
    """
    return [*(one for one in (*JUDGING, *REVERSED) if one.path().exists()), *real_plans()]


def run(
    file: Path, trials: int, plans: Sequence[Plan] | None = None, monitor: Monitor = QUIET
) -> Iterator[Trial]:
    """Makes the trials up to a number that are missing from a file of results, by place.

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
    right: dict[str, frozenset[int]] = {}
    for town in dict.fromkeys(plan.town for _, _, plan, _ in left):
        with (
            tempfile.TemporaryDirectory(prefix="engram-faults-") as folder,
            closing(Places(plans, town, Path(folder))) as places,
        ):
            for number, fault, plan, rng in left:
                if plan.town != town:
                    continue
                try:
                    trial = _trial(number, fault, plan, places, rng, right)
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
    number: int,
    fault: str,
    plan: Plan,
    places: Places,
    rng: np.random.Generator,
    right: dict[str, frozenset[int]],
) -> Trial | None:
    """One trial, localised and mapped; None if it cannot be staged.

    `right` remembers the frames of each clip with a right fix where nothing is wrong.
    """
    scene = staged(fault, plan, places, rng)
    if scene is None:
        return None
    if places.own and fault not in ELSEWHERE and plan.name not in right:
        clip = places.clip(plan)
        fixes, _ = localised(Scene(clip, places.own, 0, 0.0, undisturbed(clip.pairs)))
        right[plan.name] = frozenset(one.frame for one in fixes if not one.false)
    trial = run_trial(number, fault, scene, right.get(plan.name, frozenset()))
    map_on(trial, scene, places.folder / "mapped.engram")
    return trial
