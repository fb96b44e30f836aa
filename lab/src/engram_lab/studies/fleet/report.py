"""Results of a fleet study, read back per arm and fold: tables, comparisons, a page and figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engram.fleet.build.orders import order_costs
from engram.measures import Drive, failure, longest_gap_m, route_m, route_not_localised
from engram.robot.settings import Settings
from engram_lab.charts import Line, Panel, draw_bars, draw_curves
from engram_lab.intervals import Resamples
from engram_lab.studies.building import BuiltSession, read_record
from engram_lab.studies.configurations import Configuration
from engram_lab.studies.drives import EvaluatedDrive, Fold
from engram_lab.studies.fleet.experiments import SHARED, SINGLE, merged_name, pair_merges
from engram_lab.studies.fleet.plan import (
    FORAY_POLICIES,
    ROBOTS,
    VERBS,
    Arm,
    DownloadRecord,
    FleetPlan,
    MergeRecord,
    read_download,
    read_drive,
    read_json,
    read_merge,
)
from engram_lab.studies.fleet.steps import (
    AS_TOD,
    AS_TOD_PATHS,
    COPY,
    QUARTER,
    TENTH,
    TOD,
    TOD_PATHS,
    Counts,
    StageTimes,
    TriedDownload,
    field_path,
    map_path,
    read_stages,
    read_trials,
    runs_path,
    stages_path,
)
from engram_lab.studies.in_force import OF_DRIVE, Values, common, exceptions, in_words, unused
from engram_lab.studies.in_force import rows as in_force_rows
from engram_lab.studies.lockstep import read_runs
from engram_lab.studies.plan import (
    COMPARED,
    CURVE_AT_M,
    Row,
    chosen,
    compared_drives,
    failure_line,
    make_folder,
    table,
    write_study,
)
from engram_lab.studies.ranking_report import ConfigurationResult, SessionResult, session_result


@dataclass(frozen=True, slots=True)
class Time:
    """What something took.

    Attributes:
        counted_s: counts of frames, attempts and look-ups × medians measured once; None where
            these were not measured yet.
    """

    counted_s: float | None
    wall_s: float

    def __add__(self, other: Time) -> Time:
        wall_s = self.wall_s + other.wall_s
        if self.counted_s is None or other.counted_s is None:
            return Time(None, wall_s)
        return Time(self.counted_s + other.counted_s, wall_s)


# Downloads tried out on held-out drives, by kind.
Trials: TypeAlias = dict[str, list[tuple[EvaluatedDrive, TriedDownload]]]


def total(times: Iterable[Time]) -> Time:
    """Of things done one after another."""
    return sum(times, Time(0.0, 0.0))


def slowest(times: Iterable[Time]) -> Time:
    """Of things done side by side, by either clock."""
    some = list(times)
    counted = [one.counted_s for one in some if one.counted_s is not None]
    return Time(
        max(counted, default=0.0) if len(counted) == len(some) else None,
        max((one.wall_s for one in some), default=0.0),
    )


@dataclass(frozen=True, slots=True)
class Parallel:
    """A parallel build of one fold."""

    groups: list[list[BuiltSession]]
    merges: list[MergeRecord]
    group_times: list[Time]
    merge_times: list[Time]
    pairs: list[tuple[int, MergeRecord, Time]]

    @property
    def time(self) -> Time:
        """The slowest group, then the merges one after another ([G16] Fig. 7)."""
        return sum(self.merge_times, slowest(self.group_times))

    @property
    def pairwise_time(self) -> Time | None:
        """The slowest group, then the slowest merge of each level of the tree."""
        if not self.pairs:
            return None
        levels = {level for level, _, _ in self.pairs}
        by_level = [
            slowest(time for at, _, time in self.pairs if at == level) for level in sorted(levels)
        ]
        return sum(by_level, slowest(self.group_times))

    @property
    def nodes(self) -> int:
        """Of the merged map."""
        return self.merges[-1].nodes if self.merges else self.groups[0][-1].nodes


@dataclass(frozen=True, slots=True)
class InField:
    """One drive of a second foray, localised while it was mapped."""

    robot: str
    policy: str
    nodes: int
    drive: Drive
    ms: float
    time: Time
    frames: int


class FoldResult:
    """One arm in one fold."""

    def __init__(self, plan: FleetPlan, arm: Arm, fold: Fold, stages: StageTimes | None) -> None:
        self.plan, self.arm, self.fold = plan, arm, fold
        self._stages = stages

    def sessions(self, name: str) -> list[BuiltSession]:
        """How a map was built, drive by drive; empty if it was not."""
        return read_record(map_path(self.plan, self.arm, self.fold, name)).sessions

    def merge(self, name: str) -> MergeRecord | None:
        """How a map was merged."""
        return read_merge(self._beside(name, "merge"))

    def download(self, name: str) -> DownloadRecord | None:
        """What a download came to."""
        return read_download(self._beside(name, "download"))

    def held_out(self, name: str) -> list[SessionResult]:
        """The held-out drives in a map; empty unless all were localised.

        Some of them would stand beside others in another map.
        """
        found = []
        for number in self.fold.held_out:
            drive = self.plan.drives.drives[number]
            runs = read_runs(runs_path(self.plan, self.arm, self.fold, name, drive))
            if runs is not None and self.arm.configuration in runs.configurations:
                row = runs.configurations.index(self.arm.configuration)
                nodes = self.nodes(name)
                found.append(session_result(runs, row, number, self.fold.number, nodes))
        return found if len(found) == len(self.fold.held_out) else []

    def nodes(self, name: str) -> int:
        """Of a map."""
        merged, sessions = self.merge(name), self.sessions(name)
        return merged.nodes if merged else sessions[-1].nodes if sessions else 0

    def time_of(self, sessions: Sequence[BuiltSession]) -> Time:
        """What mapping some drives took."""
        counts = Counts(
            sum(one.frames for one in sessions),
            sum(one.attempts for one in sessions),
            sum(one.proposed for one in sessions),
            sum(one.lookups for one in sessions),
        )
        return Time(self.counted(counts), sum(one.seconds for one in sessions))

    def time_of_merge(self, made: MergeRecord) -> Time:
        """What a merge took."""
        counts = Counts(made.frames, made.attempts, made.proposed, made.lookups)
        return Time(self.counted(counts), made.seconds)

    def single(self) -> list[BuiltSession] | None:
        """The single agent's map; None unless it is whole."""
        sessions = self.sessions("single")
        return sessions if len(sessions) == len(self.fold.training) else None

    def parallel(self, groups: int) -> Parallel | None:
        """A parallel build with so many groups; None unless it is whole."""
        built = [self.sessions(f"group{groups}-{number}") for number in range(groups)]
        merges = [self.merge(merged_name(groups, number)) for number in range(1, groups)]
        whole = [one for one in merges if one is not None]
        wanted = [len(one) for one in self.plan.groups(self.fold, groups)]
        if len(whole) < len(merges) or [len(one) for one in built] != wanted:
            return None
        pairs = [(one.level, self.merge(one.name)) for one in pair_merges(groups)]
        made = [(level, one, self.time_of_merge(one)) for level, one in pairs if one is not None]
        return Parallel(
            groups=built,
            merges=whole,
            group_times=[self.time_of(one) for one in built],
            merge_times=[self.time_of_merge(one) for one in whole],
            pairs=made if len(made) == len(pairs) else [],
        )

    def in_field(self, robot: str, policy: str) -> list[InField]:
        """The drives of a second foray; empty unless all were driven."""
        name = f"{robot}-{policy}"
        sessions = self.sessions(name)
        drives = self.plan.forays(self.fold)[robot][1]
        found = []
        for drive, built in zip(drives, sessions, strict=False):
            kept = read_drive(field_path(self.plan, self.arm, self.fold, name, drive))
            if kept is not None:
                driven, ms = kept
                time = self.time_of([built])
                found.append(InField(robot, policy, built.nodes, driven, ms, time, built.frames))
        return found if len(found) == len(drives) else []

    def forays(self) -> dict[str, list[InField]]:
        """Both robots' second forays by policy; none unless they were driven in all policies.

        Fig. 8 needs those in copies only: alone they say nothing of downloads.
        """
        driven = {
            policy: [self.in_field(robot, policy) for robot in ROBOTS] for policy in FORAY_POLICIES
        }
        if not all(one for robots in driven.values() for one in robots):
            return {}
        return {policy: [*chain.from_iterable(robots)] for policy, robots in driven.items()}

    def trials(self) -> Trials:
        """Downloads tried out on held-out drives, by kind; each drive tried all kinds at once."""
        found: Trials = {}
        for drive in self.plan.held_out(self.fold):
            for one in read_trials(self.plan, self.arm, self.fold, drive):
                found.setdefault(one.name, []).append((drive, one))
        return found

    def orders(self) -> dict[str, Any] | None:
        """All orders of merging; None if they were not tried."""
        path = self.plan.folder(self.arm, self.fold) / "orders.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    def order_groups(self) -> list[list[BuiltSession]]:
        """The groups whose orders were tried."""
        count = len(self.plan.order_groups(self.fold))
        return [self.sessions(f"orders-{number}") for number in range(count)]

    def sequential(self) -> list[BuiltSession] | None:
        """The order that was really built sequentially; None unless it is whole."""
        sessions = self.sessions("orders-sequential")
        wanted = sum(len(one) for one in self.plan.order_groups(self.fold))
        return sessions if len(sessions) == wanted else None

    def counted(self, counts: Counts) -> float | None:
        """Seconds of so many; None if no medians were measured."""
        return None if self._stages is None else self._stages.seconds(counts)

    # -- what each kind of step ran by

    def maps_in_force(self) -> Iterator[Values]:
        """Of each map that drives were added to."""
        for path in self._folder.glob("*.json"):
            known = read_json(path)
            if "sessions" in known and known.get("in_force"):
                yield known["in_force"]

    def merges_in_force(self) -> Iterator[Values]:
        """Of each merge."""
        for path in self._folder.glob("*.merge.json"):
            yield MergeRecord(**read_json(path)).in_force

    def downloads_in_force(self) -> Iterator[Values]:
        """Of each download for a foray."""
        for path in self._folder.glob("*.download.json"):
            yield DownloadRecord(**read_json(path)).in_force

    def trials_in_force(self) -> Iterator[Values]:
        """Of each download tried out on a held-out drive."""
        for one in chain.from_iterable(self.trials().values()):
            yield one[1].in_force

    def drives_in_force(self) -> Iterator[Values]:
        """Of each held-out drive in each map."""
        for path in self._folder.glob("runs-*.npz"):
            runs = read_runs(path)
            yield from () if runs is None else runs.in_force

    def orders_in_force(self) -> Iterator[Values]:
        """Of the orders of merging."""
        found = self.orders()
        if found is not None:
            yield {"build.max_gap_m": found["judge_at_m"], "build.estimator": found["estimator"]}

    @property
    def _folder(self) -> Path:
        return self.plan.folder(self.arm, self.fold)

    def _beside(self, name: str, kind: str) -> Any:
        return map_path(self.plan, self.arm, self.fold, name).with_suffix(f".{kind}.json")


