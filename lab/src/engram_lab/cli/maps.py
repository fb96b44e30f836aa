"""`engram lab relocalise`, `engram lab places` and `engram lab try`: what a map is good for."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options
from engram.counts import counted


def relocalise(
    map_path: options.MapPath,
    path: options.DrivePath,
    *,
    relocaliser: Annotated[
        str,
        typer.Option(
            "--relocaliser",
            metavar="NAME",
            help="How a frame is found: fabmap, bag-of-words or exhaustive.",
        ),
    ] = "fabmap",
    drive: options.Seen,
    rounds: Annotated[
        int, typer.Option("--rounds", metavar="N", min=1, help="Rounds of attempts (Nr).")
    ] = 32,
    at: options.At = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Find each frame of a drive by itself.

    Every frame is treated as the first one after the robot was switched on.

    \b
    Examples:
      engram lab relocalise town.engram drives/tuesday
      engram lab relocalise town.engram drives/tuesday --frames 0:1000:10 --json
    """
    from engram.cli.screen import Bars
    from engram.localiser.localisation import Budget
    from engram.robot.settings import RobotOptions
    from engram_lab.relocalising import relocalise_drive, summarise_cold_starts

    sequence, given = drive.open(path, settings)
    lanes = given.drive.lanes
    robot = RobotOptions(lanes=lanes, threads=given.drive.threads)
    starts = relocalise_drive(
        map_path,
        sequence,
        given.of_robot(),
        relocaliser=relocaliser,
        budget=Budget(lanes, lost_rounds=rounds),
        threads=robot.lane_threads(),
        at=at,
        monitor=Bars(),
    )
    summary = summarise_cold_starts(starts)
    if as_json:
        print(json.dumps({"summary": summary, "frames": [one.to_dict() for one in starts]}))
        return
    if damaged := summary["damaged_nodes"]:
        nodes = counted(len(damaged), "damaged node")
        typer.echo(f"warning: skipped {nodes} of the map, such as {damaged[0]}", err=True)
    typer.echo(
        f"{summary['found']} of {summary['frames']} frames found, {summary['unknown']} not found, "
        f"{summary['unusable_frame']} unusable; {summary['attempts']} attempts"
    )


def places(
    map_path: options.MapPath,
    *,
    top: Annotated[
        int, typer.Option("--top", metavar="N", min=1, help="How many pairs to list.")
    ] = 10,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE", help="Draw how similar all places look."),
    ] = None,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """List distant places that look alike.

    \b
    Examples:
      engram lab places town.engram
      engram lab places town.engram --top 50 --picture confusion.png
    """
    from engram.cli.screen import Bars
    from engram_lab.lookalikes import find_lookalikes, write_confusion_picture

    confusion = find_lookalikes(map_path, at, Bars())
    if picture is not None:
        write_confusion_picture(picture, confusion)
    pairs = confusion.lookalikes[:top]
    if as_json:
        listed = [
            {"node": str(one.node), "like": str(one.like), "similarity": one.similarity}
            for one in pairs
        ]
        print(json.dumps({"nodes": confusion.nodes, "lookalikes": listed}))
        return
    for one in pairs:
        typer.echo(f"{one.node} looks like {one.like}: {one.similarity:.2f}")
    if not pairs:
        typer.echo("no two distant places look alike")


def try_(
    centre: Annotated[
        Path, typer.Argument(metavar="FLEET", help="The fleet map.", parser=options.map_file)
    ],
    drives: Annotated[
        list[Path],
        typer.Argument(metavar="DRIVE", help="Held-out drives, which the map does not contain."),
    ],
    *,
    policy: Annotated[
        str,
        typer.Option("--select", metavar="NAME", help="copy, tod, paths, tod+paths or budget."),
    ] = "copy",
    start: Annotated[
        str | None, typer.Option("--depart", metavar="H:MM", help="When the mission begins.")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--arrive", metavar="H:MM", help="When the mission ends.")
    ] = None,
    window: Annotated[
        float | None,
        typer.Option(
            "--window",
            metavar="MIN",
            help="tod: minutes before and after departure [default: as in the settings].",
        ),
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option("--budget", metavar="SIZE", help="budget: 200MB, or 25% of a full download."),
    ] = None,
    effort: options.Effort,
    at: options.At = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Try downloads on held-out drives.

    Localises each drive in a mission's download and in a full one, and compares with the forecast.

    \b
    Examples:
      engram lab try fleet.engram monday.framelog --select tod --depart 9:30
      engram lab try fleet.engram monday.framelog tuesday.framelog --select budget --budget 25%
    """
    from engram.cli.screen import Bars
    from engram.fleet.download.mission import DownloadOptions, budget_from_text, hour_from_text
    from engram.robot.localisers import session_of_drive
    from engram.robot.settings import RobotOptions
    from engram.sequences.opening import open_drive
    from engram_lab.trial import (
        LeftOut,
        TrialSummary,
        check_not_sent,
        summarise_trials,
        try_downloads,
    )

    budget_bytes, budget_percent = budget_from_text(budget)
    given = settings.read()
    if window is not None:
        given = replace(given, download=replace(given.download, window_min=window))
    asked = DownloadOptions.of(
        given.download,
        policy,
        strict="tod" in policy or policy == "paths",  # an hour without data is a row of its own
        depart_h=hour_from_text(start, "start"),
        arrive_h=hour_from_text(end, "end"),
        budget_bytes=budget_bytes,
        budget_percent=budget_percent,
    )
    opened = [(drive, open_drive(drive)) for drive in drives]
    check_not_sent(centre, opened, at)
    named = {str(session_of_drive(sequence).id): drive for drive, sequence in opened}
    left_out: list[LeftOut] = []
    trials = try_downloads(
        centre,
        {asked.select: asked, "copy": DownloadOptions.of(given.download, "copy")},
        [partial(open_drive, drive) for drive in drives],
        given.of_robot(),
        RobotOptions(**effort.over(given)),
        Bars(),
        at=at,
        left_out=lambda one: left_out.append(replace(one, drive=str(named[one.drive]))),
    )
    rows: list[TrialSummary | LeftOut] = [*summarise_trials(trials), *left_out]
    typer.echo(
        json.dumps([asdict(one) for one in rows])
        if as_json
        else "\n".join(one.text() for one in rows)
    )
