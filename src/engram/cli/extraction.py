"""`engram extract`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options


def extract(
    path: options.DrivePath,
    out: Annotated[Path, typer.Argument(metavar="LOG", help="The frame log to write.")],
    *,
    format_: options.Format = None,
    rig: options.Rig = "grey",
    channel: options.Channel = "grey",
    frames: options.Frames = None,
    skip_bad: options.SkipBad = False,
    robot: options.Robot = None,
    start: options.Start = None,
    longitude: options.Longitude = None,
    zone: options.Zone = None,
    descriptor: options.Descriptor = None,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Record a drive's frames and odometry: a frame log, a sixteenth of the size of its images.

    Every other verb reads a frame log like the drive itself. An interrupted run is resumed when
    it is given again.

    \b
    Examples:
      engram extract drives/monday monday.framelog
      engram extract 2011_09_26_drive_0001_sync colour.framelog --rig colour --channel blue
    """
    from engram.cli.progress import Bars
    from engram.robot import extract_log, load_settings, open_drive

    sequence = open_drive(
        path,
        format=format_,
        rig=rig,
        channel=channel,
        frames=frames,
        skip_bad=skip_bad,
        robot=robot,
        start=start,
        longitude_deg=longitude,
        zone=zone,
    )
    with Bars().stage("extract", len(sequence)) as monitor:
        report = extract_log(sequence, out, load_settings(config, descriptor), monitor)
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        typer.echo(report.text())
    if report.interrupted:
        raise typer.Exit(130)
