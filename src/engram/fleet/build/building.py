"""Building a map in parallel: groups are mapped side by side, then merged in turn (method §7).

The best order of merging k groups: all k! orders over a prefix tree ([G16] §VI-E, method §7). Or
only the choice of the first group, which has the largest effect (lab/reports/fleet.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath
from random import Random
from typing import Any
from uuid import UUID

import numpy as np

from engram.config import config_hash, plain, to_dict
from engram.counts import counted
from engram.errors import ConfigError, MapError
from engram.files import check_parent, remove_left_drafts
from engram.fleet.build.cluster import check_scheduler, map_groups_on_cluster
from engram.fleet.build.orders import (
    BestOrder,
    JudgeOptions,
    OrderResult,
    Orders,
    Spent,
    check_countable,
    check_held_out,
    order_costs,
)
from engram.fleet.build.scratch import (
    BuildPlan,
    GroupResult,
    GroupTask,
    MergingBegun,
    Scratch,
    fetched,
    keeping,
    map_group,
    read_kept,
    sole_builder,
    write_kept,
)
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.fleet.merge.report import MergeReport
from engram.graph.clock import hour_of_day
from engram.graph.model import Session, SessionId, path_id
from engram.maps.map import Map
from engram.maps.map_files import copy_map
from engram.measures import failure, route_not_localised
from engram.monitor import QUIET, Monitor, interruptible
from engram.processes import run_in_processes
from engram.robot.localisers import session_of_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measure
from engram.sequences.opening import open_drive


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive to be mapped.

    Attributes:
        source: path or URL of its frame log or images.
    """

    source: str
    session: Session
    frames: int

    @property
    def name(self) -> str:
        """Its name in a file of groups."""
        return PurePosixPath(self.source.rstrip("/")).name


def look_at_drive(path: Path, source: str) -> Drive:
    """Reads what grouping needs of a drive."""
    sequence = open_drive(path)
    return Drive(source, session_of_drive(sequence), len(sequence))


def group_drives(
    drives: Sequence[Drive],
    grouping: str,
    groups: int,
    seed: int,
    leave_out: Collection[SessionId] = (),
) -> list[list[Drive]]:
    """Groups of drives, each in chronological order; none is empty.

    Args:
        grouping: key of `GROUPINGS`, or path of a file of groups (`read_groups`).
        seed: of `random`.
        leave_out: sessions to leave out; if fewer drives than groups remain, each is a group.
    """
    known = {drive.session.id for drive in drives}
    if len(known) < len(drives):
        raise ConfigError("a drive is given twice; give each once")
    wanted = [drive for drive in drives if drive.session.id not in leave_out]
    if grouping not in GROUPINGS:
        named = read_groups(Path(grouping), drives)
        grouped = [[drive for drive in group if drive in wanted] for group in named]
        return [_chronological(group) for group in grouped if group]
    if not 1 <= groups <= len(drives):
        raise ConfigError(f"{groups} groups of {len(drives)} drives: must be 1 to {len(drives)}")
    if not wanted:
        return []
    ordered = GROUPINGS[grouping](_chronological(wanted), seed)
    return [_chronological(group) for group in _split(ordered, min(groups, len(wanted)))]


