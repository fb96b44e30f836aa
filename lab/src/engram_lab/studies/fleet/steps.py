"""The steps of the fleet study: map, merge, download, localise. Each finds again what it made.

A map is changed in a copy that takes its place when the step is whole, so that a study that was
killed here and there has the same maps as one that was not.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from engram.cli.settings import DownloadSettings
from engram.errors import InputError
from engram.fleet.download import DownloadReport, download
from engram.fleet.merge import merge as merge_maps
from engram.graph.clock import hour_of_day
from engram.graph.model import path_id
from engram.maps import Map, copy_map
from engram.robot import MapReport, measured
from engram_lab.studies.building import build_map, newest_in_force
from engram_lab.studies.drives import EvaluatedDrive
from engram_lab.studies.fleet.arms import Arm
from engram_lab.studies.fleet.plan import FleetPlan
from engram_lab.studies.fleet.records import (
    DownloadRecord,
    MergeRecord,
    write_drive,
    write_record,
)
from engram_lab.studies.folds import Fold
from engram_lab.studies.held_out import localise_held_out
from engram_lab.studies.kept_maps import KeptMaps
from engram_lab.studies.memo import MatchMemo
from engram_lab.studies.store import joined, missing, read_runs, write_runs

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
        plan: the study.
        arm: policy and budget.
        fold: whose training sessions they are.
        name: of the map.
        drives: in the order in which they are mapped.
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
    """What a robot takes along to its second foray; the mission starts with its first drive.

    Args:
        plan: the study.
        arm: policy and budget.
        fold: whose training sessions they are.
        name: of the download.
        centre: name of the map that it is a part of.
        policy: key of `SELECTIONS`.
        own: the drives that the robot itself has handed in.
        mission: the drives of the foray.
    """
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
        options = asked.options(policy, depart_h=hour, arrive_h=hour, strict=strict)
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