class ArmResult:
    """One arm in all folds, pooled over those that are whole."""

    def __init__(self, plan: FleetPlan, arm: Arm) -> None:
        self.plan, self.arm = plan, arm
        self.stages = read_stages(plan, arm)
        self.folds = [FoldResult(plan, arm, fold, self.stages) for fold in plan.folds]

    def asked(self, experiment: int) -> bool:
        """Whether an experiment is to be reported on; others left maps that it shares with them."""
        return experiment in self.plan.options.experiments

    @cached_property
    def configuration(self) -> Configuration:
        """Of the held-out drives."""
        return self.arm.configuration

    def held_out(self, *names: str) -> list[ConfigurationResult] | None:
        """The held-out drives in some maps, the same ones in each; None if there are none."""
        found: list[list[SessionResult]] = [[] for _ in names]
        for fold in self.folds:
            sessions = [{one.session: one for one in fold.held_out(name)} for name in names]
            common = set.intersection(*(set(one) for one in sessions)) if sessions else set()
            for kept, known in zip(found, sessions, strict=True):
                kept += [known[number] for number in sorted(common)]
        if not found[0]:
            return None
        return [ConfigurationResult(self.configuration, one) for one in found]

    def in_force(self) -> dict[str, Values]:
        """What each kind of step ran by, of those that were made."""
        found = {
            "maps": [one for fold in self.folds for one in fold.maps_in_force()],
            "merges": [one for fold in self.folds for one in fold.merges_in_force()],
            "downloads": [one for fold in self.folds for one in fold.downloads_in_force()],
            "downloads tried": [one for fold in self.folds for one in fold.trials_in_force()],
            "held out": [one for fold in self.folds for one in fold.drives_in_force()],
            "orders": [one for fold in self.folds for one in fold.orders_in_force()],
        }
        return {name: common(some) for name, some in found.items() if some}

    def forays(self, policy: str) -> list[InField]:
        """All drives of all second forays in one kind of download, of the folds that have all."""
        return [one for fold in self.folds for one in fold.forays().get(policy, [])]

    def downloads(self, policy: str) -> list[DownloadRecord]:
        """What the robots took along, of the same folds."""
        found = [
            fold.download(f"{robot}-{policy}-download")
            for fold in self.folds
            if fold.forays()
            for robot in ROBOTS
        ]
        return [one for one in found if one is not None]

    def trials(self) -> Trials:
        """Downloads tried out on held-out drives, by kind; those drives that tried all kinds."""
        pooled: Trials = {}
        for fold in self.folds:
            for name, some in fold.trials().items():
                pooled.setdefault(name, []).extend(some)
        return pooled


