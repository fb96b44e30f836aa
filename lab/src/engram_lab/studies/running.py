"""Builds the maps of all folds and runs every configuration on every held-out session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from engram.config import to_dict
from engram.errors import ConfigError
from engram.localiser.attempts import Lanes, Matcher
from engram.localiser.settings import LocaliserConfig
from engram.maps.map import Map, open_map
from engram.monitor import QUIET, Monitor
from engram.ranking.policies import policy_named
from engram.robot.settings import RobotOptions, Settings
from engram.sequences.sequence import LoggedFrame
from engram_lab.policies import STUDIED
from engram_lab.studies.building import (
    GENEROUS,
    BuiltMap,
    build_map,
    read_built_map,
    read_record,
    true_nodes,
)
from engram_lab.studies.configurations import (
    BY_TRUTH,
    DEFAULT_LANES,
    FEW_LANES,
    Configuration,
    map_sizes,
    sweep,
)
from engram_lab.studies.drives import DriveSet, EvaluatedDrive, Fold, KeptMaps, start_by_matching
from engram_lab.studies.in_force import check_logs, check_lost
from engram_lab.studies.lockstep import (
    MatchMemo,
    Runs,
    Situation,
    joined,
    missing,
    only,
    read_runs,
    run_in_step,
    write_runs,
)
from engram_lab.studies.plan import StudyOptions, StudyPlan, Task, all_tables, study_folder


def localise_held_out(
    opened: Map,
    drive: EvaluatedDrive,
    frames: Sequence[LoggedFrame],
    training: Sequence[EvaluatedDrive],
    configurations: Sequence[Configuration],
    settings: Settings,
    matcher: Matcher | None,
    relocaliser: str | None,
    threads: int | None = None,
) -> Runs:
    """Localises a drive with every configuration, from the node nearest by truth.

    Where truth is not known, its own or that of every node, it starts at its first frame that
    matches any node.

    Args:
        matcher: makes the matches, unguided; None for the localiser's own, guided ones.
        relocaliser: as of `StudyOptions`; None leaves the lost to what is near.
        threads: most threads that a robot's lanes share; None for one each.
    """
    nodes, truth = true_nodes(opened, training), drive.truth()
    if relocaliser == BY_TRUTH and truth is None:
        raise ConfigError(f"{drive.name}: its truth is not known, which is to find it where lost")
    first = None if truth is None else truth.at(frames[0].frame.stamp_ns)
    position = None if first is None else nodes.start(first)
    start = None if position is None else (0, position)
    if start is None:
        config = settings.localiser
        start = start_by_matching(
            opened,
            frames,
            drive.session.id,
            Lanes(opened.frames, config.matcher) if matcher is None else matcher,
            config.acceptance,
        )
    situation = Situation(opened, drive, frames, start, nodes, truth)
    memo = matcher if isinstance(matcher, MatchMemo) else None
    cost = (lambda: 0.0) if memo is None else (lambda: memo.seconds)
    made, before_s = (0, 0.0) if memo is None else (memo.made, memo.seconds)
    runs = run_in_step(situation, configurations, settings, matcher, relocaliser, cost, threads)
    if memo is not None and memo.made > made:
        runs.attempt_ms[:] = 1e3 * (memo.seconds - before_s) / (memo.made - made)
    return runs


# Policies that cannot run without knowing the outcomes.
_BOUNDS = ("oracle",)
_SMALL_CACHE_BYTES = 4 * 2**20


@dataclass(frozen=True, slots=True)
class RankingOptions(StudyOptions):
    """What an evaluation of ranking policies runs.

    Attributes:
        live_folds: folds whose sessions are also run guided and without memo, at Np = 2: that
            confirms the order of policies and gives milliseconds per frame.
    """

    policies: tuple[str, ...] = STUDIED
    lanes: tuple[int, ...] = DEFAULT_LANES
    rounds: tuple[int, ...] = (1, 2)
    map_sizes: bool = True
    live_folds: int = 1
    build: RobotOptions = field(default_factory=lambda: GENEROUS)

    def __post_init__(self) -> None:
        StudyOptions.__post_init__(self)
        for name in ("policies", "lanes", "rounds", "only_folds"):
            once = tuple(dict.fromkeys(getattr(self, name)))
            object.__setattr__(self, name, once)  # what is named twice is run once
        for policy in self.policies:
            policy_named(policy)  # refuses what is none
        for name, values in (("lanes", self.lanes), ("rounds", self.rounds)):
            if not values or min(values) < 1:
                raise ConfigError(f"{name} are {values}, must be whole numbers from 1 on")

    @property
    def few_lanes(self) -> int:
        """Np of the figures that show one budget: 2 where that is run."""
        return FEW_LANES if FEW_LANES in self.lanes else self.lanes[0]

    def wanted(self, training: int, config: LocaliserConfig) -> tuple[Configuration, ...]:
        """What is run of a drive, in a map of so many training drives and in earlier ones."""
        whole = sweep(self.policies, self.lanes, self.rounds, config)
        if not self.map_sizes:
            return whole
        earlier = map_sizes(self.policies, self.few_lanes, training, self.rounds[0])
        return (*whole, *earlier)


@dataclass(frozen=True, slots=True)
class Plan(StudyPlan[RankingOptions]):
    """All that a worker needs."""

    def map_path(self, fold: Fold) -> Path:
        """The map built from a fold's training sessions."""
        return self.work / f"fold{fold.number}.engram"

    def runs_path(self, session: int, mode: str) -> Path:
        """Results of one held-out session; `mode` is "memo" or "live".

        Maps and matches serve every relocaliser, results are its own.
        """
        with_it = "" if self.options.relocaliser is None else f"-{self.options.relocaliser}"
        return self.work / f"{mode}{with_it}-{self.drives.drives[session].key}.npz"

    def live_threads(self) -> int:
        """Threads of the lanes of a robot that is timed."""
        threads = self.tables.drive.threads
        return RobotOptions(lanes=self.options.few_lanes, threads=threads).lane_threads()


