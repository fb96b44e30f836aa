"""What a robot meets in a trial: its frames, its map, and the positions that it is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from engram.localiser import Position
from engram_lab.studies.faults.clips import Clip, ClipPlan, Plan
from engram_lab.studies.faults.injected import FAULTS, FROM_THE_FIRST, Shown, undisturbed
from engram_lab.studies.faults.places import Place, Places

NONE = "none"
OTHER_TOWN = "map of another town"
CARRIED = "told a wrong place"
REVERSE = "driving in the other direction"
TURNED = "turned round unseen"
DAMAGED = "damaged landmarks"
KINDS = (NONE, OTHER_TOWN, CARRIED, REVERSE, TURNED, DAMAGED, *FAULTS)
# Of these, no frame of the clip has a right fix where nothing is wrong.
ELSEWHERE = frozenset({OTHER_TOWN, REVERSE, TURNED})
# Changes with what a number means, so that results of two meanings are not mixed.
DRAW = 3
# Frames before a fault, in which the robot finds itself, and after its start.
_BEFORE, _AFTER = 15, 25
# Frames of a drive that are shown, at most.
_WINDOW = 150


@dataclass(frozen=True, slots=True)
class Span:
    """Between which strengths are drawn, log-uniformly, in which unit."""

    unit: str
    weakest: float
    strongest: float


STRENGTHS = {
    CARRIED: Span("m", 0.1, 3.0),
    DAMAGED: Span("of the nodes", 0.02, 1.0),
    **{name: Span(one.unit, one.weakest, one.strongest) for name, one in FAULTS.items()},
}


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a robot meets.

    Attributes:
        clip: the truth.
        place: the map.
        start: number of the first frame of the fault.
        strength: of the fault.
        shown: the frames that it is shown.
        hint: a wrong place that it is told at the start; None if it is told nothing.
    """

    clip: Clip
    place: Place
    start: int
    strength: float
    shown: list[Shown]
    hint: Position | None = None


def drawn(number: int, plans: Sequence[Plan]) -> tuple[str, Plan, np.random.Generator] | None:
    """Fault and clip of a trial, the rest is drawn from the generator; None without such a clip."""
    rng = np.random.default_rng([number, 0xFA017])
    fault = KINDS[number % len(KINDS)]
    against = fault in {REVERSE, TURNED}
    live = [plan for plan in plans if not plan.mapped and plan.reverse == against]
    return (fault, live[int(rng.integers(len(live)))], rng) if live else None


def staged(fault: str, plan: Plan, places: Places, rng: np.random.Generator) -> Scene | None:
    """The scene of a trial; None without a map, or if it holds no wrong place to give."""
    clip, place = places.clip(plan), places.other if fault == OTHER_TOWN else places.own
    start = int(rng.integers(_BEFORE, max(_BEFORE + 1, len(clip) - _AFTER)))
    strength = _strength(fault, rng)
    if fault in FROM_THE_FIRST:
        start = 0
    if fault == REVERSE:
        first = start - _BEFORE
        clip, start = Clip(plan, clip.pairs[first:], clip.world_from_cam[first:]), 0
    elif fault == TURNED:
        assert isinstance(plan, ClipPlan)  # no real clip is reversed
        clip = turned_round(places.clip(replace(plan, reverse=False)), clip, start)
    elif fault == DAMAGED:
        place, start = places.damaged(strength, rng), 0
    if place is None:
        return None
    scene = Scene(clip, place, start, strength, undisturbed(clip.pairs))
    if fault == CARRIED:
        hint = place.wrong_hint(clip.world_from_cam[start], strength, rng)
        return None if hint is None else replace(scene, hint=hint)
    if fault in FAULTS:
        shown = FAULTS[fault].apply(clip.pairs, strength, start, rng)
        return replace(scene, shown=shown[:_WINDOW])
    return scene


def _strength(fault: str, rng: np.random.Generator) -> float:
    span = STRENGTHS.get(fault)
    if span is None:
        return 0.0
    return float(np.exp(rng.uniform(np.log(span.weakest), np.log(span.strongest))))


def turned_round(forwards: Clip, back: Clip, start: int) -> Clip:
    """A clip until a frame, and from there on the opposite clip; its stamps continue."""
    here = forwards.world_from_cam[start - 1].translation
    off_m = [np.linalg.norm(pose.translation - here) for pose in back.world_from_cam]
    first = int(np.argmin(off_m))
    shift_ns = forwards.pairs[start].stamp_ns - back.pairs[first].stamp_ns
    behind = [replace(pair, stamp_ns=pair.stamp_ns + shift_ns) for pair in back.pairs[first:]]
    return Clip(
        back.plan,
        [*forwards.pairs[:start], *behind],
        [*forwards.world_from_cam[:start], *back.world_from_cam[first:]],
    )