def read_groups(path: Path, drives: Sequence[Drive]) -> list[list[Drive]]:
    """Groups from a text file: one a line, the names of its drives between spaces; # comments."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"grouping {str(path)!r} is not one of {', '.join(GROUPINGS)}, and cannot be read as a "
            f"file of groups: {error}"
        ) from error
    named = [words for line in lines if (words := line.split("#")[0].split())]
    by_name = {drive.name: drive for drive in drives}
    names = [name for group in named for name in group]
    if len(by_name) < len(drives):
        raise ConfigError("a file of groups needs drives with different file names; two are alike")
    if sorted(names) != sorted(by_name):
        missing, strange = sorted(set(by_name) - set(names)), sorted(set(names) - set(by_name))
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ConfigError(
            f"{path}: every drive must be named once; missing {missing}, unknown {strange}, "
            f"twice {twice}"
        )
    return [[by_name[name] for name in group] for group in named]


def _chronological(drives: Sequence[Drive], seed: int = 0) -> list[Drive]:
    del seed
    return sorted(drives, key=lambda drive: (drive.session.start_ns, drive.session.id))


def _random(drives: Sequence[Drive], seed: int) -> list[Drive]:
    shuffled = list(drives)
    Random(seed).shuffle(shuffled)
    return shuffled


def _by_condition(drives: Sequence[Drive], seed: int) -> list[Drive]:
    """By light: distance from noon, so that morning and evening are alike (method §2.8)."""
    del seed
    hours = [hour_of_day(drive.session, drive.session.start_ns) for drive in drives]
    unknown = [drive.name for drive, hour in zip(drives, hours, strict=True) if hour is None]
    if unknown:
        raise ConfigError(
            f"grouping by condition needs the hour of day, which is unknown for {unknown}: give "
            "the groups in a file instead"
        )
    from_noon = {
        drive.session.id: abs(12 - (hour or 0.0)) for drive, hour in zip(drives, hours, strict=True)
    }
    return sorted(drives, key=lambda drive: from_noon[drive.session.id])


def _split(ordered: Sequence[Drive], groups: int) -> list[list[Drive]]:
    size, larger = divmod(len(ordered), groups)
    borders = [0]
    for number in range(groups):
        borders.append(borders[-1] + size + (number < larger))
    return [list(ordered[a:b]) for a, b in pairwise(borders)]


GROUPINGS: dict[str, Callable[[Sequence[Drive], int], list[Drive]]] = {
    "chronological": _chronological,
    "random": _random,
    "by-condition": _by_condition,
}


# [G16] §VI-E compares whole curves; the area up to here breaks ties at the judging distance.
_AREA_TO_M = 50.0
_AREA_STEP_M = 0.5
_SPREAD_AT_M = (5.0, 10.0, 20.0)
_REPORTED_AT_M = np.arange(0.0, _AREA_TO_M + _AREA_STEP_M / 2, _AREA_STEP_M)


def find_best_order(
    maps: Sequence[Path],
    folder: Path,
    settings: Settings,
    merging: MergeOptions,
    judge: JudgeOptions,
    monitor: Monitor,
    *,
    root: Path | None = None,
) -> BestOrder:
    """Merges groups in every order, or with each of them first, and judges the results.

    Merges of a common prefix are made once and copied: k! orders of k groups take
    Σ k!/(k−d)! over d = 2 … k merges, 60 for k = 4; with a root over d = 1 … k, 64. The search
    walks the tree depth first and keeps at most k maps on the disk. Results are stored with
    all that they depend on, so an interrupted search continues.

    Args:
        monitor: receives progress per order.
        root: the map that all orders begin with; None if each begins with its first group's.
    """
    check_countable(len(maps), judge.orders)
    with keeping(folder):
        folder.mkdir(parents=True, exist_ok=True)
    search = _Search(maps, folder, settings, merging, judge, root)
    with monitor.stage("try orders", judge.orders.of(len(maps))) as stage:
        search.below((), root, stage)
    search.check_root()
    search.found.results.sort(key=lambda result: result.rank)
    return search.found


def results_in(folder: Path) -> list[OrderResult]:
    """Results of earlier searches in a folder, best first; all must have the same inputs."""
    results = []
    for path in sorted(folder.glob("order-*.json")):
        try:
            step = read_kept(path, _Step)
        except ConfigError:  # partial, after a power cut
            continue
        if step.result is not None:
            results.append(step.result)
    return sorted(results, key=lambda result: result.rank)


@dataclass(frozen=True, slots=True)
class _Step:
    """One node of the prefix tree: its map was made, and judged if it has all groups.

    Attributes:
        depends: hash of all inputs of its map and its judgement.
    """

    depends: str
    order: tuple[int, ...]
    spent: Spent
    result: OrderResult | None


class _Search:
    def __init__(
        self,
        maps: Sequence[Path],
        folder: Path,
        settings: Settings,
        merging: MergeOptions,
        judge: JudgeOptions,
        root: Path | None,
    ) -> None:
        self.found = BestOrder(
            [], judge.judge_at_m, judge.orders, root is not None, estimator=judge.estimator
        )
        self._maps = maps
        self._folder = folder
        self._settings = settings
        self._merging = merging
        self._judge = judge
        self._root = root
        self._localise = judge.localise or measure
        mapped: list[tuple[Session, str]] = []
        hashes = []
        for path in (*maps, *([] if root is None else [root])):
            with Map.open(path) as store:
                mapped += [(session, f"in {path}") for session in store.sessions.values()]
                hashes.append(store.content_hash())
        check_held_out(judge, mapped)
        self._root_hash = None if root is None else hashes[-1]
        self._depends = config_hash(
            [hashes, self._root_hash, to_dict(settings), to_dict(merging), judge.hash()]
        )
        self._sequences = [open_drive(path) for path in judge.drives]
        self._reported = [open_drive(path) for path in judge.reported]
        with keeping(folder):
            remove_left_drafts(folder, "order-*")
            for left in folder.glob("order-*.engram*"):
                left.unlink()  # left by a killed run

    def below(self, prefix: tuple[int, ...], merged: Path | None, monitor: Monitor) -> None:
        """Tries all orders with this prefix; `merged` is the map of the prefix."""
        for number in self._judge.orders.following(prefix, len(self._maps)):
            order = (*prefix, number)
            if (known := self._known_from(order)) is not None:
                for step in known:
                    self._count(step, monitor)
                continue
            monitor.check()
            with _Intermediate(self._folder, order) as place:
                step = self._step(order, place, merged)
                write_kept(self._path(step.order), step)
                self._count(step, monitor)
                self.below(order, place, monitor)

    def check_root(self) -> None:
        """Checks that the judged maps are those that merging would give now."""
        if self._root is None:
            return
        with Map.open(self._root) as store:
            if store.content_hash() != self._root_hash:
                raise MapError(
                    f"{self._root} changed while orders of merging were tried, so the results no "
                    "longer apply; run the same command again"
                )

    def _step(self, order: tuple[int, ...], place: Path, prefix: Path | None) -> _Step:
        """The map of an order: a copy of its prefix's, and one more group."""
        started = time.perf_counter()
        added = self._maps[order[-1]]
        copy_map(added if prefix is None else prefix, place)
        costs: dict[str, Any] = {"copies": 1, "copy_s": time.perf_counter() - started}
        if prefix is not None:
            costs |= self._merge(place, added)
        result = None
        if len(order) == len(self._maps):
            started = time.perf_counter()
            result = self._judged(order, place)
            costs["judge_s"] = time.perf_counter() - started
        return _Step(self._depends, order, Spent(**costs), result)

    def _merge(self, place: Path, added: Path) -> dict[str, Any]:
        started = time.perf_counter()
        (report,) = merge(place, [added], self._merging, settings=self._settings)
        if report.interrupted:
            raise KeyboardInterrupt
        return {
            "merges": 1,
            "merge_s": time.perf_counter() - started,
            "replayed": sum(segment.taken + segment.omitted for segment in report.segments),
            "attempts": report.match_attempts,
            "proposed": report.proposed_attempts,
            "lookups": report.lookups,
        }

    def _judged(self, order: tuple[int, ...], place: Path) -> OrderResult:
        with Map.open(place) as opened:
            drives, reported = (
                [
                    self._localise(opened, sequence, self._settings, self._judge.localising)
                    for sequence in sequences
                ]
                for sequences in (self._sequences, self._reported)
            )
            nodes, content_hash = len(opened.graph), opened.content_hash()
        steps = np.arange(0.0, _AREA_TO_M, _AREA_STEP_M) + _AREA_STEP_M / 2
        estimator = self._judge.estimator
        area_m = float(failure(drives, steps, estimator).sum()) * _AREA_STEP_M
        return OrderResult(
            order,
            float(failure(drives, self._judge.judge_at_m, estimator)),
            area_m,
            {f"{at:g}": float(failure(drives, at, estimator)) for at in _SPREAD_AT_M},
            nodes,
            content_hash,
            failure(reported, _REPORTED_AT_M).tolist() if reported else [],
            route_not_localised(reported),
        )

    def _count(self, step: _Step, monitor: Monitor) -> None:
        self.found.spent += step.spent
        if step.result is not None:
            self.found.results.append(step.result)
            monitor.advance(" ".join(map(str, step.order)))

    def _known_from(self, prefix: tuple[int, ...]) -> list[_Step] | None:
        """All steps from a prefix on, if earlier runs made them from the same inputs; else None."""
        known = []
        for order in _tree(prefix, len(self._maps), self._judge.orders):
            step = self._known(order)
            if step is None:
                return None
            known.append(step)
        return known

    def _known(self, order: tuple[int, ...]) -> _Step | None:
        """A step of an earlier run; None if there is none, or its file is not valid.

        A power cut may leave an empty or partial file: the step is then made again.
        """
        path = self._path(order)
        if not path.exists():
            return None
        try:
            step = read_kept(path, _Step)
        except ConfigError:
            return None
        if step.depends != self._depends:
            return None
        is_whole = (step.result is not None) == (len(order) == len(self._maps))
        return step if is_whole else None

    def _path(self, order: tuple[int, ...]) -> Path:
        return self._folder / f"order-{'-'.join(map(str, order))}.json"


