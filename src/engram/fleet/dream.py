"""Dreaming: between forays the centre looks for a better map in what robots handed in.

The hand-ins are merged again, in other orders and with other behaviours, and each result is judged
by validation drives. The best one may improve the fleet map: what is missing from the fleet map
is added as one revision, if the drives then miss less of their route, beyond the interval of that
difference. Nothing is removed, so that all nodes that robots refer to stay.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from engram.config import check_bounds, config_hash, plain, to_dict
from engram.counts import counted
from engram.errors import ConfigError, InputError
from engram.files import draft_folder
from engram.fleet.build.building import find_best_order, results_in
from engram.fleet.build.cluster import run_on_cluster
from engram.fleet.build.orders import JudgeOptions, OrderResult, Orders
from engram.fleet.download.updating import UpdateReport, update
from engram.fleet.merge.gate import check_held_out
from engram.fleet.merge.merge_settings import MergeOptions, SeedFrom, Unit
from engram.fleet.merge.merging import merge
from engram.maps.map import Map
from engram.maps.map_files import copy_map, publish_map
from engram.measures import Drive, Estimator, route_not_localised
from engram.monitor import QUIET, Monitor, Relay, write_whole
from engram.processes import run_in_processes
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measure
from engram.sequences.opening import open_drive


@dataclass(frozen=True, slots=True)
class Try:
    """One method of merging, to be tried in all orders.

    Attributes:
        place: folder of its results; what is there already is not tried again.
        judge, settings, merging: see `find_best_order`.
        end_s: `time.time` at which trying ends; None: when all is tried.
    """

    place: Path
    handed: Sequence[Path]
    judge: JudgeOptions
    settings: Settings
    merging: MergeOptions
    end_s: float | None

    def count(self) -> int:
        """Number of orders."""
        return self.judge.orders.of(len(self.handed))


class _Deadline:
    """Stops work at a time, `time.time`; `over` says that it did."""

    def __init__(self, end_s: float | None) -> None:
        self._end_s = end_s
        self.over = False

    def check(self) -> None:
        if self._end_s is not None and time.time() >= self._end_s:
            self.over = True
            raise KeyboardInterrupt


def try_orders(asked: Try, monitor: Monitor) -> bool:
    """Tries the orders of one method of merging; whether it came to the end."""
    deadline = _Deadline(asked.end_s)
    watched = Relay(monitor, deadline.check)
    try:
        watched.check()
        find_best_order(
            asked.handed, asked.place, asked.settings, asked.merging, asked.judge, watched
        )
    except KeyboardInterrupt:
        if not deadline.over:
            raise
    return not deadline.over


def try_all(
    asked: Mapping[str, Try], workers: int, scheduler: str | None, monitor: Monitor
) -> bool:
    """Tries all ways of merging; whether all came to the end.

    Args:
        workers: processes on this machine; with one, all is tried here.
        scheduler: address of a Dask scheduler, whose workers try instead; they read the validation
            drives themselves, and get the maps over the network.
        monitor: receives progress per order, and may stop it.
    """
    if scheduler is None and workers == 1:
        return all(try_orders(task, monitor) for task in asked.values())
    ended: list[bool] = []
    with monitor.stage("try orders", sum(task.count() for task in asked.values())) as stage:
        if scheduler is not None:
            _on_cluster(asked, scheduler, stage, ended.append)
        else:
            run_in_processes(
                try_orders, asked, workers, stage, lambda _, end, __: ended.append(end)
            )
    return all(ended)


@dataclass(frozen=True, slots=True)
class _FarTry:
    """A `Try` for a machine that shares no disk with this one, with its maps and results so far."""

    asked: Try
    maps: Sequence[bytes]
    results: Mapping[str, bytes]


def _on_cluster(
    asked: Mapping[str, Try], scheduler: str, monitor: Monitor, ended: Callable[[bool], None]
) -> None:
    maps = _whole_maps(next(iter(asked.values())).handed)
    tasks = {name: _FarTry(task, maps, _results_in(task.place)) for name, task in asked.items()}

    def done(name: str, made: tuple[bool, Mapping[str, bytes]]) -> None:
        end, results = made
        _write_results(asked[name].place, results)
        ended(end)

    run_on_cluster(_try_far_away, tasks, scheduler, monitor, done)


def _try_far_away(far: _FarTry, monitor: Monitor) -> tuple[bool, Mapping[str, bytes]]:
    """Runs in a worker of the cluster; returns whether it came to the end, and all results."""
    with tempfile.TemporaryDirectory(prefix="engram-dream-") as folder:
        handed = [Path(folder) / f"{number}.engram" for number in range(len(far.maps))]
        for path, content in zip(handed, far.maps, strict=True):
            path.write_bytes(content)
        place = Path(folder) / "results"
        _write_results(place, far.results)
        ended = try_orders(replace(far.asked, place=place, handed=handed), monitor)
        return ended, _results_in(place)


def _whole_maps(paths: Sequence[Path]) -> list[bytes]:
    """The maps' files, without a write-ahead log next to them."""
    with tempfile.TemporaryDirectory(prefix="engram-dream-") as folder:
        made = []
        for number, path in enumerate(paths):
            copy = Path(folder) / f"{number}.engram"
            copy_map(path, copy)
            made.append(copy.read_bytes())
    return made


