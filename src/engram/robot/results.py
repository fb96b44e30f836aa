"""Results of a localised drive: one per frame, and a summary."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np

from engram.localiser import Localisation, LocalisationStatus
from engram.maps import Map
from engram.measures import Drive, failure, longest_gap_m, route_m, route_not_localised
from engram.monitor import QUIET, Monitor
from engram.odometry.motion import driven_steps_m
from engram.robot.session import DriveSequence
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on


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
        closing(robot.drive(sequence, monitor)) as found,
    ):
        return list(found)


def measure(
    opened: Map,
    sequence: DriveSequence,
    settings: Settings,
    options: RobotOptions,
    monitor: Monitor = QUIET,
) -> Drive:
    """Localises a drive in an unchanged map; returns the input of the measures of method §8."""
    return measured(localise_drive(opened, sequence, settings, options, monitor))


def measured(found: Sequence[Localisation]) -> Drive:
    """The input of the measures, from a drive's localisations.

    Steps that odometry could not measure are guessed, and the motion past unusable frames is
    shared among them: otherwise the worst stretches of a drive would not count.
    """
    steps_m = driven_steps_m([one.motion for one in found], [one.stamp_ns for one in found])
    localised = [one.localised for one in found]
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
