"""`engram merge`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from engram.cli import options
from engram.cli.endings import PartlyDoneError, VerbInterruptedError
from engram.errors import EngramError

if TYPE_CHECKING:
    from engram.fleet.merge import MergeReport


def merge(
    centre: Annotated[
        Path,
        typer.Argument(
            metavar="CENTRE",
            help="The fleet's map, made if there is none.",
            parser=options.map_file,
        ),
    ],
    robots: Annotated[
        list[Path],
        typer.Argument(
            metavar="ROBOT...", help="Maps that robots hand in, in order.", parser=options.map_file
        ),
    ],
    *,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Merge into a copy and throw it away.")
    ] = False,
    require_better: Annotated[
        list[Path] | None,
        typer.Option(
            "--require-better",
            metavar="DRIVE",
            help="Refuse a merge in which this held-out drive localises worse; may be repeated.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE", help="Draw the centre before and after."),
    ] = None,
    policy: options.Policy = "recall",
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 4,
    relocaliser: Annotated[
        str,
        typer.Option(
            "--relocaliser",
            help="How segments without a known neighbour are placed: fabmap, bag-of-words, "
            "exhaustive or none.",
        ),
    ] = "fabmap",
    sure_inliers: options.SureInliers = 40,
    author: Annotated[
        str | None, typer.Option("--author", help="Who merges [default: the robots].")
    ] = None,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Merge robots' maps into the fleet map, adding only what it lacks.

    Each robot's map becomes one revision, or none. Its new nodes are replayed like a live drive:
    what localises is already covered; what does not is added, and so is what barely does and other
    drives rely on. Merging the same map twice changes nothing. If a later map fails, earlier merges
    are kept and reported.

    \b
    Examples:
      engram merge centre.engram r1.engram r2.engram
      engram merge centre.engram r1.engram --dry-run --picture merge.png
      engram merge centre.engram r1.engram --require-better held-out.framelog
    """
    from engram.cli.progress import Bars
    from engram.fleet.merge import MergeOptions
    from engram.fleet.merge import merge as merge_maps
    from engram.robot import load_settings

    asked = MergeOptions(
        policy,
        lanes,
        rounds,
        None if relocaliser == "none" else relocaliser,
        author,
        sure_inliers,
    )
    reports: list[MergeReport] = []

    class Told(Bars):
        def hear(self, report: MergeReport) -> None:
            reports.append(report)
            if not as_json:
                typer.echo(report.text())

    try:
        merge_maps(
            centre,
            robots,
            asked,
            Told(),
            settings=load_settings(config),
            dry_run=dry_run,
            require_better=require_better or (),
            picture=picture,
        )
    except EngramError as error:
        raise PartlyDoneError(error, _told(reports)) from error
    except KeyboardInterrupt:
        if not reports:
            raise
        stopped = VerbInterruptedError("interrupted; the merges reported are kept")
        raise PartlyDoneError(stopped, _told(reports)) from None
    if as_json:
        print(json.dumps(_told(reports)))
    if any(report.interrupted for report in reports):
        raise typer.Exit(130)


def _told(reports: list[MergeReport]) -> dict[str, Any]:
    """What ``merge --json`` prints."""
    return {"merges": [report.to_dict() for report in reports]}
