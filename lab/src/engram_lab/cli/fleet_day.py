"""`engram lab fleet-day`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engram.cli import options
from engram.cli.screen import drawing

if TYPE_CHECKING:
    from engram_lab.fleet_day import DayReport


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

    Each drives, hands in over a link that breaks every 200 kB, downloads what its next mission
    needs, and drives again.

    \b
    Examples:
      engram lab fleet-day
      engram lab fleet-day --out /tmp/day --serve
    """
    from engram.cli.progress import Bars
    from engram_lab.fleet_day import run_day

    report = run_day(out, Bars(), workers, lambda line: typer.echo(line, err=True))
    if as_json:
        print(json.dumps(report.to_dict()))
    else:
        _show(report)
    if serve:
        from engram.centre.service import Centre
        from engram.centre.serving import Listening
        from engram.centre.serving import serve as run

        listening = Listening("127.0.0.1", 8440)
        typer.echo(f"http://127.0.0.1:8440 with the token {report.token}; Ctrl-C ends it")
        with Centre(out / "centre") as centre:
            run(centre, listening)


def _show(report: DayReport) -> None:
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
    typer.echo(
        f"{report.nodes} nodes in {report.revisions} revisions; {report.passed_bytes / 1e6:.1f} MB "
        f"passed the link, which broke {report.cuts} times; {report.faults} faults in any map"
    )
    longest = max(report.stages_s, key=lambda one: report.stages_s[one])
    typer.echo(
        f"{sum(report.stages_s.values()):.0f} s, of which {report.stages_s[longest]:.0f} s: "
        f"{longest}"
    )