Array = NDArray[np.float64]
_LEAST_PERCENT = 0.01
_P = "P(X ≥ x), %"


def draw_fleet_figures(out: Path, arms: Sequence[ArmResult]) -> list[Path]:
    """Draws every requested figure for which results are there; returns the files."""
    written: list[Path] = []

    def draw(number: int, name: str, panel: Callable[[ArmResult], Panel], title: str) -> None:
        panels = [panel(arm) for arm in arms if arm.asked(number)]
        shown = [one for one in panels if one.lines]
        if shown:
            path = out / f"fig{number:02d}_{name}.png"
            draw_curves(shown, path, title)
            written.append(path)

    draw(7, "nodes", _nodes, "size of the map while it is built")
    draw(7, "failure", _building_panel, "failure of held-out drives")
    draw(8, "failure", _sharing_panel, "failure of held-out drives")
    draw(9, "nodes", _robots, "nodes on the robots")
    draw(9, "time", _times_panel, "time of localising, second foray")
    draw(9, "failure", _in_field, "failure in the second foray")
    draw(9, "downloads", _downloads_panel, "held-out drives in downloads")
    draw(10, "orders", _orders_panel, "held-out drives, all orders")
    for arm in arms:
        if arm.asked(9):
            written += _draw_sizes(out, arm)
    return written


def _title(arm: ArmResult) -> str:
    return f"{arm.plan.drives.name}, arm {arm.arm.letter}: {arm.arm.words}"


def _nodes(arm: ArmResult) -> Panel:
    """Fig. 7a: nodes against time, by counts, of the first fold that has both."""
    lines: list[Line] = []
    for fold in arm.folds if arm.stages else ():
        single, built = fold.single(), fold.parallel(arm.plan.options.groups)
        if single is None or built is None:
            continue
        x = np.cumsum(_counted_s(fold.time_of([one]) for one in single))
        lines.append(Line("one agent", x, np.array([one.nodes for one in single], float)))
        for number, sessions in enumerate(built.groups):
            x = np.cumsum(_counted_s(fold.time_of([one]) for one in sessions))
            y = np.array([one.nodes for one in sessions], float)
            lines.append(Line(f"group {number}", x, y, marks=False))
        merges = np.cumsum(_counted_s(built.merge_times))
        x = _counted_s(built.group_times).max() + np.array([0.0, *merges])
        y = np.array([built.groups[0][-1].nodes, *(one.nodes for one in built.merges)], float)
        lines.append(Line("merging", x, y))
        break
    return Panel(_title(arm), "s, by counts, on one core", "nodes", lines)


def _counted_s(times: Iterable[Time]) -> Array:
    return np.array([one.counted_s for one in times], np.float64)


def _building_panel(arm: ArmResult) -> Panel:
    """Fig. 7b."""
    groups = arm.plan.options.groups
    names = {"one agent": SINGLE, f"{groups} groups merged": merged_name(groups, groups - 1)}
    return _held_out_panel(arm, names)


def _sharing_panel(arm: ArmResult) -> Panel:
    """Fig. 8."""
    return _held_out_panel(arm, {**{one: one for one in ROBOTS}, "shared": SHARED})


def _held_out_panel(arm: ArmResult, names: dict[str, str]) -> Panel:
    found = arm.held_out(*names.values())
    lines = []
    for label, one in zip(names, found or [], strict=False):
        lines.append(_curve(label, one.drives, arm.plan.options.seed))
    return Panel(_title(arm), "x, m", _P, lines, least_y=_LEAST_PERCENT)


