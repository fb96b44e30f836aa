"""`engram simulate`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options

if TYPE_CHECKING:
    from engram_lab.town import Size


def simulate(
    campaign: Annotated[
        str,
        typer.Argument(help="hamlet, village, begbroke, keble, oxford or begbroke24h."),
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where to [default: the user's cache]."),
    ] = None,
    size: Annotated[str, typer.Option("--size", help="standard or full.")] = "standard",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the town.")] = 1,
    images: Annotated[
        bool, typer.Option("--images", help="Images in KITTI's layout instead of frame logs.")
    ] = False,
    sessions: Annotated[
        str | None, typer.Option("--sessions", metavar="N,N…", help="Only these drives.")
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes.")] = 2,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Render a campaign of drives through a simulated town, with exact truth beside it.

    A run that was stopped goes on when it is given again.

    \b
    Examples:
      engram simulate hamlet --out campaigns
      engram simulate village --images --sessions 0,3 --out campaigns
    """
    from engram.cli.progress import progress
    from engram.robot import load_settings
    from engram_lab.town import SimulatedDrive, campaign_named
    from engram_lab.town.simulating import simulate as render

    chosen = campaign_named(campaign, seed, size_named(size))
    every = list(range(len(chosen.sessions)))
    numbers = every if sessions is None else _numbers(sessions)
    total = sum(len(SimulatedDrive(chosen, number)) for number in numbers)
    with progress(f"simulate {campaign}", total) as advance:
        report = render(
            chosen,
            out or campaigns_folder(),
            images=images,
            sessions=numbers,
            workers=workers,
            settings=load_settings(config),
            advance=advance,
        )
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        typer.echo(report.text())


def campaigns_folder() -> Path:
    """$ENGRAM_CAMPAIGNS, or a folder in the user's cache: rendered once, read often."""
    named = os.environ.get("ENGRAM_CAMPAIGNS")
    if named:
        return Path(named)
    from platformdirs import user_cache_path

    return user_cache_path("engram") / "campaigns"


def size_named(text: str) -> Size:
    """A campaign's size, by the name given on the command line."""
    from engram.errors import ConfigError
    from engram_lab.town import Size

    try:
        return Size(text)
    except ValueError:
        raise ConfigError(f"size {text!r} is unknown; known: {', '.join(Size)}") from None


def _numbers(text: str) -> list[int]:
    """Each once: a session named twice would be rendered by two workers into one file."""
    from engram.errors import ConfigError

    try:
        return sorted({int(part) for part in text.split(",")})
    except ValueError:
        raise ConfigError(
            f"--sessions {text!r}: expected numbers joined by commas, such as 0,3; leave the "
            "option out for all sessions"
        ) from None
