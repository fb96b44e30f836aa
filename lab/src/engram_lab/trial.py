"""Downloads tried out: what they promised, and what then happened on held-out drives.

The mission of each trial is that of the drive itself: its date and its hour of day.
Source: [G16] Fig. 9 (nodes, time per localisation, failure); method §7 (the forecast).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import ConfigError, InputError
from engram.fleet.download.downloading import DownloadReport, download
from engram.fleet.download.mission import DownloadOptions
from engram.fleet.merge.gate import check_held_out
from engram.graph.clock import hour_of_day
from engram.graph.model import Node, Session
from engram.localiser.localisation import Localisation, Position
from engram.maps.map import Map, open_map
from engram.measures import Drive, failure, longest_gap_m, route_m, route_not_localised
from engram.monitor import QUIET, Monitor
from engram.robot.localisers import DriveSequence, session_of_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import measured, robot_on

OpenDrive = Callable[[], DriveSequence]
# Stages that are the robot's own business, whatever map it has.
_BEFORE_THE_MAP = ("read", "frontend", "odometry", "doctor")


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One drive in one download.

    Attributes:
        ms_per_frame: mean time of localising a frame, relocalisation included, without front-end
            and odometry.
    """

    name: str
    drive: str
    report: DownloadReport
    steps: Drive
    ms_per_frame: float
    lookup_ms_per_frame: float
    lookups: int
    nodes: Sequence[Node]
    asked: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class TrialSummary:
    """All drives in one kind of download.

    Attributes:
        expected_missed, missed: share of the way without a match, promised and met.
        p_no_match_10m: failure curve at 10 m (estimator *route*).
    """

    name: str
    drives: int
    route_m: float
    nodes: float
    size_bytes: float
    expected_missed: float
    missed: float
    p_no_match_10m: float
    longest_gap_m: float
    ms_per_frame: float

    def text(self) -> str:
        """One line for people."""
        return (
            f"{self.name:16s} {self.nodes:7.0f} nodes {self.size_bytes / 1e6:7.1f} MB  "
            f"missed {self.missed:6.1%} (estimated {self.expected_missed:6.1%})  "
            f"P(> 10 m) {self.p_no_match_10m:6.2%}  longest {self.longest_gap_m:5.1f} m  "
            f"{self.ms_per_frame:6.2f} ms a frame"
        )


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A drive for which some options found nothing to send.

    Attributes:
        depart_h: the drive's hour of day; None if it is not known.
    """

    name: str
    drive: str
    depart_h: float | None
    why: str

    def text(self) -> str:
        """One line for people."""
        hour = "" if self.depart_h is None else f", of {self.depart_h:.1f} h"
        return f"{self.name:16s} left out {self.drive}{hour}: {self.why}"


def check_not_sent(
    centre: Path, drives: Sequence[tuple[Path | str, DriveSequence]], at: int | str | None = None
) -> None:
    """Refuses drives that downloads of a centre may hold: they would do well in any.

    Args:
        at: revision of the centre; None for the newest.
    """
    if drives:
        with Map.open(centre, at=at) as store:
            check_held_out(drives, store.sessions.values(), centre, "--check")


def try_downloads(
    centre: Path,
    wanted: Mapping[str, DownloadOptions],
    drives: Sequence[OpenDrive],
    settings: Settings,
    localise: RobotOptions,
    monitor: Monitor = QUIET,
    *,
    at: int | str | None = None,
    start: Callable[[Map], Position | None] = lambda _: None,
    left_out: Callable[[LeftOut], None] | None = None,
) -> list[Trial]:
    """Download for each drive by each method, and localise it there without writing anything.

    Args:
        at: revision of the centre; None for the newest.
        start: where a drive begins in a download; None if nobody knows: it begins lost.
        left_out: is told of a drive for which one of the options fits nothing; it is tried in
            none of the others then, so that all are of the same drives. None for an error.
    """
    opened = [open_drive() for open_drive in drives]
    check_not_sent(centre, [(sequence.info.name, sequence) for sequence in opened], at)
    trials: list[Trial] = []
    with tempfile.TemporaryDirectory(prefix="engram-trial-") as folder:
        for open_drive in drives:
            sequence = open_drive()
            session = session_of_drive(sequence)
            hour = hour_of_day(session, session.start_ns)
            own: list[Trial] = []
            for number, (name, asked) in enumerate(wanted.items()):
                options = asked if hour is None else replace(asked, **_when(session, hour))
                out = Path(folder) / f"{session.id}-{number}.engram"
                try:
                    report = download(centre, out, options, at=at, monitor=monitor)
                except ConfigError:
                    raise
                except InputError as error:
                    if left_out is None:
                        raise
                    left_out(LeftOut(name, str(session.id), hour, str(error)))
                    own = []
                    break
                with (
                    open_map(out) as opened_part,
                    robot_on(opened_part, sequence, settings, localise) as robot,
                    monitor.stage("localise", len(sequence)) as part,
                ):
                    position = start(opened_part)
                    if position is not None:
                        robot.place_at(position)
                    results = list(robot.drive(open_drive(), part))
                    nodes = list(opened_part.graph.nodes)
                    asked_for = opened_part.log()[-1].configuration["download"]
                own.append(_trial(name, session, report, results, nodes, asked_for))
                out.unlink()
            trials += own
    return trials


def _trial(
    name: str,
    session: Session,
    report: DownloadReport,
    results: Sequence[Localisation],
    nodes: Sequence[Node],
    asked: Mapping[str, Any],
) -> Trial:
    """Result of a drive in a download."""
    lookups_ms = [one.stage_ms["places"] for one in results if "places" in one.stage_ms]
    in_map_ms = [
        ms for one in results for stage, ms in one.stage_ms.items() if stage not in _BEFORE_THE_MAP
    ]
    return Trial(
        name=name,
        drive=str(session.id),
        report=report,
        steps=measured(results),
        ms_per_frame=sum(in_map_ms) / max(len(results), 1),
        lookup_ms_per_frame=sum(lookups_ms) / max(len(results), 1),
        lookups=len(lookups_ms),
        nodes=nodes,
        asked=asked,
    )


def _when(session: Session, hour: float) -> dict[str, Any]:
    """The mission is the drive itself."""
    day = datetime.fromtimestamp(session.start_ns / 1e9, UTC).date().isoformat()
    return {"depart_h": hour, "arrive_h": hour, "date": day}


def summarise_trials(trials: Sequence[Trial]) -> list[TrialSummary]:
    """One row for each name, in the order of first appearance."""
    summaries = []
    for name in dict.fromkeys(trial.name for trial in trials):
        own = [trial for trial in trials if trial.name == name]
        steps = [trial.steps for trial in own]
        lengths = np.array([route_m([one]) for one in steps])
        promised = np.array([trial.report.expected_missed for trial in own])
        total_m = float(lengths.sum())
        summaries.append(
            TrialSummary(
                name=name,
                drives=len(own),
                route_m=total_m,
                nodes=float(np.mean([trial.report.nodes for trial in own])),
                size_bytes=float(np.mean([trial.report.size_bytes for trial in own])),
                expected_missed=float(promised @ lengths / total_m) if total_m else 0.0,
                missed=route_not_localised(steps),
                p_no_match_10m=float(failure(steps, 10.0)),
                longest_gap_m=longest_gap_m(steps),
                ms_per_frame=float(np.mean([trial.ms_per_frame for trial in own])),
            )
        )
    return summaries
