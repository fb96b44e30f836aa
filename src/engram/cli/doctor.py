"""`engram doctor`: what is wrong with a drive."""

from __future__ import annotations

import dataclasses
import json
from typing import Annotated

import typer

from engram.cli import options
from engram.cli.endings import EXIT_UNFIT_DRIVE


def doctor(
    path: options.DrivePath,
    *,
    drive: options.Drive,
    hours: Annotated[
        bool, typer.Option("--hours", help="Missions by hour need the drive's clock: check it.")
    ] = False,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Find out what is wrong with a drive.

    Looks at up to 200 frames: whether left and right are in place, in line and of one instant, at
    stamps, odometry, images and optics. Each finding has a value, its limit and a cure. Exit
    status 4 if one is fatal: engram map refuses such a drive.

    \b
    Examples:
      engram doctor drives/monday
      engram doctor drives/monday --json
      engram doctor drives/monday --hours --zone Europe/London
    """
    from engram.cli.losses import tell_losses
    from engram.cli.progress import Bars
    from engram.robot import examine_drive

    sequence = dataclasses.replace(drive, skip_bad=True).open(path)
    resolved = settings.read().of_robot()
    most = min(len(sequence), resolved.doctor.frames)
    with Bars().stage("doctor", most) as monitor:
        diagnosis = examine_drive(sequence, resolved, monitor, by_hour=hours)
    print(json.dumps(diagnosis.to_dict()) if as_json else diagnosis.text())
    if diagnosis.fatal:
        raise typer.Exit(EXIT_UNFIT_DRIVE)
    tell_losses(sequence)
