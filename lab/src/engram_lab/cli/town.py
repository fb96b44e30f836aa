"""`engram demo`, and `engram lab simulate`, `bench` and `fleet-day`."""

from __future__ import annotations

import json
import os
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options
from engram.cli.screen import drawing

if TYPE_CHECKING:
    from engram_lab.demo.story import DemoReport
    from engram_lab.fleet_day.day import DayReport


def demo(
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for logs, map and pictures.")
    ] = Path("demo"),
    workers: Annotated[
        int, typer.Option("--workers", metavar="N", min=1, help="Processes that render.")
    ] = 2,
    as_json: options.Json = False,
) -> None:
    """Drive a small simulated town with three robots.

    Two robots map it and hand in their maps; a later drive at night and a third robot are localised
    with what they share. Writes DIR/report.html, and opens it where there is a screen.

    \b
    Examples:
      engram demo
      engram demo --out /tmp/demo --workers 4
    """
    from engram.cli.screen import Bars
    from engram_lab.demo.story import run_demo

    report = run_demo(out, Bars(), workers)
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        _show(report)


def _show(report: DemoReport) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from engram_lab.demo.story import INTRODUCTION, LIMITS, MEANING, OWN_COMMANDS, OWN_DRIVES

    console = Console(file=drawing(sys.stdout))
    console.print(f"{INTRODUCTION}\n{MEANING}")
    for one in report.tables():
        console.print(f"\n{one.title}. {one.about}")
        shown = Table(*one.head, box=SIMPLE_HEAD, show_edge=False, collapse_padding=True)
        shown.columns[0].no_wrap = True
        for row in one.rows:
            shown.add_row(*row)
        console.print(shown)
    console.print(
        f"\n{report.accuracy()} {LIMITS}\nLook at {report.page}: the tables, the place in six "
        "conditions, and the later drives' matches as pictures."
    )
    console.print("\n  ".join([OWN_DRIVES, *OWN_COMMANDS]))
    has_screen = sys.platform == "darwin" or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
    if sys.stdout.isatty() and has_screen:
        webbrowser.open(report.page.resolve().as_uri())


def simulate(
    campaign: Annotated[
        str,
        typer.Argument(
            metavar="CAMPAIGN",
            help="hamlet, village, begbroke, keble, oxford, begbroke24h, year, month, wet, "
            "covered or estate.",
        ),
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder to write to [default: the user's cache]."
        ),
    ] = None,
    size: Annotated[
        str, typer.Option("--size", metavar="SIZE", help="standard or full.")
    ] = "standard",
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of the town.")] = 1,
    images: Annotated[
        bool, typer.Option("--images", help="Write images in KITTI's layout instead of frame logs.")
    ] = False,
    sessions: Annotated[
        str | None, typer.Option("--sessions", metavar="N,N…", help="Only these drives.")
    ] = None,
    workers: Annotated[
        int, typer.Option("--workers", metavar="N", min=1, help="Processes on this machine.")
    ] = 2,
    period: Annotated[
        float,
        typer.Option(
            "--period", metavar="M", help="estate: distance after which fronts repeat.", hidden=True
        ),
    ] = 37.5,
    equal: Annotated[
        float,
        typer.Option(
            "--equal", metavar="SHARE", help="estate: share of equal fronts.", hidden=True
        ),
    ] = 1.0,
    unique: Annotated[
        str,
        typer.Option(
            "--unique", metavar="WHAT,…", help="estate: what differs between streets.", hidden=True
        ),
    ] = "road,things,cars",
    config: options.Settings = None,
    as_json: options.Json = False,
) -> None:
    """Render drives through a simulated town.

    The exact poses are written next to each drive. The same command resumes a run that was stopped.

    \b
    Examples:
      engram lab simulate hamlet --out campaigns
      engram lab simulate village --images --sessions 0,3 --out campaigns
    """
    from engram.cli.screen import Bars
    from engram.cli.settings import read_settings
    from engram_lab.cli.studies import numbers
    from engram_lab.town.campaigns import Size, campaign_named, estate
    from engram_lab.town.simulating import campaigns_folder
    from engram_lab.town.simulating import simulate as render
    from engram_lab.town.streets import Fronts, Unique

    chosen = campaign_named(campaign, seed, Size.named(size))
    if campaign == "estate":
        chosen = estate(seed, chosen.size, Fronts(period, equal, Unique.named(unique)))
    wanted = None if sessions is None else numbers(sessions, "--sessions")
    report = render(
        chosen,
        out or campaigns_folder(),
        images=images,
        sessions=wanted,
        workers=workers,
        settings=read_settings(config).of_robot(),
        monitor=Bars(),
    )
    typer.echo(json.dumps(report.to_dict()) if as_json else report.text())


