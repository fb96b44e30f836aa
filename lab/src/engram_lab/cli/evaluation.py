"""`engram evaluate …`: the papers' experiments."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options

if TYPE_CHECKING:
    from engram_lab.studies import DriveSet

evaluate = typer.Typer(
    name="evaluate",
    help="Redo the papers' experiments on simulated campaigns or your own frame logs.",
    no_args_is_help=True,
)

# What both studies take.
_Size = Annotated[str, typer.Option("--size", help="standard or full.")]
_Folds = Annotated[int, typer.Option("--folds", min=2, help="Of the cross-validation.")]
_OnlyFolds = Annotated[
    str | None,
    typer.Option("--only-folds", metavar="N,N…", help="Run these now, numbered from 0 [all]."),
]
_Seed = Annotated[
    int, typer.Option("--seed", min=0, help="Of the shuffle of sessions and the bootstrap.")
]
_Relocaliser = Annotated[
    str, typer.Option("--relocaliser", help="What finds the lost; none leaves them.")
]
_Workers = Annotated[int, typer.Option("--workers", min=1, help="Processes.")]
_ReportOnly = Annotated[
    bool, typer.Option("--report-only", help="Run nothing: tables and figures of what was run.")
]
_Campaigns = Annotated[
    Path | None, typer.Option("--campaigns", metavar="DIR", help="Where campaigns are rendered.")
]
_Work = Annotated[
    Path | None,
    typer.Option("--work", metavar="DIR", help="Maps and results [default: the user's cache]."),
]
_Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Tables and figures.")]


@evaluate.command("ranking")
def ranking(
    drives: Annotated[
        list[str],
        typer.Argument(
            metavar="CAMPAIGN|LOG…",
            help="Rendered campaigns (begbroke, or village@2 for another town seed), or frame "
            "logs of your own, which form one campaign.",
        ),
    ],
    *,
    size: _Size = "standard",
    policies: Annotated[
        str | None,
        typer.Option("--policies", metavar="NAME,NAME…", help="Only these [default: all]."),
    ] = None,
    lanes: Annotated[
        str | None,
        typer.Option(
            "--lanes",
            metavar="N,N…",
            help="Np; 0 for as many as there are candidates [default: 1,2,3,4,6,8,12,16,0].",
        ),
    ] = None,
    rounds: Annotated[
        str, typer.Option("--rounds", metavar="N,N…", help="Nr; the first for all policies.")
    ] = "1,2",
    folds: _Folds = 5,
    only_folds: _OnlyFolds = None,
    seed: _Seed = 0,
    map_sizes: Annotated[
        bool,
        typer.Option("--map-sizes/--no-map-sizes", help="Run earlier revisions too (Fig. 9)."),
    ] = True,
    live_folds: Annotated[
        int,
        typer.Option(
            "--live-folds", min=0, help="Folds that are also run guided and without memo, timed."
        ),
    ] = 1,
    relocaliser: _Relocaliser = "none",
    redo: Annotated[
        str | None,
        typer.Option("--redo", metavar="NAME,NAME…", help="Run these policies again."),
    ] = None,
    workers: _Workers = 2,
    report_only: _ReportOnly = False,
    campaigns: _Campaigns = None,
    work: _Work = None,
    out: _Out = Path("results/ranking"),
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Measure ranking policies by cross-validation over sessions.

    A run that was stopped goes on when it is given again; more policies or lanes later cost only
    what is new.

    \b
    Examples:
      engram evaluate ranking hamlet --policies distance,path --lanes 1,2 --folds 3
      engram evaluate ranking begbroke keble oxford --out results/ranking
      engram evaluate ranking begbroke --policies distance,path,recall --only-folds 0
      engram evaluate ranking monday.framelog tuesday.framelog … --out results/mine
    """
    from engram.cli.progress import progress
    from engram.robot import load_settings
    from engram_lab.policies import STUDIED
    from engram_lab.studies import (
        DEFAULT_LANES,
        RankingOptions,
        forget,
        make_plan,
        run,
        task_count,
        write_report,
    )

    asked = RankingOptions(
        policies=tuple(policies.split(",") if policies else STUDIED),
        lanes=_lanes(lanes) if lanes else DEFAULT_LANES,
        rounds=_numbers(rounds, "--rounds"),
        folds=folds,
        seed=seed,
        map_sizes=map_sizes,
        live_folds=live_folds,
        relocaliser=None if relocaliser == "none" else relocaliser,
        only_folds=_only(only_folds),
    )
    again = _redone(redo, asked.policies, report_only=report_only)
    started = time.perf_counter()
    settings = load_settings(config)
    plans = [
        make_plan(one, settings, asked, work or _work_folder())
        for one in _drive_sets(drives, size, campaigns)
    ]
    for plan in plans:
        if report_only:
            continue
        forget(plan, again)
        with progress(f"evaluate {plan.drives.name}", task_count(plan)) as advance:
            run(plan, workers, advance)
    _tell_files(write_report(out, plans), time.perf_counter() - started, as_json=as_json)


