"""`engram download`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options


def download(
    centre: Annotated[
        Path,
        typer.Argument(metavar="CENTRE", help="The fleet's map.", parser=options.map_file),
    ],
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="The robot's map, made anew.", parser=options.map_file),
    ],
    *,
    policy: Annotated[
        str,
        typer.Option("--policy", help="copy, tod, paths, tod+paths, region, route or budget."),
    ] = "copy",
    start: Annotated[
        str | None, typer.Option("--start", metavar="H:MM", help="When the mission begins.")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--end", metavar="H:MM", help="When the mission ends.")
    ] = None,
    date: Annotated[
        str | None,
        typer.Option(
            "--date", metavar="DAY", help="Of the mission: 2026-11-17 [default: newest drive's]."
        ),
    ] = None,
    latitude: Annotated[
        float | None,
        typer.Option("--latitude", metavar="DEG", help="For the sun [default: learnt]."),
    ] = None,
    window: Annotated[
        float, typer.Option("--window", metavar="MIN", help="tod: how far from the start.")
    ] = 180.0,
    epoch: Annotated[
        float, typer.Option("--epoch", metavar="MIN", help="paths: length of an epoch.")
    ] = 60.0,
    best: Annotated[
        float, typer.Option("--best", metavar="%", help="paths: share of each epoch's paths.")
    ] = 50.0,
    buffer: Annotated[
        float, typer.Option("--buffer", metavar="MIN", help="paths: widens the mission.")
    ] = 0.0,
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget",
            metavar="SIZE",
            help="budget: 200MB, 1.5GiB, 4096, or 25% of what everything takes.",
        ),
    ] = None,
    near: Annotated[
        list[str] | None,
        typer.Option("--near", metavar="NODE", help="region, budget: around this node; repeat."),
    ] = None,
    route: Annotated[
        str | None,
        typer.Option("--route", metavar="SESSION", help="route, budget: the way of this session."),
    ] = None,
    radius: Annotated[
        float, typer.Option("--radius", metavar="M", help="Of regions and routes.")
    ] = 20.0,
    thumbnails: Annotated[
        bool | None,
        typer.Option(
            "--thumbnails/--no-thumbnails",
            help="Send pictures for people too [default: not with budget].",
        ),
    ] = None,
    at: options.At = None,
    as_json: options.Json = False,
) -> None:
    """Write the part of a centre that a robot needs for its next mission, as a map of its own.

    Times are hours of day at the place: mean solar time where longitudes are known, else civil
    time. The robot drives with the download alone, adds to it, and hands it back to `merge`.

    \b
    Examples:
      engram download centre.engram r1.engram
      engram download centre.engram r1.engram --policy tod --start 9:30
      engram download centre.engram r1.engram --policy tod+paths --start 9:30 --end 11:00
      engram download centre.engram r1.engram --policy budget --budget 200MB --start 17:00
      engram download centre.engram r1.engram --policy budget --budget 25% --start 17:00
    """
    from engram.cli.progress import Bars
    from engram.fleet.download import DownloadOptions, budget_from_text, hour_from_text
    from engram.fleet.download import download as send

    budget_bytes, budget_percent = budget_from_text(budget)
    asked = DownloadOptions(
        policy=policy,
        start_h=hour_from_text(start, "start"),
        end_h=hour_from_text(end, "end"),
        day=date,
        latitude_deg=latitude,
        window_min=window,
        epoch_min=epoch,
        best_percent=best,
        buffer_min=buffer,
        budget_bytes=budget_bytes,
        budget_percent=budget_percent,
        near=tuple(near or ()),
        route=route,
        radius_m=radius,
        thumbnails=thumbnails,
    )
    report = send(centre, out, asked, at=at, monitor=Bars())
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        typer.echo(report.text())
