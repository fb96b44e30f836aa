"""`engram weak-spots`: where and when the next drives will hardly be localised."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options
from engram.errors import ConfigError

_HOURS = re.compile(r"(\d{1,2})-(\d{1,2})", re.ASCII)


def weak_spots(
    map_path: options.MapPath,
    *,
    hours: Annotated[
        str | None,
        typer.Option(
            "--hours",
            metavar="FROM-TO",
            help="Hours at which robots will drive, 6-22 or 20-4 [default: as they did].",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Draw the map by weakness: .png, .svg, .pdf.",
            parser=options.output_picture,
        ),
    ] = None,
    at: options.At = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Predict where the next drives will be lost.

    Names the stretches and hours, at most a tenth of the route and day, in which the next drives
    are expected to miss most; the reasons; and the drive that would help most. It learns from what
    past drives left in the map: their paths, the nodes that they saved, and the attempts
    of robots that map or --remember. Metres are those of the named drive, by odometry from its
    start. With --set weak_spots.latitude_deg=52 hours are compared by the height of the sun.

    \b
    Examples:
      engram weak-spots town.engram
      engram weak-spots town.engram --hours 6-22 --out weak.png
      engram weak-spots town.engram --set weak_spots.latitude_deg=51.8 --json
    """
    from engram.maps.map import open_map
    from engram.viewing.weakness import plot_weak_spots, weak_spots_text
    from engram.weak_spots import find_weak_spots

    driven, config = hours_from_text(hours), settings.read().weak_spots
    with open_map(map_path, at) as opened:
        found = find_weak_spots(opened, config, driven)
        if out is not None:
            plot_weak_spots(found, opened, out)
        options.show(found.to_dict(), partial(weak_spots_text, found, opened), as_json=as_json)


def hours_from_text(text: str | None) -> tuple[int, ...]:
    """Hours of day of "6-22", or of "20-4" past midnight; none of None."""
    if text is None:
        return ()
    match = _HOURS.fullmatch(text.strip())
    if match is None or max(map(int, match.groups())) > 24:
        raise ConfigError(f"--hours is {text!r}, must be whole hours of day such as 6-22 or 20-4")
    first, end = map(int, match.groups())
    length = (end - first) % 24 or 24
    return tuple((first + step) % 24 for step in range(length))
