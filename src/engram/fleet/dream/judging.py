"""What validation drives miss in maps, and by how much one map is better than another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engram.maps import Map
from engram.measures import Drive
from engram.monitor import Monitor
from engram.processes import run_in_processes
from engram.robot import RobotOptions, Settings, measure, open_drive


@dataclass(frozen=True, slots=True)
class _Judgement:
    """One drive in one map, which is not changed."""

    centre: Path
    drive: Path
    settings: Settings
    localising: RobotOptions


def localised_in(
    maps: Sequence[Path],
    drives: Sequence[Path],
    settings: Settings,
    localising: RobotOptions,
    workers: int,
    monitor: Monitor,
) -> list[list[Drive]]:
    """Localises each drive in each map.

    Args:
        maps, drives: by number.
        settings, localising: of the localiser; policy and budget.
        workers: processes, a drive in a map each; with one, all is done here.
        monitor: receives progress, a step for each drive in each map, and may stop it.

    Returns:
        For each map, the results of the drives, in their order.

    Raises:
        KeyboardInterrupt: the monitor stopped it.
        WorkerError: a worker died repeatedly.
        EngramError: a map or a drive cannot be read.
    """
    asked = {
        f"drive {at + 1} in {centre}": _Judgement(centre, drive, settings, localising)
        for centre in maps
        for at, drive in enumerate(drives)
    }
    found: dict[str, Drive] = {}
    with monitor.stage("judge", len(asked)) as stage:
        if workers == 1:
            for name, one in asked.items():
                stage.check()
                found[name] = _localised(one, stage)
        else:
            run_in_processes(
                _localised, asked, workers, stage, lambda name, one, _: found.update({name: one})
            )
    every = [found[name] for name in asked]
    return [every[at : at + len(drives)] for at in range(0, len(every), len(drives))]


def _localised(one: _Judgement, monitor: Monitor) -> Drive:
    with Map.open(one.centre) as store:
        drive = measure(store, open_drive(one.drive), one.settings, one.localising)
    monitor.advance(one.drive.stem)
    return drive


def gain(
    before: Sequence[Drive], after: Sequence[Drive], *, resamples: int, level: float, seed: int
) -> tuple[float, float, float]:
    """By how much less of the route is missed, and the ends of its interval, paired over drives."""
    missed_m = np.array(
        [[float(one.step_m[~one.matched].sum()) for one in drives] for drives in (before, after)]
    )
    driven_m = np.array([float(one.step_m.sum()) for one in before])
    spared_m = missed_m[0] - missed_m[1]
    rng = np.random.default_rng(seed)
    count = len(driven_m)
    draws = rng.multinomial(count, np.full(count, 1 / count), resamples)
    values = draws @ spared_m / (draws @ driven_m)
    tail = 50 * (1 - level)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(spared_m.sum() / driven_m.sum()), float(low), float(high)
