"""`engram try`."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options


def try_(
    centre: Annotated[
        Path, typer.Argument(metavar="CENTRE", help="The fleet's map.", parser=options.map_file)
    ],
    drives: Annotated[
        list[Path],
        typer.Argument(metavar="DRIVE...", help="Drives that the map does not hold."),
    ],
    *,
    policy: Annotated[
        str, typer.Option("--policy", help="copy, tod, paths, tod+paths or budget.")
    ] = "copy",
    start: Annotated[
        str | None, typer.Option("--start", metavar="H:MM", help="When the mission begins.")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--end", metavar="H:MM", help="When the mission ends.")
    ] = None,
    window: Annotated[
        float, typer.Option("--window", metavar="MIN", help="tod: how far from the start.")
    ] = 180.0,
    budget: Annotated[
        str | None, typer.Option("--budget", metavar="SIZE", help="budget: 200MB or 25%.")
    ] = None,
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 2,
    at: options.At = None,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Localise held-out drives in a mission's download and in everything; compare with forecasts.

    \b
    Examples:
      engram try centre.engram monday.framelog --policy tod --start 9:30
      engram try centre.engram monday.framelog tuesday.framelog --policy budget --budget 25%
    """
    from engram.cli.progress import Bars
    from engram.fleet.download import DownloadOptions, budget_from_text, hour_from_text
    from engram.robot import LocaliseOptions, load_settings, open_drive, session_of_drive
    from engram_lab.trial import LeftOut, check_not_sent, summarise_trials, try_downloads

    budget_bytes, budget_percent = budget_from_text(budget)
    asked = DownloadOptions(
        policy=policy,
        start_h=hour_from_text(start, "start"),
        end_h=hour_from_text(end, "end"),
        window_min=window,
        budget_bytes=budget_bytes,
        budget_percent=budget_percent,
    )
    opened = [(drive, open_drive(drive)) for drive in drives]
    check_not_sent(centre, opened, at)
    named = {str(session_of_drive(sequence).id): drive for drive, sequence in opened}
    left_out: list[LeftOut] = []
    trials = try_downloads(
        centre,
        {asked.policy: asked, "copy": DownloadOptions()},
        [partial(open_drive, drive) for drive in drives],
        load_settings(config),
        LocaliseOptions(lanes=lanes, rounds=rounds),
        Bars(),
        at=at,
        left_out=lambda one: left_out.append(replace(one, drive=str(named[one.drive]))),
    )
    tried = summarise_trials(trials)
    if as_json:
        print(json.dumps([*map(asdict, tried), *(one.to_dict() for one in left_out)]))
        return
    for line in (*(one.text() for one in tried), *(one.text() for one in left_out)):
        typer.echo(line)
