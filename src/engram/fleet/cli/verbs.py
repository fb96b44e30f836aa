"""`engram merge`, `download`, `build`, `dream`, `forget`: the fleet map."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from engram.cli import options
from engram.cli.history import AUTHOR, Message, user
from engram.cli.options import ExitStatus, PartlyDoneError, VerbInterruptedError
from engram.cli.wording import undo_text
from engram.errors import ConfigError, EngramError

if TYPE_CHECKING:
    from engram.cli.settings import AllSettings
    from engram.fleet.build.orders import JudgeOptions
    from engram.fleet.download.downloading import DownloadReport
    from engram.fleet.download.updating import UpdateReport
    from engram.fleet.merge.merge_settings import MergeOptions
    from engram.fleet.merge.report import MergeReport


def merge(
    centre: options.WrittenFleetMap,
    robots: Annotated[
        list[Path],
        typer.Argument(
            metavar="ROBOT", help="Robots' maps, merged in this order.", parser=options.map_file
        ),
    ],
    *,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Merge into a copy and discard it.")
    ] = False,
    require_better: Annotated[
        list[Path] | None,
        typer.Option(
            "--require-better",
            metavar="DRIVE",
            help="Refuse a merge after which this held-out drive localises worse; repeatable.",
        ),
    ] = None,
    keep: Annotated[
        bool,
        typer.Option("--keep", help="Keep the robots' maps in FLEET.handed for engram dream."),
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            metavar="FILE",
            help="Draw the fleet map before and after.",
            parser=options.output_picture,
        ),
    ] = None,
    geometry: Annotated[
        bool, typer.Option("--geometry", help="Count the wrong edges of each result.")
    ] = False,
    require_geometry: Annotated[
        bool, typer.Option("--require-geometry", help="Refuse a merge that adds wrong edges.")
    ] = False,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Add robots' maps to the fleet map.

    Each map becomes one revision, complete or not at all. Nodes that the fleet map has are not
    added again. The others are replayed like a live drive: those that localise are already covered
    and are dropped, the rest are added. Merging the same map again changes nothing. If a later map
    fails, earlier merges are kept and reported.

    \b
    Examples:
      engram merge fleet.engram r1.engram r2.engram
      engram merge fleet.engram r1.engram --dry-run --picture merge.png
      engram merge fleet.engram r1.engram --require-better held-out.framelog
    """
    from engram.cli.screen import Bars
    from engram.fleet.dream import keep_hand_in
    from engram.fleet.merge.gate import GeometryGate
    from engram.fleet.merge.merging import merge as merge_maps

    reports: list[MergeReport] = []

    class Heard(Bars):
        def hear(self, report: MergeReport) -> None:
            reports.append(report)
            if not as_json:
                typer.echo(report.text())

    resolved = settings.read()
    try:
        merge_maps(
            centre,
            robots,
            merging_of(resolved),
            Heard(),
            settings=resolved.of_robot(),
            dry_run=dry_run,
            require_better=require_better or (),
            localising=options.driving_of(resolved),
            picture=picture,
            geometry=GeometryGate(refuses=require_geometry, config=resolved.repair)
            if geometry or require_geometry
            else None,
        )
        for robot, report in zip(robots, reports, strict=False):
            if keep and not (dry_run or report.interrupted):
                keep_hand_in(centre, robot)
    except EngramError as error:
        raise PartlyDoneError(error, _merges(reports)) from error
    except KeyboardInterrupt:
        if not reports:
            raise
        stopped = VerbInterruptedError("interrupted; the reported merges are kept")
        raise PartlyDoneError(stopped, _merges(reports)) from None
    if as_json:
        print(json.dumps(_merges(reports)))
    if any(report.interrupted for report in reports):
        raise typer.Exit(ExitStatus.INTERRUPTED)


def _merges(reports: list[MergeReport]) -> dict[str, Any]:
    """What ``merge --json`` prints."""
    return {"merges": [report.to_dict() for report in reports]}


