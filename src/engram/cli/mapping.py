"""`engram map`."""

from __future__ import annotations

import json

import typer

from engram.cli import options


def map_(
    map_path: options.MapPath,
    path: options.DrivePath,
    *,
    policy: options.Policy = "recall",
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 2,
    deadline: options.Deadline = None,
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
    """Add a drive to a map, which is made if there is none.

    Where the drive localises in the map nothing is saved; elsewhere it becomes a new experience.
    A drive that was interrupted, by Ctrl-C or a crash, is resumed when it is given again.

    \b
    Examples:
      engram map town.engram drives/monday
      engram map town.engram drives/tuesday --robot r2 --start 2026-03-01T09:30:00Z
      engram map town.engram kitti/sequences/06 --frames 0:50:2
    """
    from engram.cli.progress import Bars
    from engram.robot import RobotOptions, load_settings, map_drive, open_drive

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
    asked = RobotOptions(policy=policy, lanes=lanes, rounds=rounds, deadline_ms=deadline)
    with Bars().stage("map", len(sequence)) as monitor:
        settings = load_settings(config, descriptor)
        report = map_drive(map_path, sequence, settings, asked, monitor, descriptor=descriptor)
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        typer.echo(report.text())
    if report.interrupted:
        raise typer.Exit(130)