class _Intermediate:
    def __init__(self, folder: Path, order: tuple[int, ...]) -> None:
        self._path = folder / f"order-{'-'.join(map(str, order))}.engram"

    def __enter__(self) -> Path:
        self._remove()
        return self._path

    def __exit__(self, *_: object) -> None:
        self._remove()

    def _remove(self) -> None:
        with keeping(self._path.parent):
            for beside in self._path.parent.glob(f"{self._path.name}*"):
                beside.unlink()


def _tree(prefix: tuple[int, ...], count: int, orders: Orders) -> Iterator[tuple[int, ...]]:
    """The nodes of the prefix tree of `count` groups from a prefix on, itself first."""
    yield prefix
    for number in orders.following(prefix, count):
        yield from _tree((*prefix, number), count, orders)


@dataclass(frozen=True, slots=True)
class BuildOptions:
    """How a map is built.

    Attributes:
        grouping: key of `GROUPINGS`, or path of a file of groups.
        scheduler: address of a Dask scheduler; None to use processes on this machine.
        judge: how the best order of merging is found; None to merge in the order of the groups.
    """

    workers: int = 2
    groups: int = 2
    grouping: str = "chronological"
    seed: int = 0
    mapping: RobotOptions = field(default_factory=RobotOptions)
    merging: MergeOptions = field(default_factory=MergeOptions)
    scheduler: str | None = None
    judge: JudgeOptions | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ConfigError(f"build: {self.workers} workers, must be 1 or more")
        if self.mapping.deadline_ms is not None:
            raise ConfigError("a build needs budgets by count; maps by deadline are not repeatable")


