"""`engram build`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from engram.cli import options


def build(
    centre: Annotated[
        Path,
        typer.Argument(
            metavar="CENTRE", help="The map, made if there is none.", parser=options.map_file
        ),
    ],
    drives: Annotated[
        list[str], typer.Argument(metavar="LOG...", help="Frame logs or drives; paths or URLs.")
    ],
    *,
    workers: Annotated[
        int, typer.Option("--workers", min=1, help="Processes of this machine at a time.")
    ] = 2,
    groups: Annotated[int, typer.Option("--groups", min=1, help="Groups of drives.")] = 2,
    grouping: Annotated[
        str,
        typer.Option(
            "--grouping",
            metavar="HOW",
            help="chronological, random, by-condition, or a file with one group a line.",
        ),
    ] = "chronological",
    seed: Annotated[int, typer.Option("--seed", help="Of random grouping.")] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Map on a Dask cluster instead."),
    ] = None,
    best_order: Annotated[
        bool, typer.Option("--best-order", help="Merge in all orders and keep the best.")
    ] = False,
    validate: Annotated[
        list[Path] | None,
        typer.Option(
            "--validate", metavar="DRIVE", help="Judges orders, held out; may be repeated."
        ),
    ] = None,
    judge_at: Annotated[
        float,
        typer.Option("--judge-at", metavar="METRES", min=0.0, help="What dead reckoning bears."),
    ] = 10.0,
    keep: Annotated[
        bool,
        typer.Option("--keep", help="Leave the groups' maps in CENTRE.build till the next build."),
    ] = False,
    policy: options.Policy = "recall",
    lanes: options.Lanes = 2,
    rounds: options.Rounds = 4,
    relocaliser: Annotated[
        str, typer.Option("--relocaliser", help="fabmap, bag-of-words, exhaustive or none.")
    ] = "fabmap",
    author: Annotated[
        str | None, typer.Option("--author", help="Who builds [default: the robots].")
    ] = None,
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Build a map from many drives: groups mapped side by side, then merged.

    What was done is kept in CENTRE.build until the build is complete; the same command goes on
    after an interruption or a crash. Equal drives and options give an equal map. Drives that
    CENTRE has already are left out.

    \b
    Examples:
      engram build town.engram logs/*.framelog --workers 4 --groups 4
      engram build town.engram logs/*.framelog --groups 4 --grouping random --seed 7
      engram build town.engram logs/*.framelog --groups 3 --best-order --validate held-out.framelog
    """
    from engram.cli.progress import progress
    from engram.drive import MapOptions, load_settings
    from engram.fleet import BuildOptions, JudgeOptions, MergeOptions, build_map

    found = None if relocaliser == "none" else relocaliser
    asked = BuildOptions(
        workers=workers,
        groups=groups,
        grouping=grouping,
        seed=seed,
        mapping=MapOptions(
            policy=policy, lanes=lanes, rounds=rounds, relocaliser=found, author=author
        ),
        merging=MergeOptions(policy, lanes, rounds, found, author),
        scheduler=scheduler,
        judge=JudgeOptions(validate or [], judge_at) if best_order or validate else None,
    )
    report = build_map(centre, drives, load_settings(config), asked, keep=keep, progress=progress)
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        typer.echo(report.text())
    if report.interrupted:
        raise typer.Exit(130)