def _curve(label: str, drives: Sequence[Drive], seed: int) -> Line:
    return failure_line(label, drives, Resamples.of(len(drives), seed=seed))


def _robots(arm: ArmResult) -> Panel:
    """Fig. 9a: nodes on each robot, log by log; between the forays it docks."""
    lines = []
    fold = next((one for one in arm.folds if one.forays()), None)
    if fold is not None:
        for robot in ROBOTS:
            first = [one.nodes for one in fold.sessions(f"{robot}-first")]
            for policy in FORAY_POLICIES:
                second = [one.nodes for one in fold.in_field(robot, policy)]
                y = np.array([*first, *second], float)
                x = np.arange(1, len(y) + 1, dtype=float)
                lines.append(Line(f"{robot}, {policy}", x, y))
    return Panel(_title(arm), "log", "nodes", lines)


def _times_panel(arm: ArmResult) -> Panel:
    """Fig. 9b: ms per frame of the second foray's logs, mean over robots and folds."""
    lines = []
    for policy in FORAY_POLICIES:
        series = _series(arm, policy)
        if len(series):
            first = len(arm.folds[0].plan.forays(arm.folds[0].fold)["r1"][0])
            x = first + 1 + np.arange(series.shape[1], dtype=float)
            lines.append(Line(policy, x, series.mean(axis=0)))
    return Panel(_title(arm), "log", "ms per frame", lines)


def _series(arm: ArmResult, policy: str) -> Array:
    """(robots × folds, logs) ms per frame; (0, 0) where no foray was driven yet."""
    driven = [
        [one.ms for one in fold.in_field(robot, policy)]
        for fold in arm.folds
        if fold.forays()
        for robot in ROBOTS
    ]
    logs = min((len(one) for one in driven), default=0)
    return np.array([one[:logs] for one in driven]).reshape(len(driven), logs)


def _in_field(arm: ArmResult) -> Panel:
    """Fig. 9c."""
    lines = []
    for policy in FORAY_POLICIES:
        drives = [one.drive for one in arm.forays(policy)]
        if drives:
            lines.append(_curve(policy, drives, arm.plan.options.seed))
    return Panel(_title(arm), "x, m", _P, lines, least_y=_LEAST_PERCENT)


def _downloads_panel(arm: ArmResult) -> Panel:
    """Held-out drives in downloads for their own hours; not every policy has one for every drive.

    Without bands: of seven curves they would hide each other. Paired intervals are in `report.md`.
    """
    trials = arm.trials()
    most = max((len(tried) for tried in trials.values()), default=0)
    lines, drives = [], f"{most} drives"
    for name, tried in trials.items():
        curve = _curve(name, [one.drive for _, one in tried], arm.plan.options.seed)
        lines.append(replace(curve, low=None, high=None))
        if len(tried) < most and name in FORAY_POLICIES:
            drives += f", {name} {len(tried)}"
    return Panel(f"{_title(arm)}\n{drives}", "x, m", _P, lines, least_y=1)


def _orders_panel(arm: ArmResult) -> Panel:
    """Fig. 10: one curve per order, and the chosen one."""
    fold: FoldResult = arm.folds[0]
    found = fold.orders()
    lines = []
    if found is not None:
        for place, one in enumerate(found["orders"][::-1]):
            y = 100 * np.array(one["reported"])
            last = place == len(found["orders"]) - 1
            label = "chosen on validation" if last else "other orders"
            lines.append(Line(label, CURVE_AT_M, y, marks=False))
    return Panel(_title(arm), "x, m", _P, lines, least_y=_LEAST_PERCENT)


def _draw_sizes(out: Path, arm: ArmResult) -> list[Path]:
    """Nodes, bytes, failure and time of the downloads."""
    trials = {name: [one for _, one in some] for name, some in arm.trials().items()}
    if not trials:
        return []
    measures: dict[str, Callable[[Sequence[TriedDownload]], float]] = {
        "nodes, % of the centre's": lambda some: 100 * _mean(x.nodes / x.of_nodes for x in some),
        "MB": lambda some: _mean(x.size_bytes / 1e6 for x in some),
        "route not localised, %": lambda some: 100 * route_not_localised([x.drive for x in some]),
        "ms per localisation": lambda some: _mean(x.ms for x in some),
    }
    bars = [
        (what, [(name, measure(some)) for name, some in trials.items()])
        for what, measure in measures.items()
    ]
    path = out / f"downloads_{arm.plan.drives.name}_{arm.arm.letter}.png"
    draw_bars(bars, path, f"{_title(arm)}; downloads for the hour of each held-out drive")
    return [path]


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def comparison_rows(arm: ArmResult) -> list[Row]:
    """All of one arm; of the requested experiments."""
    about = {"campaign": arm.plan.drives.name, "arm": arm.arm.letter}
    of = {7: _building, 8: _sharing, 9: _downloads, 10: _orders}
    return [
        {**about, "experiment": number, **row}
        for number, rows in of.items()
        if arm.asked(number)
        for row in rows(arm)
    ]


