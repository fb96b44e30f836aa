"""Rows (d) and (f) of the town's calibration: how a month of laps fills a map and what fails in it.

They need mapper and localiser, and half an hour; `benchmarks/world.py` measures them, and the
result is kept with the package.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from engram.errors import SequenceError
from engram.measures import Drive, route_not_localised
from engram.monitor import ignore
from engram.robot import MapOptions, Settings
from engram_lab.studies.configurations import UNLIMITED, Configuration
from engram_lab.studies.drives import DriveSet, drives_of
from engram_lab.studies.running import Plan, RankingOptions, built_map, make_plan, run
from engram_lab.studies.store import read_runs
from engram_lab.town import Campaign, Size, campaign_named
from engram_lab.town.calibration import LOOP_M, Row
from engram_lab.town.campaigns import by_day
from engram_lab.town.simulating import campaign_folder

LAPS = 40
# The laps whose five folds leave 20 to build from.
_EARLY_LAPS = 25
_EVERYTHING = Configuration("distance", UNLIMITED)
# Counts only, more of them than there are candidates, one after another: the first success ends it.
_EXHAUSTIVE = MapOptions(policy="distance", lanes=1, rounds=UNLIMITED, relocaliser="fabmap")


def month(seed: int = 1, laps: int = LAPS) -> Campaign:
    """`begbroke24h` in small: a loop of 0.15 km and some of its 140 laps.

    A systematic sample of the laps in the order of weather and hour, so that few laps meet all
    hours and every weather in its share: how many of them are rainy decides what fails.
    """
    whole = campaign_named("begbroke24h", seed, Size.FULL)
    ordered = sorted(whole.sessions, key=lambda lap: (lap.weather, lap.start.time(), lap.number))
    first = np.random.default_rng([seed, 0x40]).random()
    drawn = [ordered[int((k + first) * len(ordered) / laps)] for k in range(laps)]
    drawn.sort(key=lambda lap: lap.number)
    sessions = tuple(replace(lap, number=number) for number, lap in enumerate(drawn))
    return replace(whole, name="month", home="month", length_m=LOOP_M, sessions=sessions)


@dataclass(frozen=True, slots=True)
class MonthResult:
    """What a cross-validation over the laps came to, 0…1 each.

    Attributes:
        saved: share of the training laps' frames that did not localise: the distance that is
            saved as new experience.
        candidates: nodes that a held-out frame may be matched with, mean.
        can_succeed: share of these that match it.
        fails_by_day: share of the route of held-out laps between 7 and 19 h without a match.
        fails: the same of all held-out laps.
    """

    saved: float
    candidates: float
    can_succeed: float
    fails_by_day: float
    fails: float


def measure_laps(
    laps: Sequence[Path], work: Path, workers: int = 1, advance: Callable[[str], None] = ignore
) -> MonthResult:
    """Five folds over some laps, everything attempted; goes on where an earlier run stopped.

    Args:
        laps: their frame logs, with truth.
        work: folder for maps and results.
        workers: processes.
        advance: called after each map and each lap.

    Raises:
        SequenceError: a lap is missing or was not rendered to its end.
    """
    missing = [path for path in laps if not path.exists()]
    if missing:
        raise SequenceError(f"{len(missing)} laps are not rendered; the first is {missing[0]}")
    options = RankingOptions(
        ("distance",), (UNLIMITED,), (1,), map_sizes=False, live_folds=0, build=_EXHAUSTIVE
    )
    drives = DriveSet(f"month-{len(laps)}", drives_of(laps))
    plan = make_plan(drives, Settings(), options, work)
    run(plan, workers, advance)
    return _result(plan)


def _result(plan: Plan) -> MonthResult:
    localised = [
        one.share_localised for fold in plan.folds for one in built_map(plan, fold).sessions
    ]
    held_out: list[Drive] = []
    of_day: list[Drive] = []
    candidates, succeeded = [], []
    for number, lap in enumerate(plan.drives.drives):
        runs = read_runs(plan.runs_path(number, "memo"))
        if runs is None:
            raise SequenceError(f"{lap.path}: was not localised; run the same again")
        row = runs.configurations.index(_EVERYTHING)
        held_out.append(Drive(runs.step_m, runs.matched[row]))
        if by_day(datetime.fromtimestamp(lap.session.start_ns / 1e9, UTC)):
            of_day.append(held_out[-1])
        candidates.append(runs.candidates[row])
        succeeded.append(runs.succeeded[row])
    tried = np.concatenate(candidates)
    return MonthResult(
        saved=1 - float(np.mean(localised)),
        candidates=float(tried.mean()),
        can_succeed=float(np.concatenate(succeeded).sum() / max(tried.sum(), 1)),
        fails_by_day=route_not_localised(of_day),
        fails=route_not_localised(held_out),
    )


def month_laps(folder: Path, campaign: Campaign) -> list[Path]:
    """Where the laps' frame logs stand once they are rendered, in the order of time."""
    home = campaign_folder(folder, campaign)
    return [home / f"{plan.name}.framelog" for plan in campaign.sessions]


def month_table(
    folder: Path, campaign: Campaign, workers: int = 1, advance: Callable[[str], None] = ignore
) -> list[Row]:
    """Rows (d) and (f), from laps that are rendered below `folder` already."""
    laps = month_laps(folder, campaign)
    whole = measure_laps(laps, folder, workers, advance)
    early = measure_laps(laps[:_EARLY_LAPS], folder, workers, advance)
    return [
        Row("d", f"saved of {len(laps)} laps, four fifths mapped", 100 * whole.saved, 15, 30, "%"),
        Row("d", "candidates within 8 m after 20 laps", early.candidates, 40, np.inf, ""),
        Row("d", "of which can succeed", 100 * early.can_succeed, 0, 15, "%"),
        Row("f", "route failed, everything tried, by day", 100 * whole.fails_by_day, 3, 8, "%"),
        Row("f", "route failed, around the clock", 100 * whole.fails, 5, 15, "%"),
    ]
