"""The loop of `engram localise`, and `--explain`: one frame's candidates in their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import typer

from engram.cli.options import ExitStatus, show, untrusted_if
from engram.errors import InputError

if TYPE_CHECKING:
    from engram.localiser.localisation import Localisation
    from engram.maps.map import Map
    from engram.robot.explaining import ExplainedCandidate, Explanation
    from engram.robot.recorder import Recorder
    from engram.robot.results import ResultRecords
    from engram.robot.robot import LastFrame, Robot
    from engram.robot.settings import RobotOptions, Settings
    from engram.sequences.opening import Drive
    from engram.viewing.report import Showcase


# So many match pictures are spread over a drive: enough to leaf through.
_PICTURES = 20


@dataclass(frozen=True, slots=True)
class Outputs:
    """Where the results go, and the map as the next command names it.

    Attributes:
        map_path, drive: the map and the drive, as they were typed.
        trajectory: file in TUM format; None for none.
        pictures: folder of match pictures; None for none.
        rate_hz: replay in real time; None for as fast as it goes.
        as_json: JSON on stdout, in place of text.
        remember: keep path and attempts in the map.
        recorder: folder of flight records; None for none.
        record_images: whether they hold images.
        view: "window" or a recording to watch it in Rerun; None for neither.
        report: an HTML page; None for none.
    """

    map_path: Path
    drive: Path
    trajectory: Path | None
    pictures: Path | None
    rate_hz: float | None
    as_json: bool
    remember: bool = False
    recorder: Path | None = None
    record_images: bool = True
    view: Path | None = None
    report: Path | None = None


def localise_and_print(
    opened: Map,
    sequence: Drive,
    settings: Settings,
    asked: RobotOptions,
    outputs: Outputs,
) -> None:
    """Localises a drive; Ctrl-C ends it with a summary of the frames so far.

    Raises:
        Exit: it was interrupted.
    """
    from engram.cli.wording import localised_text, warnings
    from engram.robot.results import ResultRecords
    from engram.robot.robot import DisplayPose
    from engram.robot.starting import robot_on, summarise
    from engram.sequences.opening import stamps_of
    from engram.viewing.trajectory import write_trajectory
    from engram.viewing.viewer import viewer_for

    with (
        viewer_for(outputs.view) as viewer,
        robot_on(opened, sequence, settings, asked, remembers=outputs.remember) as robot,
    ):
        if viewer is not None:
            viewer.watch(robot, opened)
        robot.recorder = _recorder(opened, sequence, outputs)
        records = ResultRecords(DisplayPose(opened.frame, robot.graph))
        watchers, showcase = _watchers(opened, sequence, robot, outputs)
        results, interrupted = _driven(robot, sequence, outputs.rate_hz, records, watchers)
        if outputs.trajectory is not None:
            write_trajectory(outputs.trajectory, opened.graph, results)
    fatal = robot.diagnosis.fatal
    summary = {
        **summarise(results),
        "skipped_pairs": sequence.skipped,
        "wrong_stamps": stamps_of(sequence).left_out,
        "interrupted": interrupted,
        "findings": robot.diagnosis.to_dict()["findings"],
        "trusted": not fatal,
    }
    if outputs.remember:
        summary["remembered"] = {"state": robot.saving.state, "revision": robot.saving.revision}
    summary |= _records(robot.recorder)
    frames = records.frames(results)
    for warning in () if outputs.as_json else warnings(summary):
        typer.echo(warning, err=True)
    text = [localised_text(summary, frames, outputs.map_path)]
    text += [robot.saving.text()] if outputs.remember else []
    places = {"map": str(outputs.map_path), "drive": str(outputs.drive)}
    whole = {**places, "summary": summary, "frames": frames}
    if outputs.report is not None:
        _write_report(outputs, whole, opened, showcase)
        text.append(f"report: {outputs.report}")
    show(whole, "\n".join(text), as_json=outputs.as_json)
    if interrupted:
        raise typer.Exit(ExitStatus.INTERRUPTED)
    untrusted_if(fatal)


class Watcher(Protocol):
    """Looks at each frame of a drive."""

    def see(self, seen: LastFrame, found: Localisation, frame: int, at_m: float) -> None:
        """Looks at the frame just localised, so many metres into the drive."""
        ...


def _watchers(
    opened: Map, sequence: Drive, robot: Robot, outputs: Outputs
) -> tuple[list[Watcher], Showcase | None]:
    """What draws the drive's matches: for a folder of pictures, and for a report."""
    from engram.robot.localisers import session_of_drive
    from engram.viewing.matches import MatchShower, NeighbouringDrives, PictureWriter
    from engram.viewing.report import Showcase

    watchers: list[Watcher] = []
    if outputs.pictures is None and outputs.report is None:
        return watchers, None
    images = NeighbouringDrives(outputs.drive)
    shower = MatchShower(opened, robot, session_of_drive(sequence), images)
    if outputs.pictures is not None:
        every = max(1, len(sequence) // _PICTURES)
        watchers.append(PictureWriter(outputs.pictures, every, shower))
    if outputs.report is None:
        return watchers, None
    showcase = Showcase(shower)
    return [*watchers, showcase], showcase


def _write_report(
    outputs: Outputs, whole: dict[str, Any], opened: Map, showcase: Showcase | None
) -> None:
    import msgspec

    from engram.cli.wording import unmatched
    from engram.robot.results import DriveResult
    from engram.viewing.report import drive_page, made_by, typed

    assert outputs.report is not None
    place = outputs.map_path, outputs.drive
    lines = [typed("engram", "localise", *place, "--report", outputs.report)]
    if (frame := unmatched(whole["frames"])) is not None:
        lines.append(typed("engram", "localise", *place, "--explain", frame))
    lines += [typed("engram", "doctor", outputs.drive), typed("engram", "map", *place)]
    page = drive_page(msgspec.convert(whole, DriveResult), opened, showcase, lines)
    page.write(outputs.report, made_by())


def _driven(
    robot: Robot,
    sequence: Drive,
    rate_hz: float | None,
    records: ResultRecords,
    watchers: Sequence[Watcher],
) -> tuple[list[Localisation], bool]:
    """The results of the drive, and whether Ctrl-C ended it."""
    from engram.cli.screen import Bars

    results: list[Localisation] = []
    at_m = 0.0
    with Bars().stage("localise", len(sequence)) as monitor:
        try:
            for frame, found in enumerate(robot.drive(sequence, monitor, rate_hz)):
                results.append(found)
                records.see(found)
                at_m += found.motion.moved_m
                for watcher in watchers:
                    if robot.last is not None:
                        watcher.see(robot.last, found, frame, at_m)
        except KeyboardInterrupt:
            typer.echo("interrupted: the summary covers the frames so far", err=True)
            return results, True
    return results, False


def _recorder(opened: Map, sequence: Drive, outputs: Outputs) -> Recorder | None:
    """The flight recorder, if one was requested."""
    from engram.robot.recorder import Recorder

    if outputs.recorder is None:
        return None
    try:
        outputs.recorder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{outputs.recorder}: cannot be created: {error.strerror}") from error
    about = {"map": str(opened.location), "revision": opened.revision}
    return Recorder(outputs.recorder, sequence.info, about, outputs.record_images)


def _records(recorder: Recorder | None) -> dict[str, Any]:
    """The ``--json`` of a recorder; says why a record is missing."""
    if recorder is None:
        return {}
    if recorder.failure:
        typer.echo(f"warning: not recorded: {recorder.failure}", err=True)
    for path in recorder.written:
        typer.echo(f"flight record: {path}", err=True)
    return {"records": [str(path) for path in recorder.written]}


_LISTED = 20


def explain_and_print(
    opened: Map,
    sequence: Drive,
    number: int,
    settings: Settings,
    asked: RobotOptions,
    *,
    as_json: bool,
) -> None:
    """Localises the drive up to a frame and says how its candidates were ordered."""
    from engram.robot.explaining import explain_frame

    found = explain_frame(opened, sequence, number, settings, asked)
    show(found.to_dict(), partial(_explained_text, found), as_json=as_json)


def _explained_text(found: Explanation) -> str:
    lines = [
        f"frame {found.frame}: {found.status.value.replace('_', ' ')}; "
        f"{len(found.candidates)} candidates, "
        f"{sum(one.would_match for one in found.candidates)} would match; "
        f"ordered by {found.ranking}"
    ]
    if found.refused:
        lines.append(
            "  refused: the frame matches, but the matches of the last metres show less than is "
            "usual here, as a street of equal fronts would; so do rebuilt fronts, and a van ahead"
        )
    if not found.candidates:
        return "\n".join([*lines, "nothing to rank: the robot is lost, or the frame is unusable"])
    lines += [f"  order: {found.rule}"] if found.rule else []
    lines += [f"  {name}: {meaning}" for name, meaning in found.meaning.items()]
    names = list(found.candidates[0].terms)
    chance = "chance  " if found.candidates[0].chance is not None else ""
    head = "".join(f"{name:>{_width(name)}}" for name in names)
    lines.append(f"   # node     {'drive':34s} {'ahead':>7s}{'aside':>7s}{'yaw':>6s}{'g':>6s}  "
                 f"{chance}{head}  outcome")  # fmt: skip
    for place, one in enumerate(found.candidates[:_LISTED], 1):
        terms = "".join(f"{value:>{_width(name)}.2f}" for name, value in one.terms.items())
        reckoned = "" if one.chance is None else f"{one.chance:6.1%}  "
        lines.append(
            f"{place:4d} {str(one.node)[:8]} {one.drive:34.34s} {one.along_m:+7.2f}"
            f"{one.across_m:+7.2f}{57.29578 * one.yaw_rad:+6.0f}{one.success_rate:6.2f}  "
            f"{reckoned}{terms}  {_outcome(one)}"
        )
    if len(found.candidates) > _LISTED:
        lines.append(f"     and {len(found.candidates) - _LISTED} more; --json lists all")
    return "\n".join(lines)


def _outcome(one: ExplainedCandidate) -> str:
    matched, failed = ("matched", "failed") if one.attempted else ("would match", "would fail")
    outcome = f"{matched}, {one.inliers} inliers" if one.would_match else failed
    return f"{outcome} (its turn)" if one.by_turn else outcome


def _width(name: str) -> int:
    return max(len(name) + 2, 8)
