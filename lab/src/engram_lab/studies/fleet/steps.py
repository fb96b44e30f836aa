"""The steps of the fleet study: map, merge, download, localise; what each costs, and all orders.

A map is changed in a copy that takes its place when the step is whole, so that a study that was
killed here and there has the same maps as one that was not.

Downloads for the hour of each held-out drive, tried out on it ([G16] Fig. 9, method §7). All are
without thumbnails, so that equal bytes are equal: `budget` sends none unless it is told to, the
others do, and thumbnails are a tenth of a map.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from engram.errors import InputError
from engram.fleet.build.building import find_best_order
from engram.fleet.build.orders import JudgeOptions
from engram.fleet.download.downloading import DownloadReport, download
from engram.fleet.download.mission import DownloadOptions, DownloadSettings
from engram.fleet.merge.merging import merge as merge_maps
from engram.graph.clock import hour_of_day
from engram.graph.model import Node, SessionId, node_id, path_id
from engram.localiser.acceptance import accept_lost
from engram.localiser.attempts import Lanes
from engram.localiser.localisation import Localisation, Position
from engram.localiser.relocalisation import Relocaliser
from engram.maps.map import Map, open_map
from engram.maps.map_files import copy_map
from engram.measures import Drive
from engram.monitor import QUIET
from engram.robot.front import arriving
from engram.robot.localisers import DriveSequence, relocaliser_in, session_of_drive
from engram.robot.mapping import MapReport
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measured, robot_on
from engram.sequences.framelog.reader import FrameLog
from engram_lab.studies.building import build_map, newest_in_force, true_nodes, write_json
from engram_lab.studies.configurations import Configuration
from engram_lab.studies.drives import EvaluatedDrive, Fold, KeptMaps
from engram_lab.studies.fleet.plan import (
    Arm,
    DownloadRecord,
    FleetPlan,
    MergeRecord,
    read_json,
    write_drive,
    write_record,
)
from engram_lab.studies.in_force import Values, of_revision
from engram_lab.studies.lockstep import MatchMemo, joined, missing, read_runs, write_runs
from engram_lab.studies.running import localise_held_out
from engram_lab.trial import Trial, try_downloads

# Stages that are the robot's own business, whatever map it has.
_BEFORE_THE_MAP = ("read", "frontend", "odometry", "doctor")
_ASKS_FOR_MORE = {"tod+paths": "tod", "tod": "copy"}
# The next drive is localised in the same ones.
kept_maps = KeptMaps(files=6, cache_bytes=64 * 2**20)  # one per worker


def map_path(plan: FleetPlan, arm: Arm, fold: Fold, name: str) -> Path:
    """A map of the study."""
    return plan.folder(arm, fold) / f"{name}.engram"


def runs_path(plan: FleetPlan, arm: Arm, fold: Fold, name: str, drive: EvaluatedDrive) -> Path:
    """How a held-out drive was localised in a map."""
    return plan.folder(arm, fold) / f"runs-{name}-{drive.key}.npz"


def field_path(plan: FleetPlan, arm: Arm, fold: Fold, name: str, drive: EvaluatedDrive) -> Path:
    """How a drive was localised while it was mapped."""
    return plan.folder(arm, fold) / f"field-{name}-{drive.key}.npz"


def map_drives(
    plan: FleetPlan,
    arm: Arm,
    fold: Fold,
    name: str,
    drives: Sequence[EvaluatedDrive],
    base: str | None = None,
) -> None:
    """Adds drives to a map, one after another, as far as they are missing.

    Args:
        base: name of the map that it begins as a copy of; None for an empty one.
    """
    path = map_path(plan, arm, fold, name)
    path.parent.mkdir(parents=True, exist_ok=True)

    def look_at(drive: EvaluatedDrive, report: MapReport) -> None:
        steps = measured(report.results)
        frame_ms = [
            sum(ms for stage, ms in one.stage_ms.items() if stage not in _BEFORE_THE_MAP)
            for one in report.results
        ]
        write_drive(field_path(plan, arm, fold, name, drive), steps, frame_ms)

    build_map(
        path,
        drives,
        plan.settings,
        arm.driving,
        base=None if base is None else map_path(plan, arm, fold, base),
        known=plan.training(fold),
        look_at=look_at,
    )


def merge(plan: FleetPlan, arm: Arm, fold: Fold, name: str, centre: str, robot: str) -> None:
    """Makes a map by merging one map into a copy of another."""
    path = map_path(plan, arm, fold, name)
    record = path.with_suffix(".merge.json")
    if path.exists() and record.exists():
        return
    draft = _draft(path)
    copy_map(map_path(plan, arm, fold, centre), draft)
    (report,) = merge_maps(
        draft,
        [map_path(plan, arm, fold, robot)],
        arm.merging,
        settings=plan.settings,
    )
    if report.interrupted:
        raise KeyboardInterrupt
    with Map.open(draft) as store:
        nodes = store.node_count()
    made = MergeRecord(
        name=robot,
        nodes=nodes,
        components=report.components,
        taken=report.taken,
        omitted=report.omitted,
        frames=sum(one.taken + one.omitted for one in report.segments),
        attempts=report.match_attempts,
        proposed=report.proposed_attempts,
        lookups=report.lookups,
        seconds=report.seconds,
        in_force=newest_in_force(draft),
    )
    write_record(record, made)
    draft.replace(path)


def download_for_foray(
    plan: FleetPlan,
    arm: Arm,
    fold: Fold,
    name: str,
    centre: str,
    policy: str,
    own: Sequence[EvaluatedDrive],
    mission: Sequence[EvaluatedDrive],
) -> None:
    """What a robot takes along to its second foray; the mission starts with its first drive."""
    path = map_path(plan, arm, fold, name)
    record = path.with_suffix(".download.json")
    if path.exists() and record.exists():
        return
    session = mission[0].session
    hour = hour_of_day(session, session.start_ns)
    whole = map_path(plan, arm, fold, centre)
    draft = _draft(path)
    asked = plan.tables.download
    report = _downloaded(whole, draft, asked, policy if hour is not None else "copy", hour)
    paths = {path_id(one.session.id) for one in own}
    with Map.open(whole) as store:
        mine = {node.id for node in store.load().nodes if path_id(node.session) in paths}
    with Map.open(draft) as store:
        sent = {node.id for node in store.load().nodes}
    made = DownloadRecord(
        report.select, hour, report.nodes, report.of_nodes, len(mine | sent), report.size_bytes,
        report.of_bytes, newest_in_force(draft),
    )  # fmt: skip
    write_record(record, made)
    draft.replace(path)


def _downloaded(
    whole: Path, draft: Path, asked: DownloadSettings, policy: str, hour: float | None
) -> DownloadReport:
    """What a robot gets: where nothing was driven at such an hour it asks for more."""
    try:
        strict = policy in _ASKS_FOR_MORE
        options = DownloadOptions.of(asked, policy, depart_h=hour, arrive_h=hour, strict=strict)
        return download(whole, draft, options)
    except InputError:
        if policy not in _ASKS_FOR_MORE:
            raise
        return _downloaded(whole, draft, asked, _ASKS_FOR_MORE[policy], hour)


def localise_in(
    plan: FleetPlan, arm: Arm, fold: Fold, drive: EvaluatedDrive, names: Sequence[str]
) -> None:
    """Localises a held-out drive in several maps; what they have in common is matched once."""
    frames = None
    for name in names:
        path = runs_path(plan, arm, fold, name, drive)
        wanted = missing(read_runs(path), [arm.configuration])
        if not wanted:
            continue
        frames = frames or drive.frames()
        opened = kept_maps.open(map_path(plan, arm, fold, name))
        memo = MatchMemo.of(opened, drive, plan.settings, plan.folder(arm, fold))
        runs = localise_held_out(
            opened, drive, frames, plan.training(fold), wanted, plan.settings, memo,
            plan.options.relocaliser,
        )  # fmt: skip
        memo.save()
        write_runs(path, joined(read_runs(path), runs))


def _draft(path: Path) -> Path:
    """Where a map is made; what a killed run left there goes."""
    draft = path.with_name(f"{path.stem}.draft{path.suffix}")
    for left in path.parent.glob(f"{draft.name}*"):
        left.unlink()
    return draft


# Enough for medians.
_DRIVES = 5
_FRAMES = 80
_LOST_FRAMES = 5  # each drive begins lost, so that all ask for places
_ROUNDS = 8
_PASSES = 5
_LOST_PLACES = 10  # of each drive, at which the lost attempt what is proposed
_PROPOSED = 16
_FRAME_STAGES = ("neighbourhood", "rank", "remember")


@dataclass(frozen=True, slots=True)
class Counts:
    """What was done, on whatever machine."""

    frames: int
    attempts: int
    proposed: int
    lookups: int


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Medians on one core.

    Attributes:
        proposed_ms: of one in vain at a node that was proposed to a lost robot. Of the many that
            it makes one at most finds it; that one costs more.
    """

    frame_ms: float
    attempt_ms: float
    proposed_ms: float
    lookup_ms: float

    def seconds(self, counts: Counts) -> float:
        """What so many take."""
        ms = (
            counts.frames * self.frame_ms
            + (counts.attempts - counts.proposed) * self.attempt_ms
            + counts.proposed * self.proposed_ms
            + counts.lookups * self.lookup_ms
        )
        return ms / 1e3