@dataclass(slots=True)
class BuildReport:
    """The result of a build.

    Attributes:
        left_out: names of the drives that the fleet map has already.
        groups: names of the drives of each group, in the order of merging.
        merges: one report per merge of this run; the first group's map becomes a new fleet map.
        merged_before_s: time of the merges of earlier runs of this build, seconds.
        best: how the order was found; None if it was given.
        interrupted: whether it was stopped; the same command continues it.
    """

    centre: str
    left_out: list[str] = field(default_factory=list)
    groups: list[list[str]] = field(default_factory=list)
    mapped: list[GroupResult] = field(default_factory=list)
    merges: list[MergeReport] = field(default_factory=list)
    merged_before_s: float = 0.0
    best: BestOrder | None = None
    notes: list[str] = field(default_factory=list)
    interrupted: bool = False
    content_hash: str = ""
    seconds: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """What ``build --json`` prints."""
        values = {
            field.name: getattr(self, field.name) for field in fields(self) if field.name != "best"
        }
        return {
            **plain({**values, "merges": [merge.to_dict() for merge in self.merges]}),
            "best_order": None if self.best is None else self.best.to_dict(),
            "parallel_s": self.parallel_s,
        }

    @property
    def parallel_s(self) -> float:
        """Wall time with a worker per group: the slowest group, then all merges, seconds."""
        slowest = max((group.seconds for group in self.mapped), default=0.0)
        return slowest + self.merged_s

    @property
    def merged_s(self) -> float:
        """Wall time of all merges, those of earlier runs included, seconds."""
        return self.merged_before_s + sum(merge.seconds for merge in self.merges)

    def text(self) -> str:
        """The report as text."""
        if self.interrupted:
            return "interrupted: finished work is kept; run the same command to continue"
        lines = []
        if self.left_out:
            known = ", ".join(self.left_out)
            lines.append(f"left out, already in {self.centre}: {known}")
        if not self.groups:
            return "\n".join([*lines, f"{self.centre}: nothing new; content {self.content_hash}"])
        for names, group in zip(self.groups, self.mapped, strict=True):
            died = f", {counted(group.retries, 'worker')} died" if group.retries else ""
            made = f"{counted(group.nodes, 'node')}, {group.seconds:.1f} s"
            lines.append(f"group {group.number}: {counted(len(names), 'drive')}, {made}{died}")
        lines += [merge.text() for merge in self.merges]
        if self.best is not None:
            lines += [self.best.text(), self._costs()]
        mapped_s = sum(group.seconds for group in self.mapped)
        lines += [f"  note: {note}" for note in self.notes]
        lines.append(
            f"{self.centre}: content {self.content_hash}; mapping {mapped_s:.1f} s in "
            f"{counted(len(self.mapped), 'group')}, merging {self.merged_s:.1f} s; with a "
            f"worker for each group {self.parallel_s:.1f} s"
        )
        return "\n".join(lines)

    def _costs(self) -> str:
        """The cost of trying orders, compared with the cost models."""
        assert self.best is not None
        mapped_s = sum(group.seconds for group in self.mapped)
        group_s = mapped_s / len(self.mapped)
        merge_s = self.best.spent.merge_s / max(self.best.spent.merges, 1)
        copy_s = self.best.spent.copy_s / max(self.best.spent.copies, 1)
        spent_s = mapped_s + self.best.spent.merge_s + self.best.spent.copy_s
        took = (
            f"  mapping and trying {len(self.best.results)} orders took {spent_s:.1f} s "
            f"(T_G {group_s:.1f} s, T_M {merge_s:.1f} s, T_C {copy_s:.2f} s)"
        )
        if self.best.tried is not Orders.ALL:
            return took
        if self.best.rooted:
            return f"{took}; the cost models apply to new fleet maps only"
        costs = order_costs(len(self.mapped), group_s, merge_s, copy_s)
        return (
            f"{took}: {spent_s / costs.sequential_s:.2%} of building each order "
            f"sequentially, {spent_s / costs.sequential_tree_s:.2%} of a sequential prefix tree; "
            f"model (8) {costs.model_s / costs.sequential_s:.2%}, prefix tree "
            f"{costs.tree_s / costs.sequential_s:.2%}"
        )