def merging_of(settings: AllSettings) -> MergeOptions:
    """How the settings say that maps are merged."""
    from engram.fleet.merge.merge_settings import MergeOptions

    return MergeOptions.of(settings.merge, os.environ.get(AUTHOR))


def download(
    centre: Annotated[
        Path, typer.Argument(metavar="FLEET", help="The fleet map.", parser=options.map_file)
    ],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="The robot's map: a new file, or with --update its own.",
            parser=options.output_map,
        ),
    ],
    *,
    update: Annotated[
        bool,
        typer.Option(
            "--update", help="Add the download to OUT, which keeps its own nodes and history."
        ),
    ] = False,
    select: Annotated[
        str,
        typer.Option(
            "--select",
            metavar="NAME",
            help="copy, tod, paths, tod+paths, region, route or budget.",
        ),
    ] = "copy",
    depart: Annotated[
        str | None, typer.Option("--depart", metavar="H:MM", help="When the mission begins.")
    ] = None,
    arrive: Annotated[
        str | None, typer.Option("--arrive", metavar="H:MM", help="When the mission ends.")
    ] = None,
    date: Annotated[
        str | None,
        typer.Option(
            "--date",
            metavar="DAY",
            help="Day of the mission: 2026-11-17 [default: the newest drive's].",
            hidden=True,
        ),
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option("--budget", metavar="SIZE", help="200MB, 1.5GiB, or 25% of a full download."),
    ] = None,
    near: Annotated[
        list[str] | None,
        typer.Option(
            "--near",
            metavar="NODE",
            help="Only around this node; repeatable; not for copy.",
        ),
    ] = None,
    route: Annotated[
        str | None,
        typer.Option("--route", metavar="SESSION", help="Only along this session; not for copy."),
    ] = None,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="Refuse an hour without data instead of widening it.", hidden=True
        ),
    ] = False,
    at: options.At = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Write what one mission needs.

    The download is a map of its own: the robot drives with it, adds to it and hands it in for the
    next merge. Times are hours of the day at the place: mean solar time if longitudes are known,
    otherwise civil time.

    \b
    Examples:
      engram download fleet.engram r1.engram
      engram download fleet.engram r1.engram --update
      engram download fleet.engram r1.engram --select tod --depart 9:30
      engram download fleet.engram r1.engram --select tod+paths --depart 9:30 --arrive 11:00
      engram download fleet.engram r1.engram --select tod --depart 3:00 --route 5f3a
      engram download fleet.engram r1.engram --select budget --budget 25% --depart 17:00
    """
    from engram.cli.screen import Bars
    from engram.fleet.download.downloading import download as send
    from engram.fleet.download.mission import DownloadOptions, budget_from_text, hour_from_text
    from engram.fleet.download.updating import update as take_in
    from engram.monitor import interruptible

    budget_bytes, budget_percent = budget_from_text(budget)
    asked = DownloadOptions.of(
        settings.read().download,
        select,
        depart_h=hour_from_text(depart, "depart"),
        arrive_h=hour_from_text(arrive, "arrive"),
        date=date,
        budget_bytes=budget_bytes,
        budget_percent=budget_percent,
        near=tuple(near or ()),
        route=route,
        strict=strict,
    )
    report: DownloadReport | UpdateReport
    if update and out.exists():
        with interruptible(Bars()) as monitor:
            report = take_in(centre, out, asked, at=at, monitor=monitor)
    else:
        report = send(centre, out, asked, at=at, monitor=Bars())
    options.show(report, as_json=as_json)


def build(
    centre: options.WrittenFleetMap,
    drives: Annotated[
        list[str], typer.Argument(metavar="DRIVE", help="Frame logs or drives: paths or URLs.")
    ],
    *,
    workers: Annotated[
        int, typer.Option("--workers", metavar="N", min=1, help="Processes on this machine.")
    ] = 2,
    groups: Annotated[
        int, typer.Option("--groups", metavar="N", min=1, help="Groups of drives.")
    ] = 2,
    grouping: Annotated[
        str,
        typer.Option(
            "--grouping",
            metavar="HOW",
            help="chronological, random:SEED, by-condition, or a file with one group per line.",
        ),
    ] = "chronological",
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Map on a Dask cluster instead."),
    ] = None,
    order: Annotated[
        str | None,
        typer.Option(
            "--order",
            metavar="NAME",
            help="Search for a good order of merging: best (all), best-first (each first).",
        ),
    ] = None,
    validate: Annotated[
        list[Path] | None,
        typer.Option("--validate", metavar="DRIVE", help="Held-out drive for --order; repeatable."),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Map many drives in parallel.

    Groups of drives are mapped in parallel, then merged. Progress is kept in FLEET.build until
    the build is complete; the same command resumes an interrupted build. The same drives and
    options give the same map. Drives that FLEET already contains are left out.

    \b
    Examples:
      engram build town.engram logs/*.framelog --workers 4 --groups 4
      engram build town.engram logs/*.framelog --groups 4 --grouping random:7
      engram build town.engram logs/*.framelog --groups 3 --order best --validate held-out.framelog
    """
    from engram.cli.screen import Bars
    from engram.fleet.build.building import BuildOptions, build_map
    from engram.robot.settings import RobotOptions

    resolved = settings.read()
    merging = merging_of(resolved)
    how, seed = _grouping(grouping)
    asked = BuildOptions(
        workers=workers,
        groups=groups,
        grouping=how,
        seed=seed,
        mapping=RobotOptions(
            ranking=merging.ranking,
            lanes=merging.lanes,
            rounds=merging.rounds,
            relocaliser=merging.relocaliser_name,
            author=merging.author,
        ),
        merging=merging,
        scheduler=scheduler,
        judge=_judge(order, validate or [], resolved),
    )
    report = build_map(centre, drives, resolved.of_robot(), asked, monitor=Bars())
    options.show(report, as_json=as_json)
    if report.interrupted:
        raise typer.Exit(ExitStatus.INTERRUPTED)


