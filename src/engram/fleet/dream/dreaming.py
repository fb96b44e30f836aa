"""Tries orders and behaviours of merging, and adds what the best of them has ([G16] §IV and §V).

The hand-ins are merged again, in other orders and with other behaviours, and each result is judged
by validation drives. The best one may improve the fleet map: what is missing from the fleet map
is added as one revision, if the drives then miss less of their route, beyond the interval of that
difference. Nothing is removed, so that all nodes that robots refer to stay.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from engram.config import check_bounds, config_hash, plain, to_dict
from engram.counts import counted
from engram.errors import ConfigError, InputError
from engram.files import draft_folder
from engram.fleet.build.best_order import results_in
from engram.fleet.build.orders import JudgeOptions, OrderResult, Orders
from engram.fleet.download.updating import UpdateReport, update
from engram.fleet.dream.judging import gain, localised_in
from engram.fleet.dream.trying import Try, try_all
from engram.fleet.merge.gate import check_held_out
from engram.fleet.merge.merging import merge
from engram.fleet.merge.settings import MergeOptions
from engram.fleet.merge.whole_segments import SeedFrom, Unit
from engram.maps import Map, copy_map
from engram.measures import Drive, Estimator, route_not_localised
from engram.monitor import QUIET, Monitor
from engram.robot import RobotOptions, Settings, open_drive

# What a dream changes of the way in which robots' maps are merged.
BEHAVIOURS: dict[str, dict[str, Any]] = {
    "as usual": {},
    "surer matches": {"sure_inliers": 80},
    "any match": {"sure_inliers": 0},
    "whole segments": {"unit": Unit.SEGMENT, "segment_share": 0.9},
    "by place": {"seed": SeedFrom.PLACES},
}
# More hand-ins are tried with each of them first only.
_ALL_ORDERS = 4
FEWEST_DRIVES = 3


@dataclass(frozen=True, slots=True)
class DreamOptions:
    """How a fleet map dreams.

    Attributes:
        minutes, judge_at_m, resamples, level, seed: see their descriptions.
        workers: processes that try behaviours, and judge the best result, side by side.
        scheduler: address of a Dask scheduler whose workers try instead.
        merging: how robots' maps are merged usually.
        localising: policy and budget of the validation.
        estimator: what orders are judged over.
    """

    minutes: Annotated[
        float | None, Meta(gt=0, description="time for trying, minutes; none: until all is tried")
    ] = None
    workers: Annotated[int, Meta(ge=1, description="processes")] = 1
    scheduler: str | None = None
    merging: MergeOptions = field(default_factory=MergeOptions)
    localising: RobotOptions = field(default_factory=RobotOptions)
    judge_at_m: Annotated[
        float, Meta(ge=0, description="m; the best order has the fewest longer gaps")
    ] = 10.0
    estimator: Estimator = Estimator.ROUTE
    resamples: Annotated[int, Meta(ge=1, description="draws of the drives")] = 2000
    level: Annotated[
        float, Meta(gt=0, lt=1, description="share of the draws within the interval")
    ] = 0.9
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(slots=True, eq=False)
class DreamReport:
    """Result of a dream.

    Attributes:
        centre: the fleet map.
        tried: results by behaviour; best order first.
        complete: whether everything was tried; otherwise the same command continues.
        behaviour, order: of the best result; order by numbers of the hand-ins.
        missed_before, missed_after: share of the validation drives' route without a match, in the
            fleet map and with what the best result adds.
        better_by: the difference with its interval (estimate, low, high).
        added: what was added; None if nothing was better.
        seconds: of this run.
    """

    centre: str
    tried: dict[str, list[OrderResult]] = field(default_factory=dict)
    complete: bool = False
    behaviour: str = ""
    order: tuple[int, ...] = ()
    missed_before: float = 0.0
    missed_after: float = 0.0
    better_by: tuple[float, float, float] = (0.0, 0.0, 0.0)
    added: UpdateReport | None = None
    seconds: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """What ``dream --json`` prints."""
        values: dict[str, Any] = plain(self)
        return values

    def text(self) -> str:
        """The report as text."""
        count = sum(map(len, self.tried.values()))
        head = f"{counted(count, 'map')} tried" + (
            "" if self.complete else "; the same command tries more"
        )
        if not count:
            return head
        estimate, low, high = (100 * one for one in self.better_by)
        lines = [
            head,
            f"best: {self.behaviour}, order {' '.join(map(str, self.order))}; route not localised "
            f"{self.missed_before:.2%} → {self.missed_after:.2%}, better by {estimate:.2f} points "
            f"({low:.2f} … {high:.2f})",
        ]
        if self.added is None:
            lines.append("not better beyond its interval: the fleet map is unchanged")
        else:
            lines.append(
                f"revision {self.added.revision}: {counted(self.added.nodes, 'node')} added"
            )
        return "\n".join(lines)


def dream(
    centre: Path,
    handed: Sequence[Path],
    drives: Sequence[Path],
    settings: Settings | None = None,
    options: DreamOptions | None = None,
    monitor: Monitor = QUIET,
) -> DreamReport:
    """Looks for a better map in what robots handed in; adds it to the fleet map if it is better.

    Results are kept in FLEET.dream: a dream that was stopped or killed continues, and comes to the
    same result. They are removed once everything has been tried.

    Args:
        centre: the fleet map.
        handed: robots' maps as they were handed in, oldest first (`hand_ins_of`).
        drives: validation drives, in none of the maps.
        settings: of the localiser; None for the defaults.
        options: time, behaviours' base, judgement.
        monitor: receives progress; its `check` is called between two merges.

    Raises:
        ConfigError: there are too few drives, or one is not held out.
        InputError: nothing was handed in.
        MapError: a map cannot be read or written. The fleet map is unchanged.
        KeyboardInterrupt: it was interrupted; what was tried is kept.
    """
    options, settings = options or DreamOptions(), settings or Settings()
    _check(centre, handed, drives)
    started, report = time.perf_counter(), DreamReport(str(centre))
    judge = JudgeOptions(
        list(drives),
        judge_at_m=options.judge_at_m,
        localising=options.localising,
        orders=Orders.ALL if len(handed) <= _ALL_ORDERS else Orders.FIRST,
        estimator=options.estimator,
    )
    asked = _Dream(centre, handed, judge, settings, options)
    folder = asked.folder()
    folder.mkdir(parents=True, exist_ok=True)
    report.complete = asked.try_behaviours(report, folder, monitor)
    results = [(one.rank, name, one) for name, found in report.tried.items() for one in found]
    if results:
        _, report.behaviour, best = min(results, key=lambda one: one[:2])
        report.order = best.order
        asked.add_best(report, monitor)
    if report.complete:
        shutil.rmtree(folder.parent, ignore_errors=True)
    report.seconds = time.perf_counter() - started
    return report


def _check(centre: Path, handed: Sequence[Path], drives: Sequence[Path]) -> None:
    if not handed:
        raise InputError(
            f"{centre}: nothing was handed in; merge with engram merge --keep, or name maps"
        )
    if len(drives) < FEWEST_DRIVES:
        raise ConfigError(
            f"{len(drives)} validation drives are too few to rule out chance: give at least "
            f"{FEWEST_DRIVES} with --validate"
        )
    with Map.open(centre) as store:
        named = [(path, open_drive(path)) for path in drives]
        check_held_out(named, store.sessions.values(), centre, "--validate")


@dataclass(frozen=True, slots=True)
class _Dream:
    """Inputs of a dream; see `dream`, and `find_best_order` for `judge`."""

    centre: Path
    handed: Sequence[Path]
    judge: JudgeOptions
    settings: Settings
    options: DreamOptions

    def folder(self) -> Path:
        """Folder of the results of exactly these inputs."""
        hashes = []
        for path in self.handed:
            with Map.open(path) as store:
                hashes.append(store.content_hash())
        settings, merging = to_dict(self.settings), to_dict(self.options.merging)
        inputs = config_hash([hashes, self.judge.hash(), settings, merging])
        return self.centre.with_name(f"{self.centre.name}.dream") / inputs

    def try_behaviours(self, report: DreamReport, folder: Path, monitor: Monitor) -> bool:
        """Tries behaviours, until the time is over; whether all were tried."""
        options = self.options
        end_s = None if options.minutes is None else time.time() + 60 * options.minutes
        places = {name: folder / name.replace(" ", "-") for name in BEHAVIOURS}
        asked = {
            name: Try(place, self.handed, self.judge, self.settings, self._merging(name), end_s)
            for name, place in places.items()
        }
        complete = try_all(asked, options.workers, options.scheduler, monitor)
        for name, place in places.items():
            if found := results_in(place):
                report.tried[name] = found
        return complete

    def add_best(self, report: DreamReport, monitor: Monitor) -> None:
        """Makes the best map again, and adds what it has if that is better."""
        centre, merging = self.centre, self._merging(report.behaviour)
        first, *others = (self.handed[at] for at in report.order)
        with draft_folder(centre) as folder:
            dreamt, joined = folder / "dreamt.engram", folder / "joined.engram"
            copy_map(first, dreamt)
            for robot in others:
                (merged,) = merge(dreamt, [robot], merging, monitor, settings=self.settings)
                if merged.interrupted:
                    raise KeyboardInterrupt
            copy_map(centre, joined)
            about = f"dream: {report.behaviour}, order {' '.join(map(str, report.order))}"
            update(dreamt, joined, monitor=monitor, message=about)
            before, after = self._judged([centre, joined], monitor)
            report.missed_before, report.missed_after = map(route_not_localised, (before, after))
            options = self.options
            report.better_by = gain(
                before, after, resamples=options.resamples, level=options.level, seed=options.seed
            )
            if report.better_by[1] > 0:
                report.added = update(dreamt, centre, monitor=monitor, message=about)

    def _merging(self, behaviour: str) -> MergeOptions:
        return replace(self.options.merging, **BEHAVIOURS[behaviour])

    def _judged(self, maps: Sequence[Path], monitor: Monitor) -> list[list[Drive]]:
        options = self.options
        return localised_in(
            maps, self.judge.drives, self.settings, options.localising, options.workers, monitor
        )
