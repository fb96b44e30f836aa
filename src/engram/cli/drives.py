"""`engram map`, `localise`, `record`: what is done with one drive."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options, outputs
from engram.cli.endings import ExitStatus, untrusted_if
from engram.cli.losses import losses_told
from engram.errors import ConfigError

if TYPE_CHECKING:
    from engram.maps import Map
    from engram.robot.settings import Settings


def map_(
    map_path: outputs.WrittenMap,
    path: options.DrivePath,
    *,
    drive: options.Drive,
    effort: options.Effort,
    features: options.Features = None,
    no_thumbnails: options.NoThumbnails = False,
    force: Annotated[
        bool, typer.Option("--force", help="Map the drive even if the doctor finds it unfit.")
    ] = False,
    view: outputs.View = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Add a drive to a map.

    Creates the map if it does not exist. Where the drive matches the map well, nothing is saved;
    elsewhere it becomes a new experience. The same command resumes an interrupted drive. A drive
    with a fatal fault (see engram doctor) is refused with exit status 4; nothing is written.

    \b
    Examples:
      engram map town.engram drives/monday
      engram map town.engram drives/tuesday --robot r2 --zone Europe/London
      engram map town.engram drives/tuesday --recorded-at 2026-03-01T09:30:00Z
      engram map town.engram sequences/06 --frames 0:50:2
    """
    sequence = drive.open(path)
    from engram.cli.progress import Bars
    from engram.cli.wording import mapped_text, warnings
    from engram.robot import Beginning, RobotOptions, map_drive
    from engram.viewing.viewer import viewer_for

    given = settings.read()
    asked = RobotOptions(**effort.over(given), force=force)
    resolved = _for_people(given.of_robot(features), no_thumbnails)
    features = features or _asked_kind(resolved)
    with losses_told(sequence):
        with viewer_for(view) as viewer, Bars().stage("map", len(sequence)) as monitor:

            def begin(begun: Beginning) -> None:
                if viewer is not None:
                    viewer.watch(begun.robot, begun.opened)

            report = map_drive(map_path, sequence, resolved, asked, monitor, begin, features)
        if as_json:
            print(json.dumps(report.to_dict()))
        else:
            for warning in warnings(report.to_dict()):
                typer.echo(warning, err=True)
            typer.echo(mapped_text(report.to_dict(), map_path))
        if report.interrupted:
            raise typer.Exit(ExitStatus.INTERRUPTED)


