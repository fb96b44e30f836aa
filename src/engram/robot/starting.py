"""Robots in a map: on a recorded drive or live, and the results of a localised drive."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import ConfigError, InputError, MapError, MapLockedError, RevisionError
from engram.geometry.cameras import StereoCamera
from engram.localiser.localisation import Localisation, LocalisationStatus
from engram.maps.map import Map, open_map
from engram.measures import Drive, failure, longest_gap_m, route_m, route_not_localised
from engram.monitor import QUIET, Monitor
from engram.odometry.motion import driven_steps_m
from engram.ranking.context import RankingPolicy
from engram.robot.anchors import NewestFix, fixes_of
from engram.robot.drive_session import (
    LiveDrive,
    RobotSetup,
    Saving,
    SavingState,
    commit_crashed,
)
from engram.robot.front import Front
from engram.robot.localisers import DriveSequence, session_of_drive
from engram.robot.robot import Robot
from engram.robot.settings import RobotOptions, Settings
from engram.robot.spool import commit_spools
from engram.sequences.sequence import check_name


def robot_on(
    opened: Map,
    sequence: DriveSequence,
    settings: Settings,
    options: RobotOptions | None = None,
    policy: RankingPolicy | None = None,
    *,
    remembers: bool = False,
) -> Robot:
    """A robot that localises a drive in a map, and saves no nodes.

    Args:
        sequence: the drive, for `Robot.drive`.
        options: ranking policy and budget; None for the defaults.
        remembers: whether path and attempts are kept as a session; see `Map.robot`.
    """
    options, settings = options or RobotOptions(), settings.for_descriptor(opened.descriptor)
    session = session_of_drive(sequence)
    setup = RobotSetup(
        sequence.camera,
        settings,
        options,
        session.robot,
        session,
        fixes_of(sequence),
        policy,
    )
    if remembers:
        _check_newest(opened)
    return _robot(setup, opened, LiveDrive(setup, opened, maps=False) if remembers else None)


def robot_in(
    opened: Map,
    setup: RobotSetup,
    *,
    maps: bool = False,
    remembers: bool = False,
    front: Front | None = None,
    fix: NewestFix | None = None,
) -> Robot:
    """A live robot; see `Map.robot`.

    A `front` continues the odometry of the robot before it; a `fix` of satellites proposes nodes.
    """
    if not isinstance(setup.camera, StereoCamera):
        raise InputError(f"camera is {setup.camera!r}, must be an engram.StereoCamera")
    if setup.name is not None:
        check_name(setup.name)
    setup = replace(setup, settings=setup.settings.for_descriptor(opened.descriptor), fix=fix)
    saving = _saving_in(opened, setup, maps=maps) if maps or remembers else None
    if saving is not None and saving.recovered:  # their drives may be played again
        setup = replace(setup, known=frozenset(opened.sessions))
    if saving is not None and maps and (live := _mapped(opened, setup, saving)) is not None:
        return _robot(setup, opened, live, front)
    live = None if saving is None else LiveDrive(setup, opened, maps=False, saving=saving)
    return _robot(setup, opened, live, front)


def _mapped(opened: Map, setup: RobotSetup, saving: Saving) -> LiveDrive | None:
    """The drive as it is mapped; None where the map cannot be written: the robot localises alone.

    Raises:
        MapLockedError: another process writes to the map.
    """
    try:
        commit_spools(Path(opened.location))
        return LiveDrive(setup, open_map(opened.location), maps=True, saving=saving)
    except MapLockedError:
        raise
    except MapError as error:  # on a read-only disk it localises, as on a full one
        saving.state, saving.reason = SavingState.FAILED, str(error)
        return None


def _saving_in(opened: Map, setup: RobotSetup, *, maps: bool) -> Saving:
    """The saving of a drive that begins; first seals what a killed robot of the name had mapped.

    Where that cannot be written, the robot localises and saves nothing.

    Raises:
        MapLockedError: another process writes to the map.
    """
    if setup.name is None:
        raise ConfigError("a robot that keeps its drives needs a name: give name=")
    _check_newest(opened)
    saving = Saving(SavingState.ON)
    try:
        saving.recovered = commit_crashed(opened, setup.name, setup.settings) if maps else ()
    except MapLockedError:
        raise
    except MapError as error:
        saving.state, saving.reason = SavingState.FAILED, str(error)
    return saving


def _check_newest(opened: Map) -> None:
    """Refuses to keep drives in a map opened at an older revision."""
    if opened.is_pinned:
        raise RevisionError(
            f"{opened.location} is open at revision {opened.revision}; to keep drives, open it "
            "without naming a revision"
        )


def _robot(
    setup: RobotSetup, opened: Map, live: LiveDrive | None, front: Front | None = None
) -> Robot:
    localiser = setup.localiser_in(opened) if live is None else live.localiser
    front = front or Front(setup.settings, setup.camera)
    return Robot(front, localiser, live=live, deadline_ms=setup.options.deadline_ms)


def localise_drive(
    opened: Map,
    sequence: DriveSequence,
    settings: Settings | None = None,
    options: RobotOptions | None = None,
    monitor: Monitor = QUIET,
) -> list[Localisation]:
    """Localises a whole drive in an unchanged map; one result per frame."""
    with (
        robot_on(opened, sequence, settings or Settings(), options) as robot,
        closing(robot.drive(sequence, monitor)) as results,
    ):
        return list(results)


def measure(
    opened: Map,
    sequence: DriveSequence,
    settings: Settings,
    options: RobotOptions,
    monitor: Monitor = QUIET,
) -> Drive:
    """Localises a drive in an unchanged map; returns the input of the measures of method §8."""
    return measured(localise_drive(opened, sequence, settings, options, monitor))


def measured(results: Sequence[Localisation]) -> Drive:
    """The input of the measures, from a drive's localisations.

    Steps that odometry could not measure are guessed, and the motion past unusable frames is
    shared among them: otherwise the worst stretches of a drive would not count.
    """
    steps_m = driven_steps_m([one.motion for one in results], [one.stamp_ns for one in results])
    localised = [one.localised for one in results]
    return Drive(steps_m, np.array(localised, np.bool_))


def summarise(results: Sequence[Localisation]) -> dict[str, Any]:
    """The summary that ``localise --json`` prints; every figure is defined in method §8."""
    drive = measured(results)
    count = max(len(results), 1)
    statuses = [result.status for result in results]
    return {
        "frames": len(results),
        "share_localised": sum(result.localised for result in results) / count,
        "statuses": {status.value: statuses.count(status) for status in LocalisationStatus},
        "withdrawn": sum(len(result.withdraws) for result in results),
        "unusable_frames": sum(not result.motion.usable for result in results),
        "attempts_per_frame": sum(r.attempts for r in results) / count,
        "driven_m": route_m([drive]),
        "p_no_match_10m": float(failure([drive], 10.0)),
        "route_not_localised": route_not_localised([drive]),
        "longest_gap_m": longest_gap_m([drive]),
        "late_frames": sum(result.late for result in results),
        "damaged_nodes": sorted({str(n) for r in results for n in r.damaged}),
        "stages_ms": stage_statistics([result.stage_ms for result in results]),
    }


def stage_statistics(stage_ms: Sequence[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Median and 99th percentile of each stage and of their sum, ms."""
    stages = dict.fromkeys(stage for frame in stage_ms for stage in frame)
    series = {stage: [frame.get(stage, 0.0) for frame in stage_ms] for stage in stages}
    if series:
        series["total"] = [sum(frame.values()) for frame in stage_ms]
    return {
        stage: {
            "median": float(np.median(values)),
            "p99": float(np.percentile(values, 99)),
        }
        for stage, values in series.items()
    }