def stages_path(plan: FleetPlan, arm: Arm) -> Path:
    """Where an arm's medians are kept.

    Not as ``stages.json``: those of before left the lost's attempts to what held-out drives met.
    """
    return plan.work / f"arm-{arm.letter}" / "medians.json"


def read_stages(plan: FleetPlan, arm: Arm) -> StageTimes | None:
    """An arm's medians; None if they were not measured yet."""
    path = stages_path(plan, arm)
    return StageTimes(**read_json(path)) if path.exists() else None


def measure_stages(plan: FleetPlan, arm: Arm, fold: Fold, name: str) -> None:
    """Localises some held-out drives attempt by attempt, and keeps the medians; once per arm.

    A few times over: of each stage the lowest median counts, since what else the machine does is
    none of the arm's.
    """
    path = stages_path(plan, arm)
    if path.exists():
        return
    rounds = min(arm.driving.budget.attempts, _ROUNDS)
    options = replace(arm.driving, lanes=1, rounds=rounds, threads=None)
    drives, centre = plan.held_out(fold), map_path(plan, arm, fold, name)
    chosen = [one.path for one in drives[:: max(len(drives) // _DRIVES, 1)][:_DRIVES]]
    passes = [medians(chosen, centre, plan.settings, options) for _ in range(_PASSES)]
    write_record(path, StageTimes(**{one: min(made[one] for made in passes) for one in passes[0]}))


def medians(
    drives: Sequence[Path], centre: Path, settings: Settings, options: RobotOptions
) -> dict[str, float]:
    """What each stage takes, in one pass.

    Returns:
        Medians by the names of `StageTimes`, ms; 0 for what did not happen.
    """
    taken_ms: dict[str, list[float]] = {one.name: [] for one in fields(StageTimes)}
    for drive in drives:
        log = FrameLog(drive)
        with (
            open_map(centre) as opened,
            robot_on(opened, log, settings, options) as robot,
            closing(arriving(log)) as frames,
        ):
            for number, arrived in enumerate(islice(frames, _FRAMES)):
                found = robot.step(arrived)
                if number < _LOST_FRAMES:
                    robot.lose()
                for stage, ms in _stages_of(found):
                    taken_ms[stage].append(ms)
            if options.relocaliser is not None:
                relocaliser = relocaliser_in(opened, options.relocaliser, log.header.descriptor)
                taken_ms["proposed_ms"] += _in_vain_ms(opened, log, settings, relocaliser)
        log.close()
    return {name: float(np.median(some)) if some else 0.0 for name, some in taken_ms.items()}


def _stages_of(one: Localisation) -> Iterator[tuple[str, float]]:
    """The stages of a frame; without attempts if the robot was lost."""
    yield "frame_ms", sum(one.stage_ms.get(stage, 0.0) for stage in _FRAME_STAGES)
    if one.attempts and not one.proposed:
        yield "attempt_ms", one.stage_ms["attempts"] / one.attempts
    if "places" in one.stage_ms:
        yield "lookup_ms", one.stage_ms["places"]


def _in_vain_ms(
    opened: Map, log: FrameLog, settings: Settings, relocaliser: Relocaliser
) -> Iterator[float]:
    """Each attempt that does not find a robot which is lost here and there along its drive.

    Not left to chance: where all held-out drives are found at once there would be none. The
    landmarks are in memory, as they are for those who are lost for a while.
    """
    landmarks, acceptance = opened.frames, settings.localiser.acceptance
    matcher = Lanes(landmarks, settings.localiser.lost_matcher)
    session = session_of_drive(log).id
    for logged in islice(log, 0, None, max(len(log) // _LOST_PLACES, 1)):
        live = logged.frame
        live_id = node_id(session, live.stamp_ns)
        relocaliser.forget()
        for index in relocaliser.propose(live, _PROPOSED, lambda _: True):
            node = opened.graph.node(index).id
            landmarks.frame(node)
            started = perf_counter()
            match = matcher.match(live, live_id, node, None)
            spread = partial(matcher.spread, live, live_id, node, match)
            if not accept_lost(match, spread, acceptance):
                yield 1e3 * (perf_counter() - started)


COPY = "copy"
TOD = "tod"
TOD_PATHS = "tod+paths"
QUARTER = "budget 1/4"
TENTH = "budget 1/10"
AS_TOD = "budget as tod"
AS_TOD_PATHS = "budget as tod+paths"
_BY_HOUR = (TOD, TOD_PATHS)


@dataclass(frozen=True, slots=True, eq=False)
class TriedDownload:
    """One held-out drive in one download.

    Attributes:
        expected_missed: share of the way without a match, as promised.
    """

    name: str
    nodes: int
    of_nodes: int
    united: float
    size_bytes: int
    expected_missed: float
    drive: Drive
    ms: float
    lookup_ms: float
    lookups: int
    in_force: Values = field(default_factory=dict)


def trials_path(plan: FleetPlan, arm: Arm, fold: Fold, drive: EvaluatedDrive) -> Path:
    """Where the trials of one held-out drive are kept."""
    return plan.folder(arm, fold) / f"downloads-{drive.key}.json"


def try_downloads_for(
    plan: FleetPlan, arm: Arm, fold: Fold, name: str, drive: EvaluatedDrive
) -> None:
    """All kinds of download of one map for one held-out drive."""
    path = trials_path(plan, arm, fold, drive)
    if _kept(path) is not None:
        return
    centre = map_path(plan, arm, fold, name)
    trials = partial(
        try_downloads,
        centre,
        drives=[lambda: FrameLog(drive.path)],
        settings=plan.settings,
        localise=arm.driving,
        start=partial(_start, plan, fold, drive),
    )
    wanted = partial(DownloadOptions.of, plan.tables.download, thumbnails=False)
    found, refused = trials({COPY: wanted(COPY)}), {}
    if hour_of_day(drive.session, drive.session.start_ns) is not None:
        for one in _BY_HOUR:
            try:
                found += trials({one: wanted(one)})
            except InputError as error:  # nothing was driven at such an hour
                refused[one] = str(error)
    sizes = {one.name: one.report.size_bytes for one in found}
    budgets = {QUARTER: sizes[COPY] // 4, TENTH: sizes[COPY] // 10}
    budgets |= {
        asked: sizes[like]
        for asked, like in ((AS_TOD, TOD), (AS_TOD_PATHS, TOD_PATHS))
        if like in sizes
    }
    for one, room in budgets.items():
        try:
            found += trials({one: wanted("budget", budget_bytes=room)})
        except InputError as error:  # a map so small that a part of it has no room for a node
            refused[one] = str(error)
    own = [
        {one.session.id for foray in forays for one in foray}
        for forays in plan.forays(fold).values()
    ]
    tried = [
        {
            **_plain(one),
            "united": float(np.mean([_united(one, found[0].nodes, mine) for mine in own])),
        }
        for one in found
    ]
    write_json(path, {"thumbnails": False, "refused": refused, "tried": tried})


def read_trials(
    plan: FleetPlan, arm: Arm, fold: Fold, drive: EvaluatedDrive
) -> list[TriedDownload]:
    """The trials of one held-out drive; empty if they are still to be made."""
    kept = _kept(trials_path(plan, arm, fold, drive))
    if kept is None:
        return []
    names = {one.name for one in fields(TriedDownload)}
    return [
        TriedDownload(
            **{
                **{key: value for key, value in one.items() if key in names},
                "drive": Drive(np.array(one["drive"][0]), np.array(one["drive"][1], np.bool_)),
            }
        )
        for one in kept
    ]


def _kept(path: Path) -> list[dict[str, Any]] | None:
    """Trials that were made; None if they are still to be made.

    Earlier versions said nothing of thumbnails, and had them in all but `budget`: their trials do
    not count, so that they are never pooled with those of today.
    """
    if not path.exists():
        return None
    values = read_json(path)
    tried: list[dict[str, Any]] = values["tried"]
    return tried if values.get("thumbnails") is False else None


def _start(plan: FleetPlan, fold: Fold, drive: EvaluatedDrive, opened: Map) -> Position | None:
    """Where the drive begins, by truth; None if unknown: it is lost."""
    truth = drive.truth()
    log = FrameLog(drive.path)
    first = None if truth is None else truth.at(int(log.stamps_ns[0]))
    log.close()
    return None if first is None else true_nodes(opened, plan.training(fold)).start(first)


def _united(trial: Trial, whole: Sequence[Node], own: Collection[SessionId]) -> int:
    """Nodes on a robot that keeps all it saved itself in addition to what was sent."""
    mine = sum(node.session in own for node in whole)
    return mine + sum(node.session not in own for node in trial.nodes)


def _plain(trial: Trial) -> dict[str, Any]:
    return {
        "name": trial.name,
        "nodes": trial.report.nodes,
        "of_nodes": trial.report.of_nodes,
        "size_bytes": trial.report.size_bytes,
        "expected_missed": trial.report.expected_missed,
        "drive": [trial.steps.step_m.tolist(), trial.steps.matched.tolist()],
        "ms": trial.ms_per_frame,
        "lookup_ms": trial.lookup_ms_per_frame,
        "lookups": trial.lookups,
        "in_force": of_revision({"download": trial.asked}),
    }


class _Judge:
    """Localises the drives that orders are judged by; what two orders share is matched once."""

    def __init__(self, plan: FleetPlan, arm: Arm, fold: Fold) -> None:
        self._plan = plan
        self._arm = arm
        self._fold = fold
        self._drives = {one.session.id: one for one in plan.drives.drives}

    def __call__(
        self, opened: Map, sequence: DriveSequence, settings: Settings, options: RobotOptions
    ) -> Drive:
        """See `JudgeOptions.localise`."""
        drive = self._drives[session_of_drive(sequence).id]
        folder = self._plan.folder(self._arm, self._fold)
        memo = MatchMemo.of(opened, drive, settings, folder)
        configuration = Configuration(options.ranking, options.lanes, options.rounds)
        runs = localise_held_out(
            opened, drive, drive.frames(), self._plan.training(self._fold), [configuration],
            settings, memo, options.relocaliser,
        )  # fmt: skip
        memo.save()
        return Drive(runs.step_m, runs.matched[0])


def try_orders(plan: FleetPlan, arm: Arm, fold: Fold, names: Sequence[str]) -> None:
    """Merges the groups in all orders, and keeps the results in ``orders.json``."""
    folder = plan.folder(arm, fold)
    path = folder / "orders.json"
    if path.exists():
        return
    judge = JudgeOptions(
        [one.path for one in plan.validation(fold)],
        judge_at_m=plan.tables.build.max_gap_m,
        localising=arm.driving,
        reported=[one.path for one in plan.held_out(fold)],
        localise=_Judge(plan, arm, fold),
        estimator=plan.tables.build.estimator,
    )
    found = find_best_order(
        [map_path(plan, arm, fold, name) for name in names],
        folder / "orders",
        plan.settings,
        arm.merging,
        judge,
        QUIET,
    )
    write_record(path, found.to_dict())