def build_map(
    centre: Path,
    drives: Sequence[str],
    settings: Settings,
    options: BuildOptions,
    *,
    keep: bool = False,
    monitor: Monitor = QUIET,
) -> BuildReport:
    """Maps groups of drives side by side and merges them into a fleet map.

    Intermediate maps are kept in ``CENTRE.build`` next to the fleet map until the build is done:
    the same call after an interruption continues from there and gives the same map. An existing
    fleet map takes all groups, without the drives that it has in full. A new one begins as the
    first group's map.

    Args:
        centre: NAME.engram.
        drives: paths or fsspec URLs of frame logs or images.
        settings: the resolved configuration.
        options: workers, groups, mapping and merging.
        keep: keep the groups' maps until the next build into this fleet map.
        monitor: receives progress.

    Raises:
        ConfigError: the groups do not fit the drives, another build lies there unfinished, there
            are too many groups for all orders, or a drive that judges them is not held out.
        InputError: the folder of the fleet map does not exist.
        MapLockedError: another process builds into this fleet map.
        WorkerError: workers died repeatedly.
        EngramError: a drive or a map cannot be used, or the results cannot be stored.
    """
    started = time.perf_counter()
    check_parent(centre)
    looked_at = _look_at(drives)
    with sole_builder(centre):
        report = _build(centre, looked_at, settings, options, monitor, keep=keep)
    report.seconds = time.perf_counter() - started
    return report