def _building(arm: ArmResult) -> Iterator[Row]:
    """Fig. 7."""
    main = arm.plan.options.groups
    for groups in arm.plan.group_counts(arm.plan.folds[0]):
        whole = _whole(arm, groups)
        if not whole:
            continue
        single = [fold.time_of(fold.single() or []) for fold, _ in whole]
        what = f"{groups} groups, merged one after another, ÷ one agent"
        paper = ("29.36 %", "67.57 %", "21.97 against 32.03 %") if groups == main else ("", "", "")
        yield from _times(what, [built.time for _, built in whole], single, paper[0])
        alone = [slowest(built.group_times) for _, built in whole]
        yield from _times(f"{groups} groups: the slowest ÷ one agent", alone, single)
        agents = sum((fold.single() or [])[-1].nodes for fold, _ in whole)
        merged = sum(built.nodes for _, built in whole)
        yield _ratio(f"{what}: nodes", merged, agents, paper[1])
        name = merged_name(groups, groups - 1)
        yield from _held_out_pairs(
            arm, f"{groups} groups merged against one agent", name, SINGLE, paper[2]
        )
        pairwise = [built.pairwise_time for _, built in whole if built.pairwise_time is not None]
        if groups == main and len(pairwise) == len(whole):
            what = f"{groups} groups, merged as a pairwise tree, ÷ one agent"
            yield from _times(what, pairwise, single)
            tree = sum(built.pairs[-1][1].nodes for _, built in whole)
            yield _ratio(f"{what}: nodes", tree, agents)
            name = pair_merges(groups)[-1].name
            yield from _held_out_pairs(arm, "pairwise tree against one agent", name, SINGLE)


def _whole(arm: ArmResult, groups: int) -> list[tuple[FoldResult, Parallel]]:
    """Folds in which both ways of building are complete."""
    found = [(fold, fold.parallel(groups)) for fold in arm.folds if fold.single() is not None]
    return [(fold, built) for fold, built in found if built is not None]


def _times(what: str, above: Sequence[Time], below: Sequence[Time], paper: str = "") -> list[Row]:
    a, b = total(above), total(below)
    return [
        _ratio(f"{what}: time by counts", a.counted_s, b.counted_s, paper),
        _ratio(f"{what}: time by the clock", a.wall_s, b.wall_s),
    ]


def _ratio(what: str, part: float | None, whole: float | None, paper: str = "") -> Row:
    """One by the other; nothing where either was not measured, or nothing was counted."""
    known = None if part is None or not whole else part / whole
    return {"what": what, "paper": paper, "ratio": known}


def _sharing(arm: ArmResult) -> Iterator[Row]:
    """Fig. 8."""
    for robot in ROBOTS:
        yield from _held_out_pairs(
            arm, f"shared map against {robot}'s own", SHARED, robot, "better"
        )


def _held_out_pairs(arm: ArmResult, what: str, a: str, b: str, paper: str = "") -> Iterator[Row]:
    found = arm.held_out(a, b)
    if found is not None:
        ours, theirs = (one.drives for one in found)
        yield compared_drives(what, ours, theirs, arm.plan.options.seed, paper)


def _downloads(arm: ArmResult) -> Iterator[Row]:
    """Fig. 9."""
    seed, copied = arm.plan.options.seed, arm.forays(COPY)
    for policy, paper in (
        (TOD, "81.77 and 79.57 % (united)"),
        (TOD_PATHS, "74.56 and 66.57 % (united)"),
    ):
        driven, taken = arm.forays(policy), arm.downloads(policy)
        if not driven or len(driven) != len(copied):
            continue
        whole = sum(one.of_nodes for one in taken)
        what = f"second foray in one `{policy}` download"
        yield _ratio(f"{what}: nodes taken along", sum(one.nodes for one in taken), whole)
        united = sum(one.united for one in taken)
        yield _ratio(f"{what}: united with the robot's own", united, whole, paper)
        others = sum(one.policy != policy for one in taken)
        a, b = ([one.drive for one in some] for some in (driven, copied))
        row = compared_drives(f"{what} against `{COPY}`", a, b, seed, "slightly worse")
        yield {**row, "asked_for_more": others}
    trials = arm.trials()
    for name, other in (
        *((one, COPY) for one in (TOD, TOD_PATHS, QUARTER, TENTH)),
        (AS_TOD, TOD),
        (AS_TOD_PATHS, TOD_PATHS),
    ):
        others_of = {drive.session.id: one for drive, one in trials.get(other, [])}
        pairs = [
            (one, others_of[drive.session.id])
            for drive, one in trials.get(name, [])
            if drive.session.id in others_of
        ]
        if pairs:
            a, b = ([pair[k].drive for pair in pairs] for k in (0, 1))
            yield compared_drives(f"`{name}` against `{other}`, each for its drive", a, b, seed)


def _orders(arm: ArmResult) -> Iterator[Row]:
    """Fig. 10."""
    fold = arm.folds[0]
    found = fold.orders()
    if found is None:
        return
    count = f"{len(found['orders'])} orders of {len(fold.order_groups())} groups"
    for what, part, whole, paper in _order_times(fold, found):
        yield _ratio(f"{count}: {what}", part, whole, paper)
    driven = fold.held_out("orders-sequential")
    if driven and found["orders"]:
        row = {"what": "chosen order against one agent with the same drives"}
        missed = sum(one.drive.step_m[~one.drive.matched].sum() for one in driven)
        route = sum(one.drive.step_m.sum() for one in driven)
        chosen = found["orders"][0]["reported_missed"]
        yield {**row, "share_a": chosen, "share_b": float(missed / route), "drives": len(driven)}


def _order_times(
    fold: FoldResult, found: dict[str, Any]
) -> Iterator[tuple[str, float | None, float | None, str]]:
    """By (8), against a prefix tree, and one order really built; None for what is not timed."""
    groups = fold.order_groups()
    groups_s = total(fold.time_of(one) for one in groups).counted_s
    merges_s = fold.counted(
        Counts(found["replayed"], found["attempts"], found["proposed"], found["lookups"])
    )
    names = (
        "by (8) ÷ sequential", "as a prefix tree ÷ sequential",
        "as a prefix tree ÷ a sequential prefix tree",
        "later groups of one that was built ÷ (k − 1)·T_G of (8)",
    )  # fmt: skip
    if groups_s is None or merges_s is None:
        yield from ((name, None, None, "") for name in names)
        return
    group_s, merge_s = groups_s / len(groups), merges_s / max(found["merges"], 1)
    costs = order_costs(len(groups), group_s, merge_s, found["copy_s"] / max(found["copies"], 1))
    built = fold.sequential()
    rest_s = fold.time_of(built[len(groups[0]) :]).counted_s if built else None
    yield names[0], costs.model_s, costs.sequential_s, "22.44 %"
    yield names[1], costs.tree_s, costs.sequential_s, ""
    yield names[2], costs.tree_s, costs.sequential_tree_s, ""
    yield names[3], rest_s, (len(groups) - 1) * group_s, "100 % (assumed)"