def make_plan(drives: DriveSet, settings: Settings, options: RankingOptions, work: Path) -> Plan:
    """A plan; its folder below `work` depends on all that its maps and results depend on.

    More policies, lanes or relocalisers may be run later, and find there what was done.
    """
    check_logs(settings, drives)
    check_lost(settings, options.relocaliser)
    tables = all_tables(settings, drives.drives[0].descriptor)
    settings = tables.of_robot()
    depends = (drives.hash, to_dict(options.build), options.folds, options.seed)
    folder = study_folder(work, drives.name, depends, settings)
    plan = Plan(drives, settings, options, folder, tables)
    plan.live_threads()  # refuses too few before anything is run
    plan.begin()
    return plan


def run(plan: Plan, workers: int = 1, monitor: Monitor = QUIET) -> None:
    """Builds, runs, and leaves the results in the plan's folder; what is there is kept.

    Fold by fold: sessions are run as soon as their map is built. Results do not depend on the
    number of workers. Killed or interrupted, the same call continues.
    """
    plan.run(_tasks(plan), workers, monitor, _earlier_maps.close)


def _tasks(plan: Plan) -> list[Task]:
    """Fold by fold: sessions before the next map, so that what is done can be looked at."""
    tasks = []
    for fold in plan.run_folds:
        built = f"build {fold.number}"
        tasks.append(Task(built, partial(_build, plan, fold), word="built"))
        tasks += [
            Task(f"run {session}", partial(_run_session, plan, fold, session), (built,), "run")
            for session in fold.held_out
        ]
    for fold in plan.run_folds[: plan.options.live_folds]:
        for session in fold.held_out:
            work = partial(_run_live, plan, fold, session)
            tasks.append(Task(f"time {session}", work, (), "timed", alone=True))
    return tasks


def forget(plan: Plan, policies: Sequence[str]) -> None:
    """Drops the results of some policies, whose code has changed; maps and matches stay.

    Only those of the folds that are run: others would be missed by a report that takes in all.
    """
    for session in (session for fold in plan.run_folds for session in fold.held_out):
        for mode in ("memo", "live"):
            path = plan.runs_path(session, mode)
            runs = read_runs(path)
            if runs is not None:
                kept = {one for one in runs.configurations if one.policy not in policies}
                write_runs(path, only(runs, kept))


def _build(plan: Plan, fold: Fold) -> None:
    build_map(plan.map_path(fold), plan.training(fold), plan.settings, plan.options.build)


def _run_session(plan: Plan, fold: Fold, session: int) -> None:
    """All that is missing of one held-out session."""
    drive = plan.drives.drives[session]
    path = plan.runs_path(session, "memo")
    done = read_runs(path)
    wanted = missing(done, plan.options.wanted(len(fold.training), plan.settings.localiser))
    # The whole map first: what is matched there, maps of fewer drives need not match again.
    counts = sorted({one.sessions for one in wanted}, key=lambda count: (count is not None, count))
    if not wanted:
        return
    built = read_built_map(plan.map_path(fold))
    # The newest map's landmarks: earlier revisions have no others.
    with open_map(built.path) as newest:
        memo = MatchMemo.of(newest, drive, plan.settings, plan.work)
        frames = drive.frames()
        run_one = partial(_run_in, plan, fold, session, frames, memo)
        for count in counts:
            some = [one for one in wanted if one.sessions == count]
            opened = newest
            if count is not None:
                opened = _earlier_maps.open(built.path, built.revision_after(count))
            done = joined(done, run_one(opened, some))
            if count in (None, counts[-1]):
                memo.save()
                write_runs(path, done)


# Their landmarks are hardly ever read: the memo asks the newest map.
_earlier_maps = KeptMaps(files=1, cache_bytes=_SMALL_CACHE_BYTES)  # one per worker


def _run_live(plan: Plan, fold: Fold, session: int) -> None:
    """Guided, with every match made as on a robot."""
    path = plan.runs_path(session, "live")
    done = read_runs(path)
    policies = [one for one in plan.options.policies if one not in _BOUNDS]
    few, rounds = plan.options.few_lanes, plan.options.rounds[0]
    wanted = missing(done, [Configuration(one, few, rounds) for one in policies])
    if not wanted:
        return
    frames = plan.drives.drives[session].frames()
    for configuration in wanted:  # one after another: each has the machine for itself
        with open_map(read_built_map(plan.map_path(fold)).path) as opened:
            about = plan, fold, session, frames, None, opened, [configuration]
            runs = _run_in(*about, threads=plan.live_threads())
            done = joined(done, runs)
    assert done is not None
    write_runs(path, done)


def _run_in(
    plan: Plan,
    fold: Fold,
    session: int,
    frames: Sequence[LoggedFrame],
    matcher: Matcher | None,
    opened: Map,
    configurations: Sequence[Configuration],
    threads: int | None = None,
) -> Runs:
    """One session in one map."""
    return localise_held_out(
        opened,
        plan.drives.drives[session],
        frames,
        plan.training(fold),
        configurations,
        plan.settings,
        matcher,
        plan.options.relocaliser,
        threads,
    )


def built_map(plan: Plan, fold: Fold) -> BuiltMap:
    """A fold's map, as far as its record says that it is built."""
    return read_record(plan.map_path(fold))