def _build(
    centre: Path,
    looked_at: Sequence[Drive],
    settings: Settings,
    options: BuildOptions,
    monitor: Monitor,
    *,
    keep: bool,
) -> BuildReport:
    scratch = Scratch(centre)
    known = _known_sessions(scratch)
    grouped = group_drives(looked_at, options.grouping, options.groups, options.seed, known)
    if options.judge is not None:
        _check_judges(options.judge, looked_at, centre)
        if grouped:
            check_countable(len(grouped), options.judge.orders)
    report = BuildReport(
        str(centre), left_out=[drive.name for drive in looked_at if drive.session.id in known]
    )
    if grouped:
        if options.scheduler is not None:
            check_scheduler(options.scheduler)
        scratch.begin(_plan(grouped, known, settings, options, keep=keep))
        try:
            _map_and_merge(scratch, grouped, settings, options, monitor, report)
        except KeyboardInterrupt:
            report.interrupted = True
    if not report.interrupted:
        with Map.open(centre) as store:
            report.content_hash = store.content_hash()
        report.notes += _not_as_judged(report)
        if grouped:
            scratch.finish()
        else:
            scratch.remove_leftovers()
    return report


def _look_at(sources: Sequence[str]) -> list[Drive]:
    drives = []
    for source in sources:
        with fetched(source) as path:
            absolute = source if "://" in source else str(path.absolute())
            drives.append(look_at_drive(path, absolute))
    return drives


def _known_sessions(scratch: Scratch) -> frozenset[SessionId]:
    """The drives that the fleet map had in full when the build began."""
    if scratch.unfinished is not None:
        return frozenset(SessionId(UUID(session)) for session in scratch.unfinished.known)
    if not scratch.centre.exists():
        return frozenset()
    with Map.open(scratch.centre) as store:
        partial = store.partial_paths
        return frozenset(session for session in store.frontends if path_id(session) not in partial)


def _check_judges(judge: JudgeOptions, drives: Sequence[Drive], centre: Path) -> None:
    """Checks before mapping, which takes hours, that the judging drives are held out."""
    mapped = [(drive.session, f"{drive.source}, a drive of this build") for drive in drives]
    if centre.exists():
        with Map.open(centre) as store:
            mapped += [(session, f"in {centre} already") for session in store.sessions.values()]
    check_held_out(judge, mapped)


def _plan(
    grouped: Sequence[Sequence[Drive]],
    known: frozenset[SessionId],
    settings: Settings,
    options: BuildOptions,
    *,
    keep: bool,
) -> BuildPlan:
    return BuildPlan(
        groups=[[str(drive.session.id) for drive in group] for group in grouped],
        known=sorted(map(str, known)),
        settings=config_hash(settings),
        mapping=to_dict(options.mapping),
        merging=to_dict(options.merging),
        kept=keep,
    )


def _map_and_merge(
    scratch: Scratch,
    grouped: Sequence[Sequence[Drive]],
    settings: Settings,
    options: BuildOptions,
    monitor: Monitor,
    report: BuildReport,
) -> None:
    mapped = _map(scratch, grouped, settings, options, monitor)
    begun = _settled_order(scratch, len(grouped), settings, options, monitor)
    report.best = begun.best
    report.groups = [[drive.name for drive in grouped[number]] for number in begun.order]
    report.mapped = [mapped[number] for number in begun.order]
    report.merged_before_s = sum(begun.seconds.values())
    _merge(scratch, begun, settings, options, monitor, report)


