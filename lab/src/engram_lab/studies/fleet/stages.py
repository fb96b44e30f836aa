"""What a frame, an attempt and a look-up cost here: measured once, then only counted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import islice
from pathlib import Path
from time import perf_counter

import numpy as np

from engram.graph.model import node_id
from engram.localiser import FrameMatcher, Localisation, Relocaliser, accept_lost
from engram.maps import Map, open_map
from engram.robot import RobotOptions, Settings, arriving, robot_on, session_of_drive
from engram.robot.localisers import relocaliser_in
from engram.sequences import FrameLog
from engram_lab.studies.fleet.arms import Arm
from engram_lab.studies.fleet.plan import FleetPlan
from engram_lab.studies.fleet.records import read_json, write_record
from engram_lab.studies.fleet.steps import map_path
from engram_lab.studies.folds import Fold

# Enough for medians.
_DRIVES = 5
_FRAMES = 80
_LOST_FRAMES = 5  # each drive begins lost, so that all ask for places
_ROUNDS = 8
_PASSES = 5
_LOST_PLACES = 10  # of each drive, at which the lost attempt what is proposed
_PROPOSED = 16
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
        proposed_ms: of one in vain at a node that was proposed to a lost robot. Of the many that
            it makes one at most finds it; that one costs more.
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
    """Where an arm's medians are kept.

    Not as ``stages.json``: those of before left the lost's attempts to what held-out drives met.
    """
    return plan.work / f"arm-{arm.letter}" / "medians.json"


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
    rounds = min(arm.driving.budget.attempts, _ROUNDS)
    options = replace(arm.driving, lanes=1, rounds=rounds, threads=None)
    drives, centre = plan.held_out(fold), map_path(plan, arm, fold, name)
    chosen = [one.path for one in drives[:: max(len(drives) // _DRIVES, 1)][:_DRIVES]]
    passes = [medians(chosen, centre, plan.settings, options) for _ in range(_PASSES)]
    write_record(path, StageTimes(**{one: min(made[one] for made in passes) for one in passes[0]}))


def medians(
    drives: Sequence[Path], centre: Path, settings: Settings, options: RobotOptions
) -> dict[str, float]:
    """What each stage takes, in one pass.

    Args:
        drives: frame logs of drives that the map does not hold.
        centre: the map.
        settings: the resolved configuration.
        options: policy and budget; one lane, so that attempts are made one after another.

    Returns:
        Medians by the names of `StageTimes`, ms; 0 for what did not happen.
    """
    taken_ms: dict[str, list[float]] = {one.name: [] for one in fields(StageTimes)}
    for drive in drives:
        log = FrameLog(drive)
        with (
            open_map(centre) as opened,
            robot_on(opened, log, settings, options) as robot,
            closing(arriving(log)) as frames,
        ):
            for number, arrived in enumerate(islice(frames, _FRAMES)):
                found = robot.step(arrived)
                if number < _LOST_FRAMES:
                    robot.lose()
                for stage, ms in _stages_of(found):
                    taken_ms[stage].append(ms)
            if options.relocaliser is not None:
                relocaliser = relocaliser_in(opened, options.relocaliser, log.header.descriptor)
                taken_ms["proposed_ms"] += _in_vain_ms(opened, log, settings, relocaliser)
        log.close()
    return {name: float(np.median(some)) if some else 0.0 for name, some in taken_ms.items()}


def _stages_of(one: Localisation) -> Iterator[tuple[str, float]]:
    """The stages of a frame; without attempts if the robot was lost."""
    yield "frame_ms", sum(one.stage_ms.get(stage, 0.0) for stage in _FRAME_STAGES)
    if one.attempts and not one.proposed:
        yield "attempt_ms", one.stage_ms["attempts"] / one.attempts
    if "places" in one.stage_ms:
        yield "lookup_ms", one.stage_ms["places"]


def _in_vain_ms(
    opened: Map, log: FrameLog, settings: Settings, relocaliser: Relocaliser
) -> Iterator[float]:
    """Each attempt that does not find a robot which is lost here and there along its drive.

    Not left to chance: where all held-out drives are found at once there would be none. The
    landmarks are in memory, as they are for those who are lost for a while.
    """
    landmarks, acceptance = opened.frames, settings.localiser.acceptance
    matcher = FrameMatcher(landmarks, settings.localiser.lost_matcher)
    session = session_of_drive(log).id
    for logged in islice(log, 0, None, max(len(log) // _LOST_PLACES, 1)):
        live = logged.frame
        live_id = node_id(session, live.stamp_ns)
        relocaliser.forget()
        for index in relocaliser.propose(live, _PROPOSED, lambda _: True):
            node = opened.graph.node(index).id
            landmarks.frame(node)
            started = perf_counter()
            match = matcher.match(live, live_id, node, None)
            spread = partial(matcher.spread, live, live_id, node, match)
            if not accept_lost(match, spread, acceptance):
                yield 1e3 * (perf_counter() - started)