_AT_M = (5.0, 10.0, 20.0)


def fleet_rows(arm: ArmResult) -> list[Row]:
    """All rows of one arm."""
    rows: list[Row] = []
    for fold in arm.folds:
        rows += _building_rows(fold)
        rows += _sharing_rows(fold)
        rows += _foray_rows(str(fold.fold.number), _forays(fold))
        rows += _trial_rows(str(fold.fold.number), _flat(fold.trials()))
        rows += _order_rows(fold)
    rows += _pooled_rows(arm)
    return _asked(arm, rows)


def session_rows(arm: ArmResult) -> list[Row]:
    """One row per held-out drive in each map and download: what intervals are drawn from."""
    rows: list[Row] = []
    drives = arm.plan.drives.drives
    for fold in arm.folds:
        number = str(fold.fold.number)
        for experiment, what, name in _shown(fold):
            for one in fold.held_out(name):
                about = _row(experiment, number, what) | {"drive": drives[one.session].name}
                rows.append(about | _held_out_rows([one]))
        for drive, trial in chain.from_iterable(fold.trials().values()):
            rows += [{**row, "drive": drive.name} for row in _trial_rows(number, [trial])]
    return _asked(arm, rows)


def _asked(arm: ArmResult, rows: Sequence[Row]) -> list[Row]:
    """Those of the requested experiments, with what they are about."""
    about = {
        "campaign": arm.plan.drives.name,
        "arm": arm.arm.letter,
        "policy": arm.arm.driving.ranking,
        "attempts": arm.configuration.budget.attempts if arm.arm.letter != "C" else "all",
    }
    return [{**about, **row} for row in rows if arm.asked(row["experiment"])]


def _shown(fold: FoldResult) -> Iterator[tuple[int, str, str]]:
    """Experiment, words and name of the maps that held-out drives are localised in."""
    yield 7, SINGLE, SINGLE
    for groups in fold.plan.group_counts(fold.fold):
        yield 7, f"{groups} groups", merged_name(groups, groups - 1)
        yield 7, f"{groups} groups, pairwise", pair_merges(groups)[-1].name
    for name in (*ROBOTS, SHARED):
        yield 8, name, name
    yield 10, "one order built sequentially", "orders-sequential"


def order_rows(arm: ArmResult) -> list[Row]:
    """One row per order of merging."""
    found = arm.folds[0].orders()
    if found is None or not arm.asked(10):
        return []
    return [
        {
            "campaign": arm.plan.drives.name,
            "arm": arm.arm.letter,
            "order": "-".join(map(str, one["order"])),
            "chosen": one["order"] == found["order"],
            "nodes": one["nodes"],
            "validation_area_m": one["area_m"],
            **{f"validation_p_gt_{at}m": p for at, p in one["at_m"].items()},
            **{f"p_gt_{at:g}m": one["reported"][round(2 * at)] for at in _AT_M},
            "share_not_localised": one["reported_missed"],
        }
        for one in found["orders"]
    ]


def _building_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 7."""
    number = str(fold.fold.number)
    single = fold.single()
    if single is not None:
        yield {
            **_row(7, number, SINGLE),
            **_mapped(single),
            **_time(fold.time_of(single)),
            **_held_out_rows(fold.held_out(SINGLE)),
        }
    for groups in fold.plan.group_counts(fold.fold):
        built = fold.parallel(groups)
        if built is None:
            continue
        merged, merges = merged_name(groups, groups - 1), total(built.merge_times)
        logs = sum(len(one) for one in built.groups)
        yield {
            **_row(7, number, f"{groups} groups"),
            "logs": logs,
            "nodes": built.nodes,
            **_time(built.time),
            "merges_counted_s": merges.counted_s,
            "merges_wall_s": merges.wall_s,
            **_held_out_rows(fold.held_out(merged)),
        }
        pairwise = built.pairwise_time
        if pairwise is not None:
            name = pair_merges(groups)[-1].name
            yield {
                **_row(7, number, f"{groups} groups, pairwise"),
                "logs": logs,
                "nodes": fold.nodes(name),
                **_time(pairwise),
                **_held_out_rows(fold.held_out(name)),
            }


def _sharing_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 8."""
    found = {name: fold.held_out(name) for name in (*ROBOTS, SHARED)}
    if all(found.values()):
        for name, held_out in found.items():
            row = _row(8, str(fold.fold.number), name)
            yield {**row, "nodes": fold.nodes(name), **_held_out_rows(held_out)}


def _forays(fold: FoldResult) -> list[InField]:
    return [one for some in fold.forays().values() for one in some]


def _foray_rows(number: str, forays: Sequence[InField]) -> Iterator[Row]:
    """Fig. 9: second forays in the field."""
    for policy in FORAY_POLICIES:
        some = [one for one in forays if one.policy == policy]
        if not some:
            continue
        frames = sum(one.frames for one in some)
        counted_s = total(one.time for one in some).counted_s
        yield {
            **_row(9, number, f"foray in {policy}"),
            "logs": len(some),
            "nodes": float(np.mean([one.nodes for one in some])),
            "ms_per_frame": sum(one.ms * one.frames for one in some) / frames,
            "counted_ms_per_frame": None if counted_s is None else 1e3 * counted_s / frames,
            **_failure([one.drive for one in some]),
        }


