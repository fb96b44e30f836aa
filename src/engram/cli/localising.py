"""The loop of `engram localise`: progress, pictures, trajectory, summary."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from engram.cli.endings import ExitStatus, untrusted_if
from engram.errors import InputError

if TYPE_CHECKING:
    from engram.localiser import Localisation
    from engram.maps import Map
    from engram.robot import Recorder, RobotOptions, Settings
    from engram.sequences import Drive

# So many match pictures are spread over a drive: enough to leaf through.
_PICTURES = 20


@dataclass(frozen=True, slots=True)
class Outputs:
    """Where the results go, and the map as the next command names it.

    Attributes:
        map_path: the map, as it was typed.
        trajectory: file in TUM format; None for none.
        pictures: folder of match pictures; None for none.
        rate_hz: replay in real time; None for as fast as it goes.
        as_json: JSON on stdout, in place of text.
        remember: keep path and attempts in the map.
        recorder: folder of flight records; None for none.
        record_images: whether they hold images.
        view: "window" or a recording to watch it in Rerun; None for neither.
    """

    map_path: Path
    trajectory: Path | None
    pictures: Path | None
    rate_hz: float | None
    as_json: bool
    remember: bool = False
    recorder: Path | None = None
    record_images: bool = True
    view: Path | None = None


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
    from engram.cli.progress import Bars
    from engram.cli.wording import localised_text, warnings
    from engram.robot import robot_on, summarise
    from engram.sequences import stamps_of
    from engram.viewing.pictures import PictureWriter
    from engram.viewing.trajectory import write_trajectory
    from engram.viewing.viewer import viewer_for

    results: list[Localisation] = []
    interrupted = False
    with (
        viewer_for(outputs.view) as viewer,
        robot_on(opened, sequence, settings, asked, remembers=outputs.remember) as robot,
    ):
        if viewer is not None:
            viewer.watch(robot, opened)
        robot.recorder = _recorder(opened, sequence, outputs)
        writer = None
        if outputs.pictures is not None:
            every = max(1, len(sequence) // _PICTURES)
            writer = PictureWriter(outputs.pictures, every, opened.frames)
        with Bars().stage("localise", len(sequence)) as monitor:
            try:
                for found in robot.drive(sequence, monitor, outputs.rate_hz):
                    results.append(found)
                    if writer is not None and robot.last is not None:
                        writer.offer(robot.last, found)
            except KeyboardInterrupt:
                interrupted = True
                typer.echo("interrupted: the summary covers the frames so far", err=True)
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
    frames = [result.to_dict() for result in results]
    if outputs.as_json:
        print(json.dumps({"summary": summary, "frames": frames}))
    else:
        for warning in warnings(summary):
            typer.echo(warning, err=True)
        typer.echo(localised_text(summary, frames, outputs.map_path))
        if outputs.remember:
            typer.echo(robot.saving.text())
    if interrupted:
        raise typer.Exit(ExitStatus.INTERRUPTED)
    untrusted_if(fatal)


def _recorder(opened: Map, sequence: Drive, outputs: Outputs) -> Recorder | None:
    """The flight recorder, if one was requested."""
    from engram.robot import Recorder

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
