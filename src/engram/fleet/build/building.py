"""Building a map in parallel: groups are mapped side by side, then merged in turn (method §7)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any
from uuid import UUID

from engram.config import config_hash, plain, to_dict
from engram.counts import counted
from engram.errors import ConfigError
from engram.files import check_parent
from engram.fleet.build.best_order import find_best_order
from engram.fleet.build.cluster import check_scheduler, map_groups_on_cluster
from engram.fleet.build.group_mapping import GroupResult, GroupTask, fetched, map_group
from engram.fleet.build.grouping import Drive, group_drives, look_at_drive
from engram.fleet.build.orders import (
    BestOrder,
    JudgeOptions,
    Orders,
    check_countable,
    check_held_out,
    order_costs,
)
from engram.fleet.build.scratch import BuildPlan, MergingBegun, Scratch, sole_builder
from engram.fleet.merge.merging import merge
from engram.fleet.merge.report import MergeReport
from engram.fleet.merge.settings import MergeOptions
from engram.graph.model import SessionId, path_id
from engram.maps import Map, copy_map
from engram.monitor import QUIET, Monitor, interruptible
from engram.processes import run_in_processes
from engram.robot import RobotOptions, Settings


@dataclass(frozen=True, slots=True)
class BuildOptions:
    """How a map is built.

    Attributes:
        workers: parallel processes on this machine.
        groups: how many the drives are split into.
        grouping: key of `GROUPINGS`, or path of a file of groups.
        seed: of the grouping.
        mapping: how each drive is mapped.
        merging: how the groups' maps are merged.
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
        centre: the map.
        left_out: names of the drives that the fleet map has already.
        groups: names of the drives of each group, in the order of merging.
        mapped: the result of mapping each group.
        merges: one report per merge of this run; the first group's map becomes a new fleet map.
        merged_before_s: time of the merges of earlier runs of this build, seconds.
        best: how the order was found; None if it was given.
        notes: warnings.
        interrupted: whether it was stopped; the same command continues it.
        content_hash: of the map.
        seconds: wall time of this run.
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
        values = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "best"}
        return {
            **plain({**values, "merges": [one.to_dict() for one in self.merges]}),
            "best_order": None if self.best is None else self.best.to_dict(),
            "parallel_s": self.parallel_s,
        }

    @property
    def parallel_s(self) -> float:
        """Wall time with a worker per group: the slowest group, then all merges, seconds."""
        slowest = max((one.seconds for one in self.mapped), default=0.0)
        return slowest + self.merged_s

    @property
    def merged_s(self) -> float:
        """Wall time of all merges, those of earlier runs included, seconds."""
        return self.merged_before_s + sum(one.seconds for one in self.merges)

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
        for names, one in zip(self.groups, self.mapped, strict=True):
            died = f", {counted(one.retries, 'worker')} died" if one.retries else ""
            made = f"{counted(one.nodes, 'node')}, {one.seconds:.1f} s"
            lines.append(f"group {one.number}: {counted(len(names), 'drive')}, {made}{died}")
        lines += [one.text() for one in self.merges]
        if self.best is not None:
            lines += [self.best.text(), self._costs()]
        mapped_s = sum(one.seconds for one in self.mapped)
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
        mapped_s = sum(one.seconds for one in self.mapped)
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
    """The build, under the lock of the fleet map."""
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
        return frozenset(SessionId(UUID(one)) for one in scratch.unfinished.known)
    if not scratch.centre.exists():
        return frozenset()
    with Map.open(scratch.centre) as store:
        partial = store.partial_paths
        return frozenset(one for one in store.frontends if path_id(one) not in partial)


def _check_judges(judge: JudgeOptions, drives: Sequence[Drive], centre: Path) -> None:
    """Checks before mapping, which takes hours, that the judging drives are held out."""
    mapped = [(one.session, f"{one.source}, a drive of this build") for one in drives]
    if centre.exists():
        with Map.open(centre) as store:
            mapped += [(one, f"in {centre} already") for one in store.sessions.values()]
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
    """The build, as far as this run takes it.

    Raises:
        KeyboardInterrupt: the user stopped the mapping or the trying of orders.
    """
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
    """Maps the groups that are not mapped yet, and stores their results."""
    tasks = [
        GroupTask(
            number, scratch.group(number), [one.source for one in group], settings, options.mapping
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
    """Maps groups in processes on this machine."""

    def done(name: str, result: GroupResult, retries: int) -> None:
        del name
        scratch.remember(replace(result, retries=retries))

    named = {f"group {task.number}": task for task in tasks}
    run_in_processes(map_group, named, workers, monitor, done)


def _settled_order(
    scratch: Scratch, groups: int, settings: Settings, options: BuildOptions, monitor: Monitor
) -> MergingBegun:
    """The order of merging, stored before the first merge so that it cannot change half way.

    Raises:
        ConfigError: merging has begun in an order that other options found.
    """
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
