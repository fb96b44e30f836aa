"""What was run of a fleet study, read back: per arm and fold, whatever is there."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

from engram.measures import Drive
from engram_lab.studies.building import BuiltSession, read_record
from engram_lab.studies.configurations import Configuration
from engram_lab.studies.drives import EvaluatedDrive, Fold
from engram_lab.studies.fleet.experiments import merged_name, pair_merges
from engram_lab.studies.fleet.plan import (
    FORAY_POLICIES,
    ROBOTS,
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
    Counts,
    StageTimes,
    TriedDownload,
    field_path,
    map_path,
    read_stages,
    read_trials,
    runs_path,
)
from engram_lab.studies.in_force import Values, common
from engram_lab.studies.lockstep import read_runs
from engram_lab.studies.summary import ConfigurationResult, SessionResult, session_result


@dataclass(frozen=True, slots=True)
class Time:
    """What something took.

    Attributes:
        counted_s: counts of frames, attempts and look-ups × medians measured once; None where
            these were not measured yet.
        wall_s: as it was met, on whatever else the machine did.
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
    """A parallel build of one fold.

    Attributes:
        groups: sessions of each group, as they were mapped.
        merges: one after another into the first group's map.
        group_times, merge_times: of the same.
        pairs: the merges of the pairwise tree by level, and their times; empty if not made.
    """

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
    """One drive of a second foray, localised while it was mapped.

    Attributes:
        robot, policy: whose, and in which download.
        nodes: of the robot's map after it.
        drive: steps and matches.
        ms: mean time of localising a frame.
        time: what mapping it took.
        frames: how many.
    """

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
        """Of each download, for a foray or a held-out drive."""
        for path in self._folder.glob("*.download.json"):
            yield DownloadRecord(**read_json(path)).in_force
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
