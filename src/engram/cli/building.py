"""`engram build`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options
from engram.errors import ConfigError

if TYPE_CHECKING:
    from engram.fleet.build import JudgeOptions, Orders


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
    seed: Annotated[
        int | None, typer.Option("--seed", help="Of random grouping [default: 0].")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Map on a Dask cluster instead."),
    ] = None,
    best_order: Annotated[
        bool, typer.Option("--best-order", help="Merge in all orders and keep the best.")
    ] = False,
    best_first: Annotated[
        bool,
        typer.Option("--best-first", help="Try each group first, the others in their order."),
    ] = False,
    validate: Annotated[
        list[Path] | None,
        typer.Option(
            "--validate", metavar="DRIVE", help="Judges orders, held out; may be repeated."
        ),
    ] = None,
    judge_at: Annotated[
        float | None,
        typer.Option(
            "--judge-at",
            metavar="METRES",
            min=0.0,
            help="What dead reckoning bears [default: 10].",
        ),
    ] = None,
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
    sure_inliers: options.SureInliers = 40,
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
      engram build town.engram logs/*.framelog --groups 8 --best-first --validate held-out.framelog
    """
    from engram.cli.progress import Bars
    from engram.fleet.build import BuildOptions, build_map
    from engram.fleet.merge import MergeOptions
    from engram.robot import RobotOptions, load_settings

    if seed is not None and grouping != "random":
        raise ConfigError("--seed is of random grouping: leave it out, or give --grouping random")
    found = None if relocaliser == "none" else relocaliser
    asked = BuildOptions(
        workers=workers,
        groups=groups,
        grouping=grouping,
        seed=0 if seed is None else seed,
        mapping=RobotOptions(
            policy=policy, lanes=lanes, rounds=rounds, relocaliser=found, author=author
        ),
        merging=MergeOptions(policy, lanes, rounds, found, author, sure_inliers),
        scheduler=scheduler,
        judge=_judge(validate or [], judge_at, _orders(best_order, best_first)),
    )
    report = build_map(centre, drives, load_settings(config), asked, keep=keep, monitor=Bars())
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        typer.echo(report.text())
    if report.interrupted:
        raise typer.Exit(130)


def _orders(best_order: bool, best_first: bool) -> Orders | None:
    """Which orders are tried; None where the groups are merged as they come.

    Raises:
        ConfigError: two things are asked for.
    """
    from engram.fleet.build import Orders

    if best_order and best_first:
        raise ConfigError("--best-order tries what --best-first does and more: give one of them")
    if best_order:
        return Orders.ALL
    return Orders.FIRST if best_first else None


def _judge(
    drives: list[Path], judge_at_m: float | None, orders: Orders | None
) -> JudgeOptions | None:
    """By what the best order is told; None where it is not searched for.

    Raises:
        ConfigError: it is searched for without drives; or it is not, and an option means nothing.
    """
    from engram.fleet.build import JudgeOptions

    if orders is not None:
        judge = JudgeOptions(drives, orders=orders)
        return judge if judge_at_m is None else replace(judge, judge_at_m=judge_at_m)
    for flag, given in (("--validate", bool(drives)), ("--judge-at", judge_at_m is not None)):
        if given:
            raise ConfigError(
                f"{flag} judges orders of merging: leave it out, or add --best-order or "
                "--best-first"
            )
    return None