def _flat(trials: Trials) -> list[TriedDownload]:
    return [one for _, one in chain.from_iterable(trials.values())]


def _trial_rows(number: str, trials: Sequence[TriedDownload]) -> Iterator[Row]:
    """Fig. 9: downloads for the hours of held-out drives."""
    for name in dict.fromkeys(one.name for one in trials):
        some = [one for one in trials if one.name == name]
        lengths = np.array([route_m([one.drive]) for one in some])
        promised = np.array([one.expected_missed for one in some])
        yield {
            **_row(9, number, f"held out in {name}"),
            "nodes": float(np.mean([one.nodes for one in some])),
            "share_of_nodes": float(np.mean([one.nodes / one.of_nodes for one in some])),
            "united_share_of_nodes": float(np.mean([one.united / one.of_nodes for one in some])),
            "size_bytes": float(np.mean([one.size_bytes for one in some])),
            "ms_per_frame": float(np.mean([one.ms for one in some])),
            "lookup_ms_per_frame": float(np.mean([one.lookup_ms for one in some])),
            "lookups": sum(one.lookups for one in some),
            "expected_missed": float(promised @ lengths / lengths.sum()),
            **_failure([one.drive for one in some]),
        }


def _order_rows(fold: FoldResult) -> Iterator[Row]:
    """Fig. 10: the spread over the orders, on the sessions that chose nothing."""
    found = fold.orders()
    if found is None:
        return
    number = str(fold.fold.number)
    curves = np.array([one["reported"] for one in found["orders"]])
    missed = np.array([one["reported_missed"] for one in found["orders"]])
    for name, statistic in (("least", np.min), ("median", np.median), ("most", np.max)):
        yield {
            **_row(10, number, f"{name} of {len(curves)} orders"),
            "share_not_localised": float(statistic(missed)),
            **{f"p_gt_{at:g}m": float(statistic(curves[:, round(2 * at)])) for at in _AT_M},
        }
    yield {
        **_row(10, number, "best order, chosen on validation"),
        "nodes": found["orders"][0]["nodes"],
        "share_not_localised": float(missed[0]),
        **{f"p_gt_{at:g}m": float(curves[0, round(2 * at)]) for at in _AT_M},
    }
    built = fold.sequential()
    if built:
        yield {
            **_row(10, number, "one order built sequentially"),
            **_mapped(built),
            **_time(fold.time_of(built)),
            **_held_out_rows(fold.held_out("orders-sequential")),
        }


def _pooled_rows(arm: ArmResult) -> Iterator[Row]:
    groups = arm.plan.options.groups
    pairs = pair_merges(groups)[-1].name
    for experiment, name, what in (
        (7, SINGLE, SINGLE),
        (7, merged_name(groups, groups - 1), f"{groups} groups"),
        (7, pairs, f"{groups} groups, pairwise"),
    ):
        found = arm.held_out(name)
        if found is not None:
            yield {**_row(experiment, "all", what), **_result(found[0])}
    maps = (*ROBOTS, SHARED)
    for name, result in zip(maps, arm.held_out(*maps) or (), strict=False):
        yield {**_row(8, "all", name), **_result(result)}
    yield from _foray_rows("all", [one for policy in FORAY_POLICIES for one in arm.forays(policy)])
    yield from _trial_rows("all", _flat(arm.trials()))


def _row(experiment: int, fold: str, name: str) -> Row:
    return {"experiment": experiment, "fold": fold, "map": name}


def _mapped(sessions: Sequence[BuiltSession]) -> Row:
    return {
        "logs": len(sessions),
        "nodes": sessions[-1].nodes,
        "frames": sum(one.frames for one in sessions),
        "match_attempts": sum(one.attempts for one in sessions),
        "proposed_attempts": sum(one.proposed for one in sessions),
        "lookups": sum(one.lookups for one in sessions),
    }


def _time(time: Time) -> Row:
    return {"counted_s": time.counted_s, "wall_s": time.wall_s}


def _held_out_rows(sessions: Sequence[SessionResult]) -> Row:
    if not sessions:
        return {}
    drives = [one.drive for one in sessions]
    frames = sum(one.frames for one in sessions)
    return {
        **_failure(drives),
        "attempts_per_frame": sum(one.attempts for one in sessions) / frames,
        "false_successes": sum(int(one.errors.false.sum()) for one in sessions),
    }


def _result(found: ConfigurationResult) -> Row:
    return _held_out_rows(found.sessions)


def _failure(drives: Sequence[Drive]) -> Row:
    return {
        "sessions": len(drives),
        "driven_m": route_m(drives),
        "share_not_localised": route_not_localised(drives),
        **{f"p_gt_{at:g}m": float(failure(drives, at)) for at in _AT_M},
        "longest_gap_m": longest_gap_m(drives),
    }


_TITLES = {
    7: "Building side by side (Fig. 7)",
    8: "Sharing (Fig. 8)",
    9: "Taking a part (Fig. 9)",
    10: "Orders of merging (Fig. 10)",
}
# What stands beside every table, of each kind of step.
_BUDGET = {"drive.ranking": "policy", "drive.lanes": "Np", "drive.rounds": "Nr"}
_SHOWN = {
    "maps": {**_BUDGET, "mapper.sure_inliers": "sure inliers"},
    "merges": {
        "merge.ranking": "policy",
        "merge.lanes": "Np",
        "merge.rounds": "Nr",
        "merge.relocaliser": "relocaliser",
        "merge.sure_inliers": "sure inliers",
        "merge.unit": "unit",
        "merge.seed": "seed",
    },
    "held out": _BUDGET,
    "downloads": {
        "download.window_min": "window min",
        "download.epoch_min": "epoch min",
        "download.best_percent": "best %",
    },
    "orders": {"build.max_gap_m": "judged at m", "build.estimator": "over"},
}
# Tables and settings that the study reads.
_USED = {one.name for one in fields(Settings)} | {*VERBS, *OF_DRIVE} - {"drive"}
_COLUMNS = {
    "arm": "arm",
    "map": "map",
    "nodes": "nodes",
    "share_of_nodes": "of all nodes",
    "united_share_of_nodes": "united with the robot's own",
    "share_not_localised": "route not localised",
    "expected_missed": "forecast",
    "p_gt_5m": "P(> 5 m)",
    "p_gt_10m": "P(> 10 m)",
    "ms_per_frame": "ms per frame",
    "sessions": "drives",
}