def _map(
    scratch: Scratch,
    grouped: Sequence[Sequence[Drive]],
    settings: Settings,
    options: BuildOptions,
    monitor: Monitor,
) -> list[GroupResult]:
    tasks = [
        GroupTask(
            number,
            scratch.group(number),
            [drive.source for drive in group],
            settings,
            options.mapping,
        )
        for number, group in enumerate(grouped)
    ]
    missing = [task for task in tasks if scratch.result(task.number) is None]
    frames = sum(drive.frames for task in missing for drive in grouped[task.number])
    with (
        interruptible(monitor) as asked,
        asked.stage(f"map {counted(len(missing), 'group')}", frames) as stage,
    ):
        if options.scheduler is not None:
            map_groups_on_cluster(missing, options.scheduler, stage, scratch.remember)
        else:
            _map_here(missing, options.workers, stage, scratch)
        asked.check()  # Ctrl-C may have come while the last groups finished
    results = [scratch.result(task.number) for task in tasks]
    return [result for result in results if result is not None]


def _map_here(tasks: Sequence[GroupTask], workers: int, monitor: Monitor, scratch: Scratch) -> None:

    def done(name: str, result: GroupResult, retries: int) -> None:
        del name
        scratch.remember(replace(result, retries=retries))

    named = {f"group {task.number}": task for task in tasks}
    run_in_processes(map_group, named, workers, monitor, done)


def _settled_order(
    scratch: Scratch, groups: int, settings: Settings, options: BuildOptions, monitor: Monitor
) -> MergingBegun:
    """The order of merging, stored before the first merge so that it cannot change half way."""
    judge = options.judge
    judged_by = None if judge is None else _judged_by(judge)
    begun = scratch.merging_begun()
    if begun is not None:
        if begun.judge != judged_by:
            raise ConfigError(
                f"the groups of {scratch.folder} are being merged already, in the order "
                f"{' '.join(map(str, begun.order))}, which other options found; finish it with the "
                "same --order, --validate and build.max_gap_m, or delete the folder"
            )
        return begun
    if judge is None:
        begun = MergingBegun(list(range(groups)))
    else:
        best = find_best_order(
            [scratch.group(number) for number in range(groups)],
            scratch.orders,
            settings,
            options.merging,
            judge,
            monitor,
            root=scratch.centre if scratch.centre.exists() else None,
        )
        begun = MergingBegun(list(best.order), judged_by, best)
    scratch.remember_merging(begun)
    return begun


def _judged_by(judge: JudgeOptions) -> str:
    """Hash of the judging drives and the orders tried: how an order was found."""
    return judge.hash() + ("" if judge.orders is Orders.ALL else f"-{judge.orders}")


def _merge(
    scratch: Scratch,
    begun: MergingBegun,
    settings: Settings,
    options: BuildOptions,
    monitor: Monitor,
    report: BuildReport,
) -> None:
    """Merges the groups' maps into the centre, in their order.

    An existing fleet map takes all of them, the first too: an earlier run may have made it as a
    copy of that, or another process meanwhile. Merging again changes nothing.
    """
    order = begun.order
    if not scratch.centre.exists():
        copy_map(scratch.group(order[0]), scratch.centre)
        order = order[1:]
    for number in order:
        report.merges += merge(
            scratch.centre,
            [scratch.group(number)],
            options.merging,
            monitor,
            settings=settings,
        )
        if report.merges[-1].interrupted:
            report.interrupted = True
            return
        if report.merges[-1].changed:
            begun = replace(
                begun, seconds={**begun.seconds, str(number): report.merges[-1].seconds}
            )
            scratch.remember_merging(begun)


def _not_as_judged(report: BuildReport) -> list[str]:
    """Adds a note if the map is not the one that was judged."""
    if report.best is None or report.content_hash == report.best.results[0].content_hash:
        return []
    return [
        f"{report.centre} is not the map that was judged, content "
        f"{report.best.results[0].content_hash}: another process wrote to it meanwhile"
    ]