def localise(
    map_path: options.MapPath,
    path: options.DrivePath,
    *,
    drive: options.Drive,
    effort: options.Effort,
    deadline: Annotated[
        float | None,
        typer.Option(
            "--deadline", metavar="MS", help="Start no attempt later than this after the frame."
        ),
    ] = None,
    relocaliser: options.Relocaliser = "fabmap",
    at: options.At = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(
            "--trajectory",
            metavar="FILE",
            help="Write the trajectory in TUM format.",
            parser=outputs.output_file,
        ),
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(
            "--pictures",
            metavar="DIR",
            help="Write about 20 pictures of matches.",
            parser=outputs.output_folder,
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Replay in real time and count late frames."),
    ] = None,
    remember: Annotated[
        bool,
        typer.Option("--remember", help="Keep the drive's path and attempts in the map."),
    ] = False,
    recorder: Annotated[
        Path | None,
        typer.Option(
            "--recorder",
            metavar="DIR",
            help="When lost, write the last 30 s to a file.",
            parser=outputs.output_folder,
        ),
    ] = None,
    no_images: Annotated[bool, typer.Option("--no-images", help="Record no images.")] = False,
    view: outputs.View = None,
    explain: Annotated[
        int | None,
        typer.Option(
            "--explain",
            metavar="FRAME",
            min=0,
            help="Explain the candidates of this frame, from 0.",
        ),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Find a drive in a map.

    The map is not changed, unless --remember keeps the drive's path and match attempts, which rank
    candidates for later drives. If the drive has a fatal fault (see engram doctor), the result is
    not to be trusted, and the exit status is 5. --explain localises the drive up to one frame, then
    lists that frame's candidates: why they are in this order, and which of them match.

    \b
    Examples:
      engram localise town.engram drives/tuesday
      engram localise town.engram drives/tuesday --ranking distance --lanes 1 --json
      engram localise town.engram drives/tuesday --rate 20 --deadline 40
      engram localise town.engram drives/tuesday --trajectory tuesday.tum --pictures matches
      engram localise town.engram drives/tuesday --view window
      engram localise town.engram drives/tuesday --explain 120
    """
    sequence = drive.open(path)
    from engram.cli.explaining import explain_and_print
    from engram.cli.localising import Outputs, localise_and_print
    from engram.robot import RobotOptions, open_map
    from engram.robot.explaining import ExplainOptions

    found_by = None if relocaliser == "none" else relocaliser
    given = settings.read()
    resolved, tried = given.of_robot(), effort.over(given)
    if explain is None:
        asked = RobotOptions(**tried, deadline_ms=deadline, relocaliser=found_by)
        wanted = Outputs(
            map_path, trajectory, pictures, rate, as_json, remember, recorder, not no_images, view
        )
        with losses_told(sequence), open_map(map_path, at) as opened:
            _follow(opened, resolved)
            if not opened.node_count():
                typer.echo(_empty(opened), err=True)
            localise_and_print(opened, sequence, resolved, asked, wanted)
        return
    refused = {
        "--trajectory": trajectory, "--pictures": pictures, "--rate": rate, "--deadline": deadline,
        "--remember": remember or None, "--recorder": recorder, "--view": view,
    }  # fmt: skip
    for option in (option for option, value in refused.items() if value is not None):
        raise ConfigError(f"--explain is about one frame and takes no {option}")
    frame = ExplainOptions(explain, tried["ranking"], tried["lanes"], tried["rounds"], found_by, at)
    explain_and_print(map_path, sequence, resolved, frame, as_json=as_json)


def record(
    path: options.DrivePath,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="LOG", help="The frame log, NAME.framelog.", parser=outputs.output_file
        ),
    ],
    *,
    drive: options.Drive,
    features: options.Features = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Store a drive compactly, as a frame log.

    A frame log keeps features and odometry in a sixteenth of the space of the images. Every verb
    reads it like the drive itself. The same command resumes an interrupted recording. The log of a
    drive with a fatal fault is kept, and the exit status is 5: engram map refuses its images.

    \b
    Examples:
      engram record drives/monday monday.framelog
      engram record 2011_09_26_drive_0001_sync colour.framelog --rig colour --channel blue
    """
    sequence = drive.open(path)
    from engram.cli.progress import Bars
    from engram.robot import extract_log

    resolved = settings.read().of_robot(features)
    with losses_told(sequence):
        with Bars().stage("record", len(sequence)) as monitor:
            report = extract_log(sequence, out, resolved, monitor)
        if as_json:
            print(json.dumps(report.to_dict()))
        else:
            typer.echo(report.text())
        if report.interrupted:
            raise typer.Exit(ExitStatus.INTERRUPTED)
        if report.diagnosis is not None:
            untrusted_if(report.diagnosis.fatal)


def _asked_kind(settings: Settings) -> str | None:
    """The kind of features that the settings name; None for the default, which follows a map's."""
    from engram.frontend import FrontendConfig

    kind = settings.frontend.descriptor
    return None if kind == FrontendConfig().descriptor else kind


def _follow(opened: Map, settings: Settings) -> None:
    """Rejects settings whose features differ from the map's: nothing would match.

    Raises:
        ConfigError: they do.
    """
    asked, found = _asked_kind(settings), opened.descriptor
    if asked is not None and found is not None and asked != found:
        raise ConfigError(
            f"{opened.location} has {found} features, not {asked}; leave out frontend.descriptor, "
            f"or map the drives into another map with --features {asked.partition('@')[0]}"
        )


def _empty(opened: Map) -> str:
    """Why nothing can be found in a map without nodes."""
    begun = [str(one.session.id)[:8] for one in opened.interrupted()]
    if begun:
        return (
            f"warning: the map is empty: session {begun[0]} was interrupted; map its drive again, "
            "or commit what it saved with engram check --seal"
        )
    return "warning: the map is empty; begin it with engram map"


def _for_people(settings: Settings, no_thumbnails: bool) -> Settings:
    if not no_thumbnails:
        return settings
    return replace(settings, frontend=replace(settings.frontend, thumbnails=False))