def bench(
    *,
    only: Annotated[
        str | None, typer.Option("--only", metavar="STAGES", help="Stages, joined by commas.")
    ] = None,
    repeats: Annotated[
        int, typer.Option("--repeats", metavar="N", min=1, help="Runs of each stage.")
    ] = 200,
    against: Annotated[
        Path | None,
        typer.Option(
            "--against", metavar="CHECKOUT", help="Compare with this checkout, built in place."
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Time each stage against plain OpenCV.

    Everything runs on one core, in memory, each stage interleaved with its reference. With
    --against, another checkout is the reference: both run in alternating blocks, in two processes.

    \b
    Examples:
      engram lab bench
      engram lab bench --only frontend_odometry_512,attempt_512 --json
      engram lab bench --only attempt_512 --against ../engram-before
    """
    from rich.console import Console

    if against is not None:
        _bench_against(against, only, as_json=as_json)
        return

    from engram_lab.bench.runner import run_bench

    with Console(file=drawing(sys.stderr)).status("") as status:
        report = run_bench(
            only.split(",") if only else None,
            repeats=repeats,
            progress=lambda stage, done, of: status.update(f"{stage} ({done + 1} of {of})"),
        )
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        Console(file=drawing(sys.stdout)).print(report.table())


def _bench_against(other: Path, only: str | None, *, as_json: bool) -> None:
    from dataclasses import asdict

    from engram_lab.bench.against import compare
    from engram_lab.bench.stages import STAGES

    for one in compare(other, only.split(",") if only else list(STAGES)):
        if as_json:
            print(json.dumps(asdict(one)), flush=True)
        else:
            print(
                f"{one.name}: {one.ours_ms:.3f} ms, there {one.theirs_ms:.3f} ms, ratio "
                f"{one.ratio:.3f} ({one.low:.3f} to {one.high:.3f})",
                flush=True,
            )


def fleet_day(
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for centre, robots and logs.")
    ] = Path("centre-demo"),
    workers: Annotated[
        int, typer.Option("--workers", metavar="N", min=1, help="Processes that render.")
    ] = 2,
    serve: Annotated[
        bool, typer.Option("--serve", help="Serve the centre's pages afterwards.")
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Let three robots share a map through a centre.

    Each maps half of a round, hands in over a link that breaks every 200 kB, downloads what its
    next mission needs, and drives the whole round.

    \b
    Examples:
      engram lab fleet-day
      engram lab fleet-day --out /tmp/day --serve
    """
    from engram.cli.screen import Bars
    from engram_lab.fleet_day.day import run_day

    report = run_day(out, Bars(), workers, lambda line: typer.echo(line, err=True))
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        _show_day(report)
    if serve:
        from engram.fleet.centre.service import Centre
        from engram.fleet.centre.serving import Listening
        from engram.fleet.centre.serving import serve as run

        listening = Listening("127.0.0.1", 8440)
        typer.echo(f"http://127.0.0.1:8440 with the token {report.token}; Ctrl-C ends it")
        with Centre(out / "centre") as centre:
            run(centre, listening)
    elif not as_json:
        typer.echo(f"next: engram centre serve {out / 'centre'}")
        typer.echo(f"  and open http://127.0.0.1:8440 with the token {report.token}")


def _show_day(report: DayReport) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("robot", "map", title="Second foray: own map, and a download of the fleet's")
    for column in ("nodes", "localised", "new nodes", "sent kB", "received kB"):
        table.add_column(column, justify="right")
    for one in report.forays:
        fallen = ", fell back" if one.fell_back else ""
        rows = (
            ("own", one.alone, "", ""),
            (
                f"{one.download}{fallen}",
                one.shared,
                f"{one.sent_bytes / 1e3:.0f}",
                f"{one.received_bytes / 1e3:.0f}",
            ),
        )
        for name, (whose, drive, sent, received) in zip((one.robot, ""), rows, strict=True):
            counts = (str(drive.held), f"{drive.localised:.0%}", str(drive.added))
            table.add_row(name, whose, *counts, sent, received)
        table.add_section()
    console = Console(file=drawing(sys.stdout))
    console.print(table)
    for one in report.forays:
        typer.echo(f"{one.robot}: {one.why}")
    typer.echo(
        f"{report.nodes} nodes in {report.revisions} revisions; {report.passed_bytes / 1e6:.1f} MB "
        f"passed the link, which broke {report.cuts} times; {report.faults} faults in any map"
    )
    longest = max(report.stages_s, key=lambda one: report.stages_s[one])
    typer.echo(
        f"{sum(report.stages_s.values()):.0f} s, of which {report.stages_s[longest]:.0f} s: "
        f"{longest}"
    )