def _grouping(text: str) -> tuple[str, int]:
    """Method of grouping and seed.

    Raises:
        ConfigError: the seed is not a whole number.
    """
    how, colon, seed = text.partition(":")
    if how != "random" or not colon:
        return text, 0
    if not seed.isdecimal():
        raise ConfigError(f"--grouping {text!r}: the seed must be a whole number, as in random:7")
    return how, int(seed)


def _judge(order: str | None, drives: list[Path], given: AllSettings) -> JudgeOptions | None:
    """How orders are compared; None if the groups are merged as they come.

    Raises:
        ConfigError: there is no such order, or drives are given and no order is searched for.
    """
    from engram.fleet.build.orders import JudgeOptions, Orders

    known = {"best": Orders.ALL, "best-first": Orders.FIRST}
    if order is None:
        if drives:
            raise ConfigError("--validate compares orders of merging: add --order best, or drop it")
        return None
    if order not in known:
        raise ConfigError(f"--order {order!r} is unknown; known: {', '.join(known)}")
    return JudgeOptions(
        drives,
        judge_at_m=given.build.max_gap_m,
        localising=options.driving_of(given),
        orders=known[order],
        estimator=given.build.estimator,
    )


def dream(
    centre: Annotated[
        Path, typer.Argument(metavar="FLEET", help="The fleet map.", parser=options.map_file)
    ],
    handed: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="ROBOT",
            help="Robots' maps as handed in [default: those kept by merge --keep].",
            parser=options.map_file,
        ),
    ] = None,
    *,
    validate: Annotated[
        list[Path],
        typer.Option(
            "--validate", metavar="DRIVE", help="Held-out drive; give three or more. Required."
        ),
    ],
    minutes: Annotated[
        float | None,
        typer.Option(
            "--minutes", metavar="MIN", help="Stop after this long [default: try everything]."
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option("--workers", metavar="N", min=1, help="Processes on this machine.")
    ] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Try on a Dask cluster instead."),
    ] = None,
    settings: options.SettingsGiven,
    as_json: options.Json = False,
) -> None:
    """Optimise a fleet map on held-out drives.

    Merges the robots' maps again, in other orders and with other settings, and compares the results
    on held-out drives. If the drives then localise significantly better, what is new in the best
    result is added to the fleet map as one revision. Nothing is removed. The same command resumes
    an interrupted search.

    \b
    Examples:
      engram dream fleet.engram r1.engram --validate mon --validate tue --validate wed
      engram dream fleet.engram --validate mon --validate tue --validate wed --minutes 30
    """
    from engram.cli.screen import Bars
    from engram.fleet.dream import DreamOptions, hand_ins_of
    from engram.fleet.dream import dream as look_for_better
    from engram.monitor import interruptible

    given = settings.read()
    asked = DreamOptions(
        minutes=minutes,
        workers=workers,
        scheduler=scheduler,
        merging=merging_of(given),
        localising=options.driving_of(given),
        judge_at_m=given.build.max_gap_m,
        estimator=given.build.estimator,
    )
    with interruptible(Bars()) as monitor:
        report = look_for_better(
            centre, handed or hand_ins_of(centre), validate, given.of_robot(), asked, monitor
        )
    options.show(report, as_json=as_json)


