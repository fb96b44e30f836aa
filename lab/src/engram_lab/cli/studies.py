"""`engram lab evaluate …`: the papers' experiments."""

from __future__ import annotations

import functools
import inspect
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from engram.cli import options
from engram.errors import ConfigError

if TYPE_CHECKING:
    from engram.robot.settings import Settings
    from engram_lab.studies.drives import DriveSet
    from engram_lab.studies.faults.questions import Asked


def numbers(text: str, option: str) -> tuple[int, ...]:
    """Whole numbers joined by commas, in their order."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(
            f"{option} {text!r}: expected whole numbers joined by commas, such as 0,3"
        ) from None


evaluate = typer.Typer(
    name="evaluate",
    help="Repeat the papers' experiments on drives.",
    epilog="Start with: engram lab evaluate ranking hamlet --folds 3",
    no_args_is_help=True,
)


@dataclass(frozen=True)
class _Study:
    """What both studies take."""

    drives: Annotated[
        list[str],
        typer.Argument(
            metavar="CAMPAIGN|LOG",
            help="Rendered campaigns (begbroke, or village@2 for another town seed), or frame "
            "logs of your own, which form one campaign.",
        ),
    ]
    size: Annotated[
        str, typer.Option("--size", metavar="SIZE", help="Of campaigns: standard or full.")
    ] = "standard"
    first: Annotated[
        int | None,
        typer.Option(
            "--first",
            metavar="N",
            min=2,
            help="Only the first N drives of each campaign.",
            hidden=True,
        ),
    ] = None
    folds: Annotated[
        int,
        typer.Option(
            "--folds", metavar="N", min=2, help="Folds of the cross-validation.", hidden=True
        ),
    ] = 5
    only_folds: Annotated[
        str | None,
        typer.Option(
            "--only-folds",
            metavar="N,N…",
            help="Run these folds now, from 0 [default: all].",
            hidden=True,
        ),
    ] = None
    seed: Annotated[
        int,
        typer.Option(
            "--seed", metavar="N", min=0, help="Seed of shuffling and bootstrap.", hidden=True
        ),
    ] = 0
    workers: Annotated[
        int, typer.Option("--workers", metavar="N", min=1, help="Processes on this machine.")
    ] = 2
    report_only: Annotated[
        bool, typer.Option("--report-only", help="Report what was run before; run nothing.")
    ] = False
    campaigns: Annotated[
        Path | None,
        typer.Option(
            "--campaigns",
            metavar="DIR",
            help="Folder of the campaigns [default: the user's cache].",
            hidden=True,
        ),
    ] = None
    work: Annotated[
        Path | None,
        typer.Option(
            "--work",
            metavar="DIR",
            help="Folder of maps and results [default: the user's cache].",
            hidden=True,
        ),
    ] = None
    config: options.Settings = None
    as_json: options.Json = False

    def drive_sets(self, settings: Settings) -> list[DriveSet]:
        """Each name of a campaign is one; all frame logs together are one."""
        from engram.errors import ConfigError
        from engram_lab.studies.drives import DriveSet, drives_of, open_campaign, seen_by
        from engram_lab.town.campaigns import Size
        from engram_lab.town.simulating import campaigns_folder

        names = [one for one in self.drives if _names_campaign(one)]
        if twice := [one for one in set(names) if names.count(one) > 1]:
            raise ConfigError(f"campaign {twice[0]!r} is given twice; give it once")
        logs = [Path(one) for one in self.drives if one not in names]
        folder = self.campaigns or campaigns_folder()
        size = Size.named(self.size)
        sets = [open_campaign(name, folder, size, settings, self.first) for name in names]
        if logs:
            sets.append(DriveSet.of(drives_of(logs)))
        return [seen_by(one, settings) for one in sets]

    @property
    def chosen_folds(self) -> tuple[int, ...]:
        """Numbers of the folds that are run; empty for all."""
        return () if self.only_folds is None else numbers(self.only_folds, "--only-folds")

    @property
    def folder(self) -> Path:
        """Where maps and results are kept."""
        from platformdirs import user_cache_path

        return self.work or user_cache_path("engram") / "evaluation"

    def tell(self, files: list[Path], started: float) -> None:
        """Names the files that the report consists of."""
        seconds = time.perf_counter() - started
        if self.as_json:
            print(json.dumps({"files": [str(one) for one in files], "seconds": round(seconds, 1)}))
        else:
            typer.echo("\n".join([*map(str, files), f"{seconds:.0f} s"]))


def _studying(verb: Callable[..., None]) -> Callable[..., None]:
    """Gives a verb the options of `_Study` in addition to its own, as the argument `study`."""
    hints = get_type_hints(_Study, include_extras=True)
    defaults = {one.name: one.default for one in fields(_Study) if one.name != "drives"}
    shared = [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=defaults.get(name, inspect.Parameter.empty),
            annotation=hints[name],
        )
        for name in hints
    ]
    signature = inspect.signature(verb, eval_str=True)
    own = [one for one in signature.parameters.values() if one.name != "study"]

    @functools.wraps(verb)
    def run(**given: Any) -> None:
        verb(study=_Study(**{name: given.pop(name) for name in hints}), **given)

    parameters = [*shared, *own]
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    return run


@evaluate.command("ranking")
@_studying
def ranking(
    *,
    study: _Study,
    policies: Annotated[
        str | None,
        typer.Option("--policies", metavar="NAME,NAME…", help="Ranking policies [default: all]."),
    ] = None,
    lanes: Annotated[
        str | None,
        typer.Option(
            "--lanes",
            metavar="N,N…",
            help="Values of Np; 0: all candidates [default: 1,2,3,4,6,8,12,16,0].",
            hidden=True,
        ),
    ] = None,
    rounds: Annotated[
        str | None,
        typer.Option(
            "--rounds",
            metavar="N,N…",
            help="Values of Nr; the first for all policies [default: 1,2].",
            hidden=True,
        ),
    ] = None,
    map_sizes: Annotated[
        bool,
        typer.Option(
            "--map-sizes/--no-map-sizes", help="Also localise in earlier revisions (Fig. 9)."
        ),
    ] = True,
    live_folds: Annotated[
        int,
        typer.Option(
            "--live-folds",
            metavar="N",
            min=0,
            help="Folds that are also run in real time, and timed.",
            hidden=True,
        ),
    ] = 1,
    relocaliser: Annotated[
        str,
        typer.Option(
            "--relocaliser",
            metavar="NAME",
            help="How lost robots are found; truth finds all that match.",
            hidden=True,
        ),
    ] = "none",
    redo: Annotated[
        str | None,
        typer.Option("--redo", metavar="NAME,NAME…", help="Run these policies again.", hidden=True),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for tables and figures.")
    ] = Path("results/ranking"),
) -> None:
    """Compare ranking policies by cross-validation.

    The same command resumes a run that was stopped; added policies or lanes are run alone.

    \b
    Examples:
      engram lab evaluate ranking hamlet --policies distance,path --lanes 1,2 --folds 3
      engram lab evaluate ranking begbroke keble oxford --out results/ranking
      engram lab evaluate ranking begbroke --config linegar2015
      engram lab evaluate ranking begbroke --policies distance,path,recall --only-folds 0
      engram lab evaluate ranking monday.framelog tuesday.framelog … --out results/mine
    """
    from engram.cli.screen import Bars
    from engram.cli.settings import read_settings
    from engram_lab.policies import STUDIED
    from engram_lab.studies.configurations import DEFAULT_LANES, UNLIMITED
    from engram_lab.studies.ranking_report import write_report
    from engram_lab.studies.running import RankingOptions, forget, make_plan, run

    started, settings = time.perf_counter(), read_settings(study.config).for_descriptor(None)
    drive = settings.drive
    asked = RankingOptions(
        policies=tuple(policies.split(",")) if policies else (*STUDIED, drive.ranking),
        lanes=tuple(n or UNLIMITED for n in numbers(lanes, "--lanes"))
        if lanes
        else (*DEFAULT_LANES, drive.lanes),
        rounds=numbers(rounds, "--rounds") if rounds else (1, 2, drive.rounds),
        folds=study.folds,
        seed=study.seed,
        map_sizes=map_sizes,
        live_folds=live_folds,
        relocaliser=None if relocaliser == "none" else relocaliser,
        only_folds=study.chosen_folds,
    )
    again = _redone(redo, asked.policies, report_only=study.report_only)
    plans = [make_plan(one, settings, asked, study.folder) for one in study.drive_sets(settings)]
    for plan in [] if study.report_only else plans:
        forget(plan, again)
        run(plan, study.workers, Bars())
    report = write_report(out, plans)
    if not study.as_json:
        typer.echo(report.text)
    study.tell(report.files, started)


@evaluate.command("budgets")
@_studying
def budgets(
    *,
    study: _Study,
    policies: Annotated[
        str | None,
        typer.Option(
            "--policies",
            metavar="NAME,NAME…",
            help="Ranking policies [default: distance,path,path-near,recall].",
        ),
    ] = None,
    sizes: Annotated[
        str | None,
        typer.Option(
            "--sizes",
            metavar="N,N…",
            help="Drives in the map; all, too [default: 2,5,10,20,40,80].",
        ),
    ] = None,
    attempts: Annotated[
        str | None,
        typer.Option("--attempts", metavar="N,N…", help="Attempts a frame [default: 1,2,4,8,16]."),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the tables.")
    ] = Path("results/budgets"),
) -> None:
    """Show where ranking pays.

    Policies by experiences at a place, attempts a frame, and processor time. Maps save every drive
    whole. The same command resumes a run that was stopped.

    \b
    Examples:
      engram lab evaluate budgets begbroke24h --only-folds 0
      engram lab evaluate budgets hamlet --folds 3 --sizes 2 --attempts 1,4
    """
    from engram.cli.screen import Bars
    from engram.cli.settings import read_settings
    from engram_lab.studies.budgets import (
        ATTEMPTS,
        POLICIES,
        SIZES,
        BudgetOptions,
        saving_everything,
        write_budgets,
    )
    from engram_lab.studies.running import make_plan, run

    started, settings = time.perf_counter(), read_settings(study.config).for_descriptor(None)
    settings = saving_everything(settings)
    asked = BudgetOptions(
        policies=tuple(policies.split(",")) if policies else POLICIES,
        lanes=numbers(attempts, "--attempts") if attempts else ATTEMPTS,
        rounds=(1,),
        folds=study.folds,
        seed=study.seed,
        live_folds=0,
        only_folds=study.chosen_folds,
        sizes=numbers(sizes, "--sizes") if sizes else SIZES,
    )
    plans = [make_plan(one, settings, asked, study.folder) for one in study.drive_sets(settings)]
    for plan in [] if study.report_only else plans:
        run(plan, study.workers, Bars())
    study.tell(write_budgets(out, plans), started)


@evaluate.command("fleet")
@_studying
def fleet(
    *,
    study: _Study,
    arms: Annotated[
        str | None,
        typer.Option(
            "--arms",
            metavar="X,X…",
            help="A: distance, 8 attempts per frame; B: recall, 8 attempts; C: all candidates; "
            "P: A, but every match omits its node; S: as the settings say [default: A,B,C; S where "
            "the settings rank or merge otherwise].",
        ),
    ] = None,
    experiments: Annotated[
        str,
        typer.Option("--experiments", metavar="N,N…", help="Figures of Gadd and Newman (2016)."),
    ] = "7,8,9,10",
    groups: Annotated[
        str,
        typer.Option(
            "--groups",
            metavar="N,N…",
            help="Groups of the parallel build; all but the first on one fold.",
            hidden=True,
        ),
    ] = "4,2,8",
    tried: Annotated[
        int | None,
        typer.Option(
            "--tried",
            min=1,
            metavar="N",
            help="Held-out drives per fold for downloads [default: all].",
            hidden=True,
        ),
    ] = None,
    relocaliser: Annotated[
        str,
        typer.Option(
            "--relocaliser",
            metavar="NAME",
            help="How lost robots are found; merges have merge.relocaliser.",
            hidden=True,
        ),
    ] = "fabmap",
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for tables and figures.")
    ] = Path("results/fleet"),
) -> None:
    """Measure merging, sharing and downloads.

    Runs the experiments of Gadd and Newman (2016) with cross-validation. The same command resumes
    a run that was stopped.

    \b
    Examples:
      engram lab evaluate fleet village --arms A --experiments 7,9
      engram lab evaluate fleet begbroke24h --out results/fleet
      engram lab evaluate fleet begbroke24h --arms A --experiments 7,9 --only-folds 0
      engram lab evaluate fleet begbroke24h --config gadd2016
      engram lab evaluate fleet begbroke24h --report-only
    """
    from engram.cli.screen import Bars
    from engram.cli.settings import read_settings
    from engram_lab.studies.fleet.experiments import run_fleet
    from engram_lab.studies.fleet.plan import FleetOptions, arms_for, make_fleet_plan
    from engram_lab.studies.fleet.report import write_fleet_report

    started, settings = time.perf_counter(), read_settings(study.config).for_descriptor(None)
    counts = numbers(groups, "--groups")
    asked = FleetOptions(
        arms=tuple(arms.split(",")) if arms else arms_for(settings),
        experiments=numbers(experiments, "--experiments"),
        folds=study.folds,
        seed=study.seed,
        groups=counts[0],
        more_groups=counts[1:],
        tried=tried,
        relocaliser=None if relocaliser == "none" else relocaliser,
        only_folds=study.chosen_folds,
    )
    plans = [
        make_fleet_plan(one, settings, asked, study.folder) for one in study.drive_sets(settings)
    ]
    for plan in [] if study.report_only else plans:
        run_fleet(plan, study.workers, Bars())
    study.tell(write_fleet_report(out, plans), started)


def _names_campaign(text: str) -> bool:
    """Whether it is to be a campaign: a known one comes before a folder of the same name."""
    from engram_lab.town.campaigns import CAMPAIGNS

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
                f"--redo {name!r}: not among the policies of this run ({', '.join(policies)})"
            )
    return again


@evaluate.command("faults")
def faults(
    *,
    only: Annotated[
        str | None,
        typer.Option(
            "--only",
            metavar="NAME,NAME…",
            help="Ask these questions, or inject these faults [default: all faults].",
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials", metavar="N", min=1, help="Trials in all; of a question see its text [1000]."
        ),
    ] = None,
    towns: Annotated[
        str | None, typer.Option("--towns", metavar="N,N…", help="Seeds of a question's towns.")
    ] = None,
    campaign: Annotated[
        str,
        typer.Option(
            "--campaign", metavar="NAME", help="Of a question: NAME or NAME@SEED.", hidden=True
        ),
    ] = "",
    mapped: Annotated[
        str | None,
        typer.Option("--mapped", metavar="N,N…", help="Drives that are mapped.", hidden=True),
    ] = None,
    live: Annotated[
        str | None,
        typer.Option("--live", metavar="N,N…", help="Drives that are localised.", hidden=True),
    ] = None,
    features: Annotated[
        str, typer.Option("--features", metavar="KIND", help="Of a question: brief or net.")
    ] = "brief",
    config: options.Settings = None,
    changes: Annotated[
        list[str], typer.Option("--set", metavar="KEY=VALUE", help="A setting of the robots.")
    ] = [],  # noqa: B006
    report_only: Annotated[
        bool, typer.Option("--report-only", help="Report what was run before; run nothing.")
    ] = False,
    work: Annotated[
        Path | None,
        typer.Option(
            "--work",
            metavar="FILE",
            help="File of the trials, folder of questions [default: in the user's cache].",
            hidden=True,
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="The tables, in Markdown.")
    ] = Path("results/faults.md"),
    as_json: options.Json = False,
) -> None:
    """Inject faults into drives; count false fixes.

    Localises clips (rendered once; ENGRAM_DATA names real ones) in maps of other days, and adds
    them to these maps. The same command resumes a run that was stopped; each version of the
    method has a file of its own. --only also takes questions: misplaced robots, merged maps,
    differently mounted cameras, and others. An unknown name lists the questions.

    \b
    Examples:
      engram lab evaluate faults --trials 100
      engram lab evaluate faults --only stall,blackout --trials 100
      engram lab evaluate faults --only hints --towns 407 --trials 1500
      engram lab evaluate faults --report-only --out faults.md
    """
    from platformdirs import user_cache_path

    from engram.cli.settings import read_settings
    from engram_lab.studies.faults.questions import QUESTIONS, Asked
    from engram_lab.studies.faults.staging import KINDS
    from engram_lab.studies.streets import HELD_OUT_TOWNS

    names = only.split(",") if only else list(KINDS)
    if wrong := [one for one in names if one not in {*KINDS, *QUESTIONS}]:
        raise ConfigError(
            f"--only {wrong[0]!r}: the questions are {', '.join(QUESTIONS)}; "
            f"the faults are {', '.join(KINDS)}"
        )
    folder = user_cache_path("engram") / "faults"
    asked = Asked(
        settings=read_settings(config, changes).of_robot(features),
        folder=work or folder,
        towns=numbers(towns, "--towns") if towns else HELD_OUT_TOWNS,
        campaign=campaign,
        mapped=numbers(mapped, "--mapped") if mapped else (),
        live=numbers(live, "--live") if live else (),
        trials=trials,
    )
    questions = [one for one in names if one in QUESTIONS]
    if questions:
        _answer(questions, asked, as_json)
    if injected := [one for one in names if one in KINDS]:
        _inject(injected, trials or 1000, work, out, report_only=report_only, as_json=as_json)


def _answer(names: list[str], asked: Asked, as_json: bool) -> None:
    """Asks questions one after another."""
    from dataclasses import asdict

    from engram_lab.studies.faults.questions import QUESTIONS

    answers = {}
    for name in names:
        found = []
        if not as_json:
            typer.echo(f"{name}: {(QUESTIONS[name].__doc__ or '').splitlines()[0]}")
        for one in QUESTIONS[name](asked):
            found.append(asdict(one))
            if not as_json:
                typer.echo(one.text())
        answers[name] = found
    if as_json:
        print(json.dumps(answers))


def _inject(
    names: list[str], trials: int, work: Path | None, out: Path, *, report_only: bool, as_json: bool
) -> None:
    """Runs the trials of some faults that are missing, and reports."""
    from dataclasses import asdict

    from platformdirs import user_cache_path

    from engram.cli.screen import Bars
    from engram_lab.studies.faults.clips import JUDGING, REVERSED, render
    from engram_lab.studies.faults.staging import default_file, fault_of, read_trials
    from engram_lab.studies.faults.study import headline, page, run

    file = work or default_file(user_cache_path("engram") / "faults")
    if not report_only:
        bars = Bars()
        render([*JUDGING, *REVERSED], bars)
        wanted = [number for number in range(trials) if fault_of(number) in names]
        made = {one.number for one in read_trials(file)}
        with bars.stage("faults", len(set(wanted) - made)) as monitor:
            for _ in run(file, trials, monitor=monitor, only=names):
                pass
    found = [one for one in read_trials(file) if one.fault in names]
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page(found), encoding="utf-8")
    if as_json:
        print(json.dumps([asdict(one) for one in found]))
    else:
        typer.echo(f"{headline(found)}\n{out}")


@evaluate.command("scale")
def scale(
    *,
    sizes: Annotated[
        str,
        typer.Option(
            "--sizes", metavar="N,N,…", help="Nodes of the cities; whole streets of 2500."
        ),
    ] = "5000,20000,100000",
    maps: Annotated[
        Path,
        typer.Option("--maps", metavar="DIR", help="Cities; those made before are used again."),
    ] = Path("results/scale"),
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="The table, in Markdown.")
    ] = Path("results/scale.md"),
    as_json: options.Json = False,
) -> None:
    """Measure what grows with the map, in synthetic cities.

    A city of 100,000 nodes takes 0.9 GB and a minute to make.

    \b
    Examples:
      engram lab evaluate scale --sizes 5000,20000,100000
    """
    from engram.cli.screen import Bars
    from engram_lab.studies.scale import Figures, measure, table

    wanted, found = numbers(sizes, "--sizes"), list[Figures]()
    with Bars().stage("cities", len(wanted)) as monitor:
        for one in measure(wanted, maps):
            found.append(one)
            monitor.advance()
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(table(found), encoding="utf-8")
    if as_json:
        print(json.dumps([{"nodes": one.nodes, **one.values} for one in found]))
    else:
        typer.echo(f"{table(found)}\n{out}")


@evaluate.command("all")
def everything(
    *,
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="NAME,NAME…", help="Run these studies [default: all]."),
    ] = None,
    hours: Annotated[
        float | None,
        typer.Option("--hours", metavar="N", min=0.0, help="Run what fits into so many hours."),
    ] = None,
    planned: Annotated[
        bool, typer.Option("--plan", help="Show what is done, stale or missing; run nothing.")
    ] = False,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="A folder of results for each study.")
    ] = Path("results"),
    as_json: options.Json = False,
) -> None:
    """Run every study that README and docs rest on.

    The same command resumes. Results are stale once the method, the world or a study's commands
    have changed; they are set aside. A study's manifest stands next to its tables: versions,
    commands, settings, machine and time. `python -m engram_lab.studies.pages keep` takes tables
    into the repository and draws the pages.

    \b
    Examples:
      engram lab evaluate all --plan
      engram lab evaluate all --hours 1
      engram lab evaluate all --only real-images,conditions --out results
    """
    from dataclasses import asdict

    from engram.errors import EngramError
    from engram_lab.studies.evidence import COLUMNS, plan, run_all
    from engram_lab.studies.plan import plain_table

    names = only.split(",") if only else []
    found = plan(out, names)
    if not planned:
        failed = run_all(out, names, hours, lambda line: typer.echo(line, err=True))
        found = plan(out, names)
    if as_json:
        print(json.dumps([asdict(one) for one in found]))
    else:
        left = sum(one.minutes for one in found if one.to_run)
        typer.echo("\n".join(plain_table([one.row() for one in found], COLUMNS)))
        typer.echo(f"{left / 60:.1f} hours left on two cores")
    if not planned and failed:
        raise EngramError(f"{len(failed)} of the studies failed: {', '.join(failed)}")


@evaluate.command("public")
def public(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="utias, 4seasons, robotcar or kitti.")
    ],
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where the data set is on this machine.")
    ],
    *,
    features: Annotated[
        str, typer.Option("--features", metavar="KIND", help="brief or net.")
    ] = "brief",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Logs, maps, page [default: results/NAME]."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Evaluate a public data set, and write one page.

    Protocol and settings are fixed: the first drive is mapped, each later one is localised in its
    map and in one of all earlier drives. For KITTI: odometry and loops. The same command resumes.
    docs/datasets.md says where the sets are.

    \b
    Examples:
      engram lab evaluate public utias UTIAS-In-The-Dark
      engram lab evaluate public kitti dataset --features net
    """
    from engram.cli.screen import Bars
    from engram_lab.studies.public import study_of

    page = study_of(name, folder, out or Path("results") / name, features).run(Bars())
    if as_json:
        print(json.dumps({"page": str(page)}))
    else:
        typer.echo(f"{page.read_text(encoding='utf-8')}\n{page}")


@evaluate.command("peers")
def peers(
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Maps, answers and the table.")
    ] = Path("results/peers"),
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Of the town.")] = 21,
    workers: Annotated[
        int, typer.Option("--workers", metavar="N", min=1, help="Processes that render.")
    ] = 2,
    as_json: options.Json = False,
) -> None:
    """Compare Engram with other systems on the same drives.

    Ten drives of a small simulated town, and the real clips that ENGRAM_DATA names: Engram with
    both kinds of features, and SIFT, VLAD and PnP as in hloc, where pycolmap is installed. The
    same command resumes a run that was stopped.

    \b
    Examples:
      engram lab evaluate peers
      engram lab evaluate peers --out results/peers22 --seed 22
    """
    from engram.cli.screen import Bars
    from engram_lab.studies.peers import run_peers, text_of
    from engram_lab.town.simulating import campaigns_folder

    named = os.environ.get("ENGRAM_DATA")
    data = Path(named) if named else None
    rows = run_peers(out, campaigns_folder(), data, seed=seed, workers=workers, monitor=Bars())
    typer.echo(json.dumps(rows) if as_json else f"{text_of(rows)}\n{out / 'peers.csv'}")
