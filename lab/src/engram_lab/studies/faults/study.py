"""Drives with injected faults, localised in a map of the same place: what is claimed, and is true.

A trial is a fault, a clip, a start and a strength. The map is made from the clip's own town on
another day. Trials are numbered; each is drawn from its number, so that a run is resumed by number.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from engram.geometry import SE3
from engram.graph.model import NodeId
from engram.localiser import Localisation, Position
from engram.maps import Map, open_map
from engram.monitor import QUIET, Monitor
from engram_lab.studies.faults.clips import JUDGING, MAPPED, Clip, ClipPlan
from engram_lab.studies.faults.injected import FAULTS, Shown

# A fix further from the truth is false.
FALSE_M = 1.0
FALSE_RAD = float(np.deg2rad(5.0))
# False fixes less than this apart are one event.
_EVENT_M = 20.0
# A place is wrong that is so far off, m.
_OFF_M = 15.0
# Frames before the fault: the robot has found itself.
_BEFORE = 15
# Frames of a drive that are shown, at most.
_WINDOW = 150
NONE = "none"
OTHER_TOWN = "map of another town"
CARRIED = "told a wrong place"
KINDS = (NONE, OTHER_TOWN, CARRIED, *FAULTS)


@dataclass(slots=True)
class Trial:
    """What came of one.

    Attributes:
        number: of the trial.
        fault: key in `FAULTS`, or one of the kinds of this module.
        clip: name of the clip.
        start: number of the first frame of the fault.
        strength: of the fault.
        frames, fixes: how many there were.
        false: fixes that are false.
        events: runs of false fixes.
        worst_m: largest error of a fix, m.
        again: frames from the end of the fault until the first right fix; None if never.
        driven_m: true length of the drive.
        refused: findings of the doctor that are fatal.
    """

    number: int
    fault: str
    clip: str
    start: int
    strength: float
    frames: int = 0
    fixes: int = 0
    false: int = 0
    events: int = 0
    worst_m: float = 0.0
    again: int | None = None
    driven_m: float = 0.0
    refused: list[str] = field(default_factory=list)


class Place:
    """A town that is mapped by its first clip.

    Args:
        mapped: the clip.
        path: the map, NAME.engram.
    """

    def __init__(self, mapped: Clip, path: Path) -> None:
        self.opened: Map = _mapped(mapped, path)
        truth = {
            pair.stamp_ns: pose
            for pair, pose in zip(mapped.pairs, mapped.world_from_cam, strict=True)
        }
        self.world_from_node: dict[NodeId, SE3] = {
            node.id: truth[node.stamp_ns] for node in self.opened.graph.nodes
        }

    def error(self, found: Localisation, world_from_cam: SE3) -> tuple[float, float] | None:
        """How far off a fix is, metres and radians; None without one."""
        if found.node is None or found.node_from_live is None:
            return None
        node_from_live = self.world_from_node[found.node].inverse() @ world_from_cam
        wrong = node_from_live.inverse() @ found.node_from_live
        return wrong.distance_m, wrong.angle_rad

    def nodes_off(self, world_from_cam: SE3) -> list[NodeId]:
        """Nodes so far from a camera that it would be told a wrong place by them."""
        return [
            node
            for node, pose in self.world_from_node.items()
            if (world_from_cam.inverse() @ pose).distance_m >= _OFF_M
        ]

    def close(self) -> None:
        """Closes the map."""
        self.opened.close()


def _mapped(clip: Clip, path: Path) -> Map:
    """A map of a clip, by a robot that maps live."""
    with (
        open_map(path, create=True) as opened,
        opened.robot(clip.pairs[0].camera, name="mapper", maps=True) as robot,
    ):
        for pair in clip.pairs:
            robot.step(pair)
    return open_map(path)


def drawn(number: int, plans: Sequence[ClipPlan]) -> tuple[str, ClipPlan, np.random.Generator]:
    """Fault and clip of a trial; the rest is drawn from the generator."""
    rng = np.random.default_rng([number, 0xFA017])
    live = [plan for plan in plans if plan.session != MAPPED]
    return KINDS[number % len(KINDS)], live[int(rng.integers(len(live)))], rng


def run_trial(
    number: int, fault: str, clip: Clip, place: Place, rng: np.random.Generator
) -> Trial | None:
    """One drive with one fault; None if the map is too short to tell the robot a wrong place."""
    start = int(rng.integers(_BEFORE, max(_BEFORE + 1, len(clip) - 25)))
    if fault == CARRIED and not place.nodes_off(clip.world_from_cam[start]):
        return None
    shown, strength, hint = _shown(fault, clip, start, place, rng)
    trial = Trial(number, fault, clip.plan.name, start, strength)
    steps = zip(clip.world_from_cam, clip.world_from_cam[1:], strict=False)
    trial.driven_m = sum((a.inverse() @ b).distance_m for a, b in steps)
    errors: list[tuple[int, float, bool]] = []
    with place.opened.robot(clip.pairs[0].camera) as robot:
        for number_shown, one in enumerate(shown[:_WINDOW]):
            if hint is not None and one.frame >= start:
                robot.place_at(hint)
                hint = None
            found = robot.step(one.pair)
            trial.frames += 1
            error = place.error(found, clip.world_from_cam[one.frame])
            if error is not None:
                wrong = error[0] > FALSE_M or error[1] > FALSE_RAD
                errors.append((number_shown, error[0], wrong))
        trial.refused = [one.code for one in robot.diagnosis.fatal]
    _count(trial, errors, shown, clip)
    return trial


def _shown(
    fault: str, clip: Clip, start: int, place: Place, rng: np.random.Generator
) -> tuple[list[Shown], float, Position | None]:
    """The frames, the strength and the wrong place that the robot is told."""
    plain = [Shown(k, pair) for k, pair in enumerate(clip.pairs)]
    if fault in {NONE, OTHER_TOWN}:
        return plain, 0.0, None
    if fault == CARRIED:
        sigma_m = float(np.exp(rng.uniform(np.log(0.1), np.log(3.0))))
        far = place.nodes_off(clip.world_from_cam[start])
        covariance = np.diag([sigma_m**2] * 3 + [np.deg2rad(2.0) ** 2] * 3)
        node = far[int(rng.integers(len(far)))]
        return plain, sigma_m, Position(node, SE3.identity(), covariance)
    what = FAULTS[fault]
    strength = float(np.exp(rng.uniform(np.log(what.weakest), np.log(what.strongest))))
    return what.apply(clip.pairs, strength, start, rng), strength, None


def _count(
    trial: Trial, errors: list[tuple[int, float, bool]], shown: Sequence[Shown], clip: Clip
) -> None:
    """Fills in what came of the fixes: number in `shown`, error, whether it is false."""
    trial.fixes = len(errors)
    trial.false = sum(wrong for *_, wrong in errors)
    trial.worst_m = max((error for _, error, _ in errors), default=0.0)
    last: SE3 | None = None
    for at, _, wrong in errors:
        here = clip.world_from_cam[shown[at].frame]
        if wrong and (last is None or (last.inverse() @ here).distance_m > _EVENT_M):
            trial.events += 1
        last = here if wrong else last
    behind = [at for at, one in enumerate(shown) if one.frame >= trial.start]
    right = [at for at, _, wrong in errors if not wrong and behind and at >= behind[0]]
    trial.again = right[0] - behind[0] if right else None


def run(
    file: Path, trials: int, plans: Sequence[ClipPlan] = tuple(JUDGING), monitor: Monitor = QUIET
) -> Iterator[Trial]:
    """Makes the trials up to a number that a file of results lacks, place by place.

    Args:
        file: results, a line of JSON each; added to.
        trials: how many in all.
        plans: the clips; those that are not in the cache are left out.
        monitor: receives the fault of each trial, and may stop the run.
    """
    there = [plan for plan in plans if plan.path().exists()]
    done = {one.number for one in read_trials(file)}
    file.parent.mkdir(parents=True, exist_ok=True)
    drawn_all = [(number, *drawn(number, there)) for number in range(trials) if number not in done]
    with tempfile.TemporaryDirectory(prefix="engram-faults-") as folder:
        for town in dict.fromkeys(plan.town for _, _, plan, _ in drawn_all):
            mine = [one for one in drawn_all if one[2].town == town]
            places = _Places(there, town, Path(folder))
            with closing(places):
                for number, fault, plan, rng in mine:
                    place = places.other if fault == OTHER_TOWN else places.own
                    if place is None:
                        continue
                    trial = run_trial(number, fault, places.clip(plan), place, rng)
                    if trial is None:
                        continue
                    with file.open("a", encoding="utf-8") as out:
                        out.write(json.dumps(asdict(trial)) + "\n")
                    monitor.advance(fault)
                    monitor.check()
                    yield trial


class _Places:
    """The map of a town, and of another one by the same kind of camera; their clips."""

    def __init__(self, plans: Sequence[ClipPlan], town: int, folder: Path) -> None:
        maps = [plan for plan in plans if plan.session == MAPPED]
        own = [plan for plan in maps if plan.town == town]
        others = [plan for plan in maps if plan.town != town]
        self._clips: dict[str, Clip] = {}
        self.own = Place(own[0].read(), folder / f"{town}.engram") if own else None
        self.other = Place(others[0].read(), folder / f"{town}-other.engram") if others else None

    def clip(self, plan: ClipPlan) -> Clip:
        if plan.name not in self._clips:
            self._clips = {plan.name: plan.read()}
        return self._clips[plan.name]

    def close(self) -> None:
        for place in (self.own, self.other):
            if place is not None:
                place.close()


def read_trials(file: Path) -> list[Trial]:
    """The trials of a file; a line that a killed run left unfinished is left out."""
    if not file.exists():
        return []
    lines = file.read_text(encoding="utf-8").splitlines()
    rows: list[dict[str, Any]] = [json.loads(line) for line in lines if line.endswith("}")]
    return [Trial(**row) for row in rows]