def forget(
    map_path: options.MapPath,
    *,
    session: Annotated[
        list[str] | None,
        typer.Option("--session", metavar="ID", help="This drive; repeatable."),
    ] = None,
    region: Annotated[
        str | None,
        typer.Option(
            "--region",
            metavar="X,Y,R",
            help="What lies within R metres of a point in the map frame.",
        ),
    ] = None,
    older_than: Annotated[
        str | None,
        typer.Option("--older-than", metavar="AGE", help="Drives older than this: 90d."),
    ] = None,
    down_to: Annotated[
        str | None,
        typer.Option(
            "--down-to",
            metavar="SIZE",
            help="Only the least useful nodes, until 2GB or 50% is left.",
        ),
    ] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Only the pictures of what is chosen.")
    ] = False,
    erase: Annotated[
        bool, typer.Option("--erase", help="Permanently erase all that is forgotten.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do it; the default is a preview.")] = False,
    message: Message = "",
    as_json: options.Json = False,
) -> None:
    """Forget drives, places or pictures.

    Hides what matches all the options, in a revision that engram revert can undo. Edges are
    composed over it, merges do not add it again, and robots drop it with their next download.
    --erase removes the bytes of everything forgotten so far; receipts stay, by which engram check
    still verifies the history. Close the map everywhere else first.

    \b
    Examples:
      engram forget fleet.engram --session 5f3a
      engram forget fleet.engram --region 120,-40,30 --yes --message "asked by the owner"
      engram forget fleet.engram --older-than 90d --pictures --yes
      engram forget fleet.engram --down-to 2GB
      engram forget fleet.engram --erase --yes
    """
    from engram.fleet.download.mission import budget_from_text
    from engram.fleet.forgetting import (
        Retained,
        Retention,
        age_from_text,
        forget_and_erase,
        region_from_text,
    )

    retention = Retention(
        tuple(session or ()),
        region_from_text(region),
        age_from_text(older_than),
        pictures,
        budget_from_text(down_to, "--down-to"),
    )
    done = forget_and_erase(
        map_path, retention, author=user(), why=message, erase=erase, dry_run=not yes
    )
    end = "" if yes or done == Retained(None, None) else "previewed only: --yes does it"
    if done.revision is not None and not erase:
        end = undo_text(map_path, done.revision)
    options.show(done, f"{done.text()}\n{end}".rstrip(), as_json=as_json)
