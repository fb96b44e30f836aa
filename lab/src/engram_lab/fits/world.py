"""How hard the simulated town is; what its knobs were set by.

    python -m engram_lab.fits.world                     # rows (a) to (c), (e): 3 to 5 minutes
    python -m engram_lab.fits.world --laps /tmp/month   # and (d), (f): half an hour; resumable

Rows (a) to (c) look at two towns that the knobs were not set on, (e) at the clip KITTI 06 under
$ENGRAM_DATA. Rows (d) and (f) map a month of 40 laps of 0.15 km and localise held-out laps.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from engram.cli.screen import Bars
from engram.errors import SequenceError
from engram.frontend.frame import StereoPair
from engram.geometry.se3 import SE3
from engram.measures import Drive, route_not_localised
from engram.monitor import QUIET, Monitor
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.opening import open_drive
from engram_lab.fits.calibration import (
    CLIP_FRAMES,
    CLIP_SPACING_M,
    CLIP_STEPS,
    UNSEEN_TOWNS,
    Appearance,
    Row,
    appearance,
    appearance_table,
    falloff,
    falloff_table,
    world_hash,
)
from engram_lab.programs import Figure, command_line, report
from engram_lab.studies.configurations import UNLIMITED, Configuration
from engram_lab.studies.drives import DriveSet, campaign_logs, drives_of
from engram_lab.studies.lockstep import read_runs
from engram_lab.studies.running import Plan, RankingOptions, built_map, make_plan, run
from engram_lab.town.campaigns import Campaign, Size, by_day, campaign_named
from engram_lab.town.rendering import LOOP_M, VISITS, Places
from engram_lab.town.session import SimulatedDrive
from engram_lab.town.simulating import simulate

LAPS = 40
# The laps whose five folds leave 20 to build from.
_EARLY_LAPS = 25
_EVERYTHING = Configuration("distance", UNLIMITED)
# Counts only, more of them than there are candidates, one after another: the first success ends it.
_EXHAUSTIVE = RobotOptions(ranking="distance", lanes=1, rounds=UNLIMITED, relocaliser="fabmap")
# Of `village`: a clear morning, where its road runs straight between houses, as on the clip.
_SESSION, _FIRST_FRAME = 1, 60


def looks(monitor: Monitor = QUIET) -> list[Row]:
    """Rows (a) to (c), and (e) where the clip is at hand."""
    seen = []
    for seed in UNSEEN_TOWNS:
        with monitor.stage(f"town {seed}", len(VISITS)) as part:
            seen.append(appearance(Places(seed), monitor=part))
    rows = appearance_table(Appearance.pooled(seen))
    clip = load_clip()
    if clip is not None:
        rows += falloff_table(falloff(town_like_clip(), CLIP_STEPS), falloff(clip, CLIP_STEPS))
    return rows


def load_clip() -> list[tuple[SE3, StereoPair]] | None:
    """KITTI 06, frames 0 to 50, with true poses; None where ``$ENGRAM_DATA`` has it not."""
    root = os.environ.get("ENGRAM_DATA")
    odometry = Path(root or "") / "kitti_odometry"
    clip, truth = odometry / "sequences" / "06", odometry / "poses" / "06.txt"
    if not root or not clip.is_dir() or not truth.is_file():
        return None
    poses = [SE3.from_matrix(row.reshape(3, 4)) for row in np.loadtxt(truth)]
    pairs = [pair for pair in open_drive(clip) if isinstance(pair, StereoPair)]
    return list(zip(poses, pairs, strict=False))[:CLIP_FRAMES]


def town_like_clip() -> list[tuple[SE3, StereoPair]]:
    """As many frames of the town by KITTI's camera, at the clip's spacing."""
    village = campaign_named("village")
    plan = replace(village.session(_SESSION), robot="kitti")
    sessions = (*village.sessions[:_SESSION], plan, *village.sessions[_SESSION + 1 :])
    drive = SimulatedDrive(replace(village, sessions=sessions, spacing_m=CLIP_SPACING_M), _SESSION)
    last = _FIRST_FRAME + CLIP_FRAMES
    poses = drive.world_from_cams()[_FIRST_FRAME:last]
    return list(zip(poses, drive.frames(_FIRST_FRAME, last), strict=True))


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
    laps: Sequence[Path], work: Path, workers: int = 1, monitor: Monitor = QUIET
) -> MonthResult:
    """Five folds over some laps, everything attempted; continues where an earlier run stopped.

    Args:
        laps: their frame logs, with truth.
        work: folder for maps and results.
        workers: processes.
        monitor: hears of each map and each lap.

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


def laps_table(folder: Path, seed: int, workers: int, monitor: Monitor) -> list[Row]:
    """Rows (d) and (f); renders the laps that are not there yet."""
    campaign = month(seed)
    simulate(campaign, folder, workers=workers, monitor=monitor)
    laps = campaign_logs(campaign, folder)
    whole = measure_laps(laps, folder, workers, monitor)
    early = measure_laps(laps[:_EARLY_LAPS], folder, workers, monitor)
    return [
        Row("d", f"saved of {len(laps)} laps, four fifths mapped", 100 * whole.saved, 15, 30, "%"),
        Row("d", "candidates within 8 m after 20 laps", early.candidates, 40, np.inf, ""),
        Row("d", "of which can succeed", 100 * early.can_succeed, 0, 15, "%"),
        Row("f", "route failed, everything tried, by day", 100 * whole.fails_by_day, 3, 8, "%"),
        Row("f", "route failed, around the clock", 100 * whole.fails, 5, 15, "%"),
    ]


def main() -> None:
    """Reads the command line."""
    parser = command_line(__doc__)
    parser.add_argument("--laps", type=Path, metavar="DIR", help="also (d), (f); laps kept here")
    parser.add_argument("--seed", type=int, default=1, help="of the town of the laps")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    asked = parser.parse_args()
    rows = looks(Bars())
    if asked.laps is not None:
        rows += laps_table(asked.laps, asked.seed, asked.workers, Bars())
    print("\n".join(row.text() for row in rows))
    figures = [Figure(f"{row.letter}: {row.what}", row.value, row.unit) for row in rows]
    report(figures, asked.json, f"world {world_hash()}")


if __name__ == "__main__":
    main()
