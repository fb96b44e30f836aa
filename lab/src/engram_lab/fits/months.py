"""What a month of drives in the town costs and gains: reported, no bound is set by it.

    python -m engram_lab.fits.months DIR     # half an hour; laps are kept in DIR, and it resumes

A month of 40 laps of 0.15 km is rendered and mapped, and held-out laps are localised with all that
is allowed. How hard the town is follows from other people's roads (`engram_lab.roads`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from engram.cli.screen import Bars
from engram.errors import SequenceError
from engram.measures import Drive, route_not_localised
from engram.monitor import QUIET, Monitor
from engram.robot.settings import RobotOptions, Settings
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.configurations import UNLIMITED, Configuration
from engram_lab.studies.drives import DriveSet, campaign_logs, drives_of
from engram_lab.studies.lockstep import read_runs
from engram_lab.studies.running import Plan, RankingOptions, built_map, make_plan, run
from engram_lab.town.campaigns import WORLD_VERSION, Campaign, Size, by_day, campaign_named
from engram_lab.town.rendering import LOOP_M
from engram_lab.town.simulating import simulate

LAPS = 40
# The laps whose five folds leave 20 to build from.
_EARLY_LAPS = 25
_EVERYTHING = Configuration("distance", UNLIMITED)
# Counts only, more of them than there are candidates, one after another: the first success ends it.
_EXHAUSTIVE = RobotOptions(ranking="distance", lanes=1, rounds=UNLIMITED, relocaliser="fabmap")


def month(seed: int = 1, laps: int = LAPS) -> Campaign:
    """`begbroke24h` in small: a loop of 0.15 km and some of its 140 laps.

    A systematic sample of the laps in the order of weather and hour, so that few laps meet all
    hours and every weather in its share.
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
        can_succeed: share of these that match it.
        fails_by_day: share of the route of held-out laps between 7 and 19 h without a match.
    """

    saved: float
    candidates: float
    can_succeed: float
    fails_by_day: float
    fails: float


def measure_laps(
    laps: Sequence[Path], work: Path, workers: int = 1, monitor: Monitor = QUIET
) -> MonthResult:
    """Five folds over some laps, everything attempted; continues where an earlier run stopped."""
    missing = [path for path in laps if not path.exists()]
    if missing:
        raise SequenceError(f"{len(missing)} laps are not rendered; the first is {missing[0]}")
    options = RankingOptions(
        ("distance",), (UNLIMITED,), (1,), map_sizes=False, live_folds=0, build=_EXHAUSTIVE
    )
    drives = DriveSet(f"month-{len(laps)}", drives_of(laps))
    plan = make_plan(drives, Settings(), options, work)
    run(plan, workers, monitor)
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


def figures(folder: Path, seed: int, workers: int, monitor: Monitor) -> Iterator[Figure]:
    """Of a town's month; renders the laps that are not there yet."""
    campaign = month(seed)
    simulate(campaign, folder, workers=workers, monitor=monitor)
    laps = campaign_logs(campaign, folder)
    whole = measure_laps(laps, folder, workers, monitor)
    early = measure_laps(laps[:_EARLY_LAPS], folder, workers, monitor)
    yield Figure(f"saved of {len(laps)} laps, four fifths mapped", 100 * whole.saved, "%")
    yield Figure("candidates within 8 m after 20 laps", early.candidates)
    yield Figure("of which can succeed", 100 * early.can_succeed, "%")
    yield Figure("route failed, everything tried, by day", 100 * whole.fails_by_day, "%")
    yield Figure("route failed, around the clock", 100 * whole.fails, "%")


def main() -> None:
    """Command line."""
    parser = command_line(__doc__)
    parser.add_argument("laps", type=Path, metavar="DIR", help="the laps are kept here")
    parser.add_argument("--seed", type=int, default=1, help="of the town of the laps")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    asked = parser.parse_args()
    rows = figures(asked.laps, asked.seed, asked.workers, Bars())
    report(rows, asked.json, f"world {WORLD_VERSION}, town {asked.seed}")


if __name__ == "__main__":
    main()