def write_fleet_report(out: Path, plans: Sequence[FleetPlan]) -> list[Path]:
    """Tables, comparisons, figures, the page and the resolved configuration, of what was run.

    Returns:
        The files written.
    """
    arms = [ArmResult(plan, arm) for plan in plans for arm in plan.arms]
    make_folder(out)
    tables = {
        "in_force": [row for arm in arms for row in _in_force_rows(arm)],
        "summary": [row for arm in arms for row in fleet_rows(arm)],
        "sessions": [row for arm in arms for row in session_rows(arm)],
        "orders": [row for arm in arms for row in order_rows(arm)],
        "comparisons": [row for arm in arms for row in comparison_rows(arm)],
    }
    return write_study(
        out,
        tables,
        _page(arms, tables["summary"], tables["comparisons"]),
        [_configuration(plan) for plan in plans],
        lambda folder: draw_fleet_figures(folder, arms),
    )


def _page(
    arms: Sequence[ArmResult], rows: Sequence[Row], comparisons: Sequence[Row]
) -> Iterator[str]:
    for name in dict.fromkeys(arm.plan.drives.name for arm in arms):
        own = [arm for arm in arms if arm.plan.drives.name == name]
        yield from (f"## {name}", "", _protocol(own[0]), "")
        yield from (_medians(arm) for arm in own if arm.stages is not None)
        yield from (line for arm in own for line in _exceptions(arm))
        yield from unused(own[0].plan.tables, _USED)
        beside = "\n".join(line for arm in own if (line := _in_words(arm)))
        for number, title in _TITLES.items():
            # The orders are tried on one fold; all else is pooled.
            fold = "0" if number == 10 else "all"
            shown = chosen(rows, campaign=name, experiment=number, fold=fold)
            claims = chosen(comparisons, campaign=name, experiment=number)
            if shown or claims:
                yield from ("", f"### {title}", "")
                columns = {
                    key: words
                    for key, words in _COLUMNS.items()
                    if any(row.get(key) is not None for row in shown)
                }
                yield from table(shown, columns, beside)
                yield from table(claims, {"arm": "arm", **COMPARED, "drives": "drives"}, beside)


def _in_force_rows(arm: ArmResult) -> Iterator[Row]:
    """What each kind of step of an arm ran by."""
    for name, known in arm.in_force().items():
        about = {"campaign": arm.plan.drives.name, "arm": arm.arm.letter, "of": name}
        yield from in_force_rows(known, arm.plan.tables, about)


def _exceptions(arm: ArmResult) -> Iterator[str]:
    """What of the settings does not hold in an arm."""
    for name, known in arm.in_force().items():
        for line in exceptions(known, arm.plan.tables):
            yield f"- Arm {arm.arm.letter}, {name}, {line}."


def _in_words(arm: ArmResult) -> str:
    """What is in force in an arm, with its rows; empty where nothing was run."""
    known = arm.in_force()
    parts = [in_words(known.get("held out", {}))]
    for name, keys in _SHOWN.items():
        some = known.get(name, {})
        told = ", ".join(f"{words} {some[key]}" for key, words in keys.items() if key in some)
        parts += [f"{name.capitalize()}: {told}."] if told else []
    told = " ".join(filter(None, parts))
    return f"- Arm {arm.arm.letter}. {told}" if told else ""


def _protocol(arm: ArmResult) -> str:
    """How many logs there were: [G16]'s protocols are scaled to them."""
    fold = arm.plan.folds[0]
    protocol, groups = arm.plan.protocol(fold), arm.plan.groups(fold, arm.plan.options.groups)
    return (
        f"{len(arm.plan.drives.drives)} drives, {arm.plan.options.folds} folds, "
        f"{len(fold.training)} training drives in the first; {len(groups)} groups of "
        f"{len(groups[-1])} to {len(groups[0])} (Fig. 7); forays of {protocol.foray} (7 in the "
        f"paper; Figs. 8 and 9); groups of {protocol.group} (9 in the paper) for the orders, "
        f"chosen on {protocol.validation} validation drives (Fig. 10). Saving, front-end and "
        "odometry are not counted: every drive passes through them once whichever way a map is "
        "built. Shares are of the route that is not localised; intervals are 90 % over sessions."
    )


def _medians(arm: ArmResult) -> str:
    assert arm.stages is not None
    return (
        f"- Arm {arm.arm.letter}, {arm.arm.words}: medians on one core {arm.stages.frame_ms:.2f} "
        f"ms a frame, {arm.stages.attempt_ms:.2f} ms an attempt, {arm.stages.proposed_ms:.2f} ms "
        f"one of a lost robot at a proposed node, {arm.stages.lookup_ms:.2f} ms a look-up."
    )


def _configuration(plan: FleetPlan) -> dict[str, object]:
    """With the medians that counts are turned into times by."""
    paths = {arm.letter: stages_path(plan, arm) for arm in plan.arms}
    stages = {letter: read_json(path) for letter, path in paths.items() if path.exists()}
    return {**plan.configuration(), "stages_ms": stages}