def _results_in(place: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(place.glob("order-*.json"))}


def _write_results(place: Path, results: Mapping[str, bytes]) -> None:
    place.mkdir(parents=True, exist_ok=True)
    for name, content in results.items():
        with write_whole(place / name) as draft:
            draft.write_bytes(content)


@dataclass(frozen=True, slots=True)
class _Judgement:
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
        workers: processes, a drive in a map each; with one, all is done here.
        monitor: receives progress, a step for each drive in each map, and may stop it.

    Returns:
        For each map, the results of the drives, in their order.
    """
    asked = {
        f"drive {at + 1} in {centre}": _Judgement(centre, drive, settings, localising)
        for centre in maps
        for at, drive in enumerate(drives)
    }
    localised: dict[str, Drive] = {}
    with monitor.stage("judge", len(asked)) as stage:
        if workers == 1:
            for name, judgement in asked.items():
                stage.check()
                localised[name] = _localised(judgement, stage)
        else:
            run_in_processes(
                _localised,
                asked,
                workers,
                stage,
                lambda name, drive, _: localised.update({name: drive}),
            )
    every = [localised[name] for name in asked]
    return [every[at : at + len(drives)] for at in range(0, len(every), len(drives))]


def _localised(judgement: _Judgement, monitor: Monitor) -> Drive:
    with Map.open(judgement.centre) as store:
        drive = measure(
            store, open_drive(judgement.drive), judgement.settings, judgement.localising
        )
    monitor.advance(judgement.drive.stem)
    return drive


def gain(
    before: Sequence[Drive], after: Sequence[Drive], *, resamples: int, level: float, seed: int
) -> tuple[float, float, float]:
    """By how much less of the route is missed, and the ends of its interval, paired over drives."""
    missed_m = np.array(
        [
            [float(drive.step_m[~drive.matched].sum()) for drive in drives]
            for drives in (before, after)
        ]
    )
    driven_m = np.array([float(localised.step_m.sum()) for localised in before])
    spared_m = missed_m[0] - missed_m[1]
    rng = np.random.default_rng(seed)
    count = len(driven_m)
    draws = rng.multinomial(count, np.full(count, 1 / count), resamples)
    values = draws @ spared_m / (draws @ driven_m)
    tail = 50 * (1 - level)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(spared_m.sum() / driven_m.sum()), float(low), float(high)


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
        workers: processes that try behaviours, and judge the best result, side by side.
        scheduler: address of a Dask scheduler whose workers try instead.
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
        complete: whether everything was tried; otherwise the same command continues.
        behaviour, order: of the best result; order by numbers of the hand-ins.
        missed_before, missed_after: share of the validation drives' route without a match, in the
            fleet map and with what the best result adds.
        better_by: the difference with its interval (estimate, low, high).
        added: what was added; None if nothing was better.
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
        estimate, low, high = (100 * share for share in self.better_by)
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
        handed: robots' maps as they were handed in, oldest first (`hand_ins_of`).
        settings: of the localiser; None for the defaults.
        monitor: receives progress; its `check` is called between two merges.
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
    results = [
        (result.rank, name, result) for name, tried in report.tried.items() for result in tried
    ]
    if results:
        _, report.behaviour, best = min(results, key=lambda ranked: ranked[:2])
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
            if results := results_in(place):
                report.tried[name] = results
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


def hand_ins_folder(centre: Path) -> Path:
    """The folder of a fleet map's hand-ins."""
    return centre.with_name(f"{centre.name}.handed")


def hand_ins_of(centre: Path) -> list[Path]:
    """The kept hand-ins, in the order in which they came."""
    return sorted(hand_ins_folder(centre).glob("*.engram"))


def keep_hand_in(centre: Path, robot: Path) -> Path:
    """Keeps a copy of a robot's map; one of the same content is kept once.

    Returns:
        The kept copy, NUMBER-CONTENT.engram.
    """
    with Map.open(robot) as store:
        content = store.content_hash()
    known = hand_ins_of(centre)
    for path in known:
        if path.stem.endswith(content):
            return path
    folder = hand_ins_folder(centre)
    folder.mkdir(exist_ok=True)
    last = max((int(path.stem.split("-")[0]) for path in known), default=0)
    kept = folder / f"{last + 1:06d}-{content}.engram"
    with draft_folder(kept) as drafts:
        copy_map(robot, drafts / kept.name)
        publish_map(drafts / kept.name, kept)
    return kept
