"""Building a map fast: groups mapped side by side, then merged one after another (SPEC §7)."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import UUID

from engram.config import config_hash, to_dict
from engram.drive import MapOptions, Settings
from engram.drive.interruption import deferred_interrupt
from engram.errors import ConfigError
from engram.experience.model import SessionId, path_id
from engram.fleet.best_order import BestOrder, JudgeOptions, find_best_order, order_costs
from engram.fleet.cluster import map_groups_on_cluster
from engram.fleet.docking import merge_maps
from engram.fleet.group_mapping import GroupResult, GroupTask, fetched
from engram.fleet.grouping import Drive, group_drives, look_at_drive
from engram.fleet.merging import Progress, silent
from engram.fleet.replay import MergeOptions
from engram.fleet.report import MergeReport
from engram.fleet.workers import map_groups
from engram.store import MapStore


@dataclass(frozen=True, slots=True)
class BuildOptions:
    """How a map is built.

    Attributes:
        workers: processes of this machine at a time.
        groups: how many the drives are split into.
        grouping: key of `GROUPINGS`, or path of a file of groups.
        seed: of the grouping.
        mapping: how each drive is mapped.
        merging: how the groups' maps are merged.
        scheduler: address of a Dask scheduler in place of processes of this machine.
        judge: how the best order of merging is found; None merges in the order of the groups.
    """

    workers: int = 2
    groups: int = 2
    grouping: str = "chronological"
    seed: int = 0
    mapping: MapOptions = field(default_factory=MapOptions)
    merging: MergeOptions = field(default_factory=MergeOptions)
    scheduler: str | None = None
    judge: JudgeOptions | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ConfigError(f"build: {self.workers} workers, must be 1 or more")
        if self.mapping.deadline_ms is not None or self.mapping.rate_hz is not None:
            raise ConfigError("a build has budgets by count: a deadline would give chance maps")


@dataclass(slots=True)
class BuildReport:
    """What a build came to.

    Attributes:
        centre: the map.
        left_out: names of the drives that the centre had before.
        groups: names of the drives of each group, in the order of merging.
        mapped: what mapping each group came to.
        merges: one report per merge; the first group's map becomes a centre that is new.
        best: how the order was found, where that was asked.
        interrupted: whether it was stopped; the same command goes on.
        content_hash: of the map.
        seconds: wall time of this run.
    """

    centre: str
    left_out: list[str] = field(default_factory=list)
    groups: list[list[str]] = field(default_factory=list)
    mapped: list[GroupResult] = field(default_factory=list)
    merges: list[MergeReport] = field(default_factory=list)
    best: BestOrder | None = None
    interrupted: bool = False
    content_hash: str = ""
    seconds: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """What ``build --json`` prints."""
        return {
            "centre": self.centre,
            "left_out": self.left_out,
            "groups": self.groups,
            "mapped": [one.to_dict() for one in self.mapped],
            "merges": [one.to_dict() for one in self.merges],
            "best_order": None if self.best is None else self.best.to_dict(),
            "interrupted": self.interrupted,
            "content_hash": self.content_hash,
            "seconds": self.seconds,
            "parallel_s": self.parallel_s,
        }

    @property
    def parallel_s(self) -> float:
        """Time with a worker per group: the slowest group, then the merges one after another."""
        slowest = max((one.seconds for one in self.mapped), default=0.0)
        return slowest + sum(one.seconds for one in self.merges)

    def text(self) -> str:
        """For people."""
        if self.interrupted:
            return "interrupted: what was done is kept; give the same command to go on"
        lines = []
        if self.left_out:
            known = ", ".join(self.left_out)
            lines.append(f"left out, since {self.centre} has them already: {known}")
        if not self.groups:
            return "\n".join([*lines, f"{self.centre}: nothing new; content {self.content_hash}"])
        for names, one in zip(self.groups, self.mapped, strict=True):
            saved = sum(session["nodes_saved"] for session in one.sessions)
            died = f", {one.retries} workers died" if one.retries else ""
            lines.append(
                f"group {one.number}: {len(names)} drives, {saved} nodes, {one.seconds:.1f} s{died}"
            )
        lines += [one.text() for one in self.merges]
        if self.best is not None:
            lines += [self.best.text(), self._costs()]
        mapped_s = sum(one.seconds for one in self.mapped)
        merged_s = sum(one.seconds for one in self.merges)
        lines.append(
            f"{self.centre}: content {self.content_hash}; mapping {mapped_s:.1f} s in "
            f"{len(self.mapped)} groups, merging {merged_s:.1f} s; with a worker for each group "
            f"{self.parallel_s:.1f} s"
        )
        return "\n".join(lines)

    def _costs(self) -> str:
        """What trying all orders cost, beside the models of it."""
        assert self.best is not None
        mapped_s = sum(one.seconds for one in self.mapped)
        group_s = mapped_s / len(self.mapped)
        merge_s = self.best.merge_s / max(self.best.merges, 1)
        copy_s = self.best.copy_s / max(self.best.copies, 1)
        spent_s = mapped_s + self.best.merge_s + self.best.copy_s
        costs = order_costs(len(self.mapped), group_s, merge_s, copy_s)
        return (
            f"  all orders took {spent_s:.1f} s (T_G {group_s:.1f} s, T_M {merge_s:.1f} s, T_C "
            f"{copy_s:.2f} s): {spent_s / costs.sequential_s:.2%} of building each order "
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
    progress: Progress = silent,
) -> BuildReport:
    """Maps groups of drives side by side and merges them into a centre.

    Intermediate maps lie in ``CENTRE.build`` beside the centre until the build is complete: the
    same call after an interruption goes on from there, and comes to the same map. A centre that
    exists takes in all groups, and the drives that it has are left out (not those of which it has
    a part of the path only); one that does not exist begins as the first group's map.

    Args:
        centre: NAME.engram.
        drives: paths or fsspec URLs of frame logs or images.
        settings: the resolved configuration.
        options: how.
        keep: leave the intermediate maps.
        progress: shows how it goes.

    Raises:
        ConfigError: the groups do not fit the drives, or another build lies there unfinished.
        WorkerError: workers died again and again.
        EngramError: a drive or a map cannot be used.
    """
    started = time.perf_counter()
    looked_at = _look_at(drives)
    known = _known_sessions(centre)
    grouped = group_drives(looked_at, options.grouping, options.groups, options.seed, known)
    report = BuildReport(
        str(centre), left_out=[drive.name for drive in looked_at if drive.session.id in known]
    )
    with _scratch(centre, grouped, known, settings, options, keep=keep) as scratch:
        try:
            report.mapped = _map(scratch, grouped, settings, options, progress)
            order = list(range(len(grouped)))
            if options.judge is not None and grouped:
                maps = [scratch.group(number) for number in order]
                report.best = find_best_order(
                    maps, scratch.orders, settings, options.merging, options.judge, progress
                )
                order = list(report.best.order)
            report.groups = [[drive.name for drive in grouped[number]] for number in order]
            report.mapped = [report.mapped[number] for number in order]
            report.merges = _merge(
                scratch, centre, [scratch.group(number) for number in order], settings, options,
                progress,
            )  # fmt: skip
            report.interrupted = any(one.interrupted for one in report.merges)
        except KeyboardInterrupt:
            report.interrupted = True
        scratch.complete = not report.interrupted
    if not report.interrupted:
        with MapStore.open(centre) as store:
            report.content_hash = store.content_hash()
    report.seconds = time.perf_counter() - started
    return report


def _look_at(sources: Sequence[str]) -> list[Drive]:
    drives = []
    for source in sources:
        with fetched(source) as path:
            absolute = source if "://" in source else str(path.absolute())
            drives.append(look_at_drive(path, absolute))
    return drives


def _known_sessions(centre: Path) -> frozenset[SessionId]:
    """The drives that the centre had when the build began, partial paths left aside."""
    begun = _folder(centre) / "build.json"
    if begun.exists():
        earlier = json.loads(begun.read_text()).get("known", [])
        return frozenset(SessionId(UUID(one)) for one in earlier)
    if not centre.exists():
        return frozenset()
    with MapStore.open(centre) as store:
        partial = store.partial_paths()
        return frozenset(one for one in store.frontends() if path_id(one) not in partial)


def _folder(centre: Path) -> Path:
    """Where the intermediate maps of a build lie."""
    return centre.with_name(f"{centre.name}.build")


def _map(
    scratch: _Scratch,
    grouped: Sequence[Sequence[Drive]],
    settings: Settings,
    options: BuildOptions,
    progress: Progress,
) -> list[GroupResult]:
    """Maps the groups that are not mapped yet; remembers how long each took."""
    tasks = [
        GroupTask(number, [drive.source for drive in group], settings, options.mapping)
        for number, group in enumerate(grouped)
    ]
    missing = [task for task in tasks if scratch.result(task.number) is None]
    frames = sum(drive.frames for task in missing for drive in grouped[task.number])
    words = f"map {len(missing)} groups"
    with deferred_interrupt() as check, progress(words, frames) as advance:
        if options.scheduler is not None:
            map_groups_on_cluster(
                missing, scratch.group, options.scheduler, advance, check, scratch.remember
            )
        else:
            map_groups(missing, scratch.group, options.workers, advance, check, scratch.remember)
        check()  # also where the last groups were done as Ctrl-C was pressed
    results = [scratch.result(task.number) for task in tasks]
    return [result for result in results if result is not None]


def _merge(
    scratch: _Scratch,
    centre: Path,
    maps: Sequence[Path],
    settings: Settings,
    options: BuildOptions,
    progress: Progress,
) -> list[MergeReport]:
    if scratch.new_centre:
        if not centre.exists():
            MapStore.copy(maps[0], centre)
        maps = maps[1:]
    return merge_maps(centre, maps, settings, options.merging, progress=progress)


class _Scratch:
    """The intermediate maps of a build, and what is known of them."""

    def __init__(self, folder: Path, *, new_centre: bool) -> None:
        self.folder = folder
        self.new_centre = new_centre
        self.complete = False

    def group(self, number: int) -> Path:
        """The map of a group."""
        return self.folder / f"group-{number}.engram"

    @property
    def orders(self) -> Path:
        """Folder of the maps of partial orders."""
        return self.folder / "orders"

    def remember(self, result: GroupResult) -> None:
        """A group is mapped."""
        _write_json(self._result_path(result.number), result.to_dict())

    def result(self, number: int) -> GroupResult | None:
        """What mapping a group came to; None if that is still to be done."""
        path = self._result_path(number)
        return GroupResult(**json.loads(path.read_text())) if path.exists() else None

    def _result_path(self, number: int) -> Path:
        return self.folder / f"group-{number}.json"


@contextmanager
def _scratch(
    centre: Path,
    grouped: Sequence[Sequence[Drive]],
    left_out: Collection[SessionId],
    settings: Settings,
    options: BuildOptions,
    *,
    keep: bool,
) -> Iterator[_Scratch]:
    """The folder of a build: new, or that of an earlier run of the same build."""
    folder = _folder(centre)
    plan = {
        "groups": [[str(drive.session.id) for drive in group] for group in grouped],
        "known": sorted(str(session) for session in left_out),
        "settings": config_hash(settings),
        "mapping": to_dict(options.mapping),
        "merging": to_dict(options.merging),
        "new_centre": not centre.exists(),
    }
    known = folder / "build.json"
    if known.exists():
        earlier = json.loads(known.read_text())
        plan["new_centre"] = earlier.get("new_centre")
        if earlier != json.loads(json.dumps(plan)):
            raise ConfigError(
                f"{folder} is of another build that is not complete; finish it with its own "
                "command, or delete the folder"
            )
    else:
        folder.mkdir(parents=True, exist_ok=True)
        _write_json(known, plan)
    scratch = _Scratch(folder, new_centre=bool(plan["new_centre"]))
    yield scratch
    if scratch.complete and not keep:
        shutil.rmtree(folder)


def _write_json(path: Path, values: dict[str, Any]) -> None:
    """In one step: a killed build leaves no half file."""
    draft = path.with_suffix(".part")
    draft.write_text(json.dumps(values))
    draft.replace(path)
