"""`engram download`."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options
from engram.cli.endings import PartlyDoneError, VerbInterruptedError
from engram.errors import EngramError

if TYPE_CHECKING:
    from engram.drive import Settings
    from engram.fleet import DownloadOptions, LeftOut, TrialSummary


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
    check: Annotated[
        list[Path] | None,
        typer.Option(
            "--check",
            metavar="DRIVE",
            help="Localise this held-out drive in such a download and in everything, and say what "
            "was promised and what came of it; repeat.",
        ),
    ] = None,
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 2,
    at: options.At = None,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Write the part of a centre that a robot needs for its next mission, as a map of its own.

    Times are hours of day at the place: mean solar time where longitudes are known, else civil
    time. The robot drives with the download alone, adds to it, and hands it back to `merge`. Where
    a --check fails after OUT was written, OUT stays and is told of.

    \b
    Examples:
      engram download centre.engram r1.engram
      engram download centre.engram r1.engram --policy tod --start 9:30
      engram download centre.engram r1.engram --policy tod+paths --start 9:30 --end 11:00
      engram download centre.engram r1.engram --policy budget --budget 200MB --start 17:00
      engram download centre.engram r1.engram --policy budget --budget 25% --start 17:00
      engram download centre.engram r1.engram --policy tod --start 9:30 --check monday.framelog
    """
    from engram.cli.progress import progress
    from engram.drive import load_settings
    from engram.fleet import DownloadOptions, budget_from_text, hour_from_text
    from engram.fleet import download as send

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
    drives = _looked_at(centre, check or [], at)
    settings = load_settings(config)
    report = send(centre, out, asked, at=at, progress=progress)
    if not as_json:
        typer.echo(report.text())
    try:
        tried, left_out = _check(centre, asked, drives, settings, lanes, rounds, at)
    except EngramError as error:
        raise PartlyDoneError(error, {**report.to_dict(), "check": []}) from error
    except KeyboardInterrupt:
        stopped = VerbInterruptedError(f"interrupted; {out} is whole")
        raise PartlyDoneError(stopped, {**report.to_dict(), "check": []}) from None
    if as_json:
        rows = [*map(asdict, tried), *(one.to_dict() for one in left_out)]
        print(json.dumps({**report.to_dict(), "check": rows}))
        return
    for line in (*(one.text() for one in tried), *(one.text() for one in left_out)):
        typer.echo(line)


def _looked_at(centre: Path, drives: list[Path], at: str | None) -> dict[str, Path]:
    """By session; what cannot judge shall not fail behind a download that is written."""
    from engram.drive import open_drive, session_of_drive
    from engram.fleet.trial import check_not_sent

    opened = [(drive, open_drive(drive)) for drive in drives]
    check_not_sent(centre, opened, at)
    return {str(session_of_drive(sequence).id): drive for drive, sequence in opened}


def _check(
    centre: Path,
    asked: DownloadOptions,
    drives: dict[str, Path],
    settings: Settings,
    lanes: int,
    rounds: int,
    at: str | None,
) -> tuple[list[TrialSummary], list[LeftOut]]:
    """What such downloads promised held-out drives and what came of it, and drives left out."""
    from functools import partial

    from engram.cli.progress import progress
    from engram.drive import LocaliseOptions, open_drive
    from engram.fleet import DownloadOptions, summarise_trials, try_downloads

    left_out: list[LeftOut] = []

    def note(one: LeftOut) -> None:
        left_out.append(replace(one, drive=str(drives[one.drive])))

    trials = try_downloads(
        centre,
        {asked.policy: asked, "copy": DownloadOptions()},
        [partial(open_drive, drive) for drive in drives.values()],
        settings,
        LocaliseOptions(lanes=lanes, rounds=rounds),
        progress,
        at=at,
        left_out=note,
    )
    return summarise_trials(trials), left_out