@evaluate.command("fleet")
def fleet(
    drives: Annotated[
        list[str],
        typer.Argument(
            metavar="CAMPAIGN|LOG…",
            help="Rendered campaigns (begbroke24h, or village@2 for another town seed), or frame "
            "logs of your own, which form one campaign.",
        ),
    ],
    *,
    size: _Size = "standard",
    arms: Annotated[
        str,
        typer.Option(
            "--arms",
            metavar="X,X…",
            help="A: distance, 8 attempts a frame; B: recall, 8 attempts; C: all candidates; "
            "P: A, but every match omits, as in the paper.",
        ),
    ] = "A,B,C",
    experiments: Annotated[
        str,
        typer.Option("--experiments", metavar="N,N…", help="Figures of Checkout My Map."),
    ] = "7,8,9,10",
    folds: _Folds = 5,
    only_folds: _OnlyFolds = None,
    groups: Annotated[
        str,
        typer.Option(
            "--groups", metavar="N,N…", help="Of the parallel build; further ones on one fold."
        ),
    ] = "4,2,8",
    seed: _Seed = 0,
    tried: Annotated[
        int | None,
        typer.Option(
            "--tried", min=1, metavar="N", help="Held-out drives a fold for downloads [all]."
        ),
    ] = None,
    relocaliser: _Relocaliser = "fabmap",
    workers: _Workers = 1,
    report_only: _ReportOnly = False,
    campaigns: _Campaigns = None,
    work: _Work = None,
    out: _Out = Path("results/fleet"),
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Measure merging, sharing and downloads as Gadd and Newman did, by cross-validation.

    A run that was stopped goes on when it is given again, map by map and drive by drive.

    \b
    Examples:
      engram evaluate fleet village --arms A --experiments 7,9
      engram evaluate fleet begbroke24h --out results/fleet
      engram evaluate fleet begbroke24h --arms A --experiments 7,9 --only-folds 0
      engram evaluate fleet begbroke24h --report-only
    """
    from engram.cli.progress import progress
    from engram.robot import load_settings
    from engram_lab.studies.fleet import (
        FleetOptions,
        fleet_tasks,
        make_fleet_plan,
        run_fleet,
        write_fleet_report,
    )

    counts = _numbers(groups, "--groups")
    asked = FleetOptions(
        arms=tuple(arms.split(",")),
        experiments=_numbers(experiments, "--experiments"),
        folds=folds,
        seed=seed,
        groups=counts[0],
        more_groups=counts[1:],
        tried=tried,
        relocaliser=None if relocaliser == "none" else relocaliser,
        only_folds=_only(only_folds),
    )
    started = time.perf_counter()
    settings = load_settings(config)
    plans = [
        make_fleet_plan(one, settings, asked, work or _work_folder())
        for one in _drive_sets(drives, size, campaigns)
    ]
    for plan in [] if report_only else plans:
        with progress(f"evaluate {plan.drives.name}", len(fleet_tasks(plan))) as advance:
            run_fleet(plan, workers, advance)
    _tell_files(write_fleet_report(out, plans), time.perf_counter() - started, as_json=as_json)


def _tell_files(files: list[Path], seconds: float, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"files": [str(one) for one in files], "seconds": round(seconds, 1)}))
    else:
        typer.echo("\n".join(str(one) for one in files))
        typer.echo(f"{seconds:.0f} s")


def _drive_sets(drives: list[str], size: str, campaigns: Path | None) -> list[DriveSet]:
    """Each name of a campaign is one; all frame logs together are one."""
    from engram.errors import ConfigError
    from engram_lab.cli.simulation import campaigns_folder, size_named
    from engram_lab.studies import DriveSet, drives_of, open_campaign

    names = [one for one in drives if _names_campaign(one)]
    if twice := [one for one in set(names) if names.count(one) > 1]:
        raise ConfigError(f"campaign {twice[0]!r} is given twice; give it once")
    logs = [Path(one) for one in drives if one not in names]
    folder = campaigns or campaigns_folder()
    sets = [open_campaign(name, folder, size_named(size)) for name in names]
    if logs:
        sets.append(DriveSet(logs[0].resolve().parent.name or "logs", drives_of(logs)))
    return sets


def _names_campaign(text: str) -> bool:
    """Whether it is to be a campaign: a known one comes before a folder of the same name."""
    from engram_lab.town import CAMPAIGNS

    name = text.partition("@")[0]
    return name in CAMPAIGNS or not (text.endswith(".framelog") or Path(text).exists())


def _redone(redo: str | None, policies: tuple[str, ...], *, report_only: bool) -> tuple[str, ...]:
    """Policies whose results are dropped: only such as are then run again."""
    from engram.errors import ConfigError

    if redo is None:
        return ()
    if report_only:
        raise ConfigError("--redo runs policies again, and --report-only runs nothing: give one")
    again = tuple(redo.split(","))
    for name in again:
        if name not in policies:
            raise ConfigError(
                f"--redo {name!r}: is not among the policies of this run ({', '.join(policies)})"
            )
    return again


def _lanes(text: str) -> tuple[int, ...]:
    from engram.errors import ConfigError
    from engram_lab.studies import UNLIMITED

    lanes = _numbers(text, "--lanes")
    if min(lanes) < 0:
        raise ConfigError(f"--lanes {text!r}: must be numbers from 1 on, or 0 for unlimited")
    return tuple(one or UNLIMITED for one in lanes)


def _only(folds: str | None) -> tuple[int, ...]:
    return () if folds is None else _numbers(folds, "--only-folds")


def _numbers(text: str, option: str) -> tuple[int, ...]:
    from engram.errors import ConfigError

    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"{option} {text!r}: expected numbers joined by commas") from None


def _work_folder() -> Path:
    from platformdirs import user_cache_path

    return user_cache_path("engram") / "evaluation"
